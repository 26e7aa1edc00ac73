"""Options shared by commands: requirements, live view, recordings as runs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from pydantic import Field

from airl_mav.black_box.messages import SUFFIX
from airl_mav.cli.options import REPEATED, check_installed
from airl_mav.core.addons import entries, load
from airl_mav.core.errors import FieldError, UsageError
from airl_mav.core.fields import ProfileModel, quantity
from airl_mav.rehearsal.live_view import ViewRequest, check_view
from airl_mav.scenario.aircraft import GREATEST_PORT

if TYPE_CHECKING:
    from airl_mav.flight.requirements import Requirement
    from airl_mav.report.run_verdict import OverallVerdict


TrustArenas = Annotated[
    bool,
    Field(
        description="run the arena generators named by the runs: code by the author of the folder"
    ),
]


class Gate(ProfileModel):
    """Requirements, and files for the verdict."""

    require: Annotated[tuple[str, ...], REPEATED] = Field(
        default=(),
        description="requirement, decided on the 95 % interval, as 'success >= 95 %'; may be"
        " repeated. Exit status 3: not met, 5: too few flights to decide",
    )
    junit: Path | None = Field(
        default=None, description="write the verdict as JUnit XML into this file"
    )
    badge: Path | None = Field(
        default=None, description="write the verdict as a badge, an SVG picture, into this file"
    )


def requirements_of(gate: Gate, *, reference: bool = True) -> tuple[Requirement, ...]:
    """Return the requirements; FieldError for a gap without a `reference`."""
    if not gate.require:
        return ()
    # Imported here and below: flights do not need statistics and figures.
    from airl_mav.flight.requirements import ACCEPTED, parse_requirement

    requirements = tuple(parse_requirement(text) for text in gate.require)
    for requirement in requirements:
        if requirement.gap and not reference:
            raise FieldError(
                "require",
                str(requirement),
                f"a gap only where a reference is flown, as by airl gap; {ACCEPTED}",
            )
    return requirements


def leave(gate: Gate, verdict: OverallVerdict, suite: str) -> None:
    """Write the requested files of the verdict; `suite` is the command."""
    from airl_mav.report.run_verdict import write_badge, write_junit

    if gate.junit is not None:
        write_junit(verdict, gate.junit, suite)
    if gate.badge is not None:
        write_badge(verdict, gate.badge)


class Viewing(ProfileModel):
    """Live view of flights."""

    view: bool = Field(
        default=False,
        description="show the flights in a browser while they fly, at an address that is printed"
        " (docs/how-to/view.md); in lockstep they fly in real time unless --speed says otherwise",
    )
    view_port: int | None = quantity(
        "TCP port of that page on the loopback address; by default a free one",
        "1",
        ge=1,
        le=GREATEST_PORT,
        default=None,
    )


def view_of(options: Viewing) -> ViewRequest | None:
    """Return the requested live view or None; UsageError for missing packages."""
    if not options.view:
        if options.view_port is not None:
            raise FieldError(
                "view_port", options.view_port, problem="accepted: together with --view"
            )
        return None
    check_view()
    check_installed("view")
    return ViewRequest(options.view_port)


def folder_of(path: Path, ulg: Path | None = None) -> Path:
    """Return a run's folder, created from a black box and log if necessary, or UsageError."""
    if path.suffix != SUFFIX or path.is_dir():
        return path
    check_installed("black-box" if ulg is None else "refit")
    converter = entries("airl_mav", "RECORDINGS").get(path.suffix)
    if converter is None:
        raise UsageError(f"{path}: needs the add-on recordings (airl_mav/addons/recordings)")
    return Path(load(converter)(path, ulg))
