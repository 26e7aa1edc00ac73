"""What a command can be asked to require of its flights, and what it then leaves for a CI job."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from pydantic import Field

from airl_mav.cli.options import REPEATED
from airl_mav.core.errors import FieldError
from airl_mav.core.fields import ProfileModel

if TYPE_CHECKING:
    from airl_mav.flight.requirements import Requirement
    from airl_mav.report.verdict import OverallVerdict


class Gate(ProfileModel):
    """Requirements, and files that say whether they are met."""

    require: Annotated[tuple[str, ...], REPEATED] = Field(
        default=(),
        description="what the flights must show, decided on the 95 % interval, as 'success >= 95"
        " %'; may be given several times. Exit status 3: not met, 5: too few flights to tell",
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
    # Imported here and below: no flight waits for statistics and figures to be loaded.
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
    """Write the files that were asked for; `suite` is the command."""
    from airl_mav.report.verdict import write_badge, write_junit

    if gate.junit is not None:
        write_junit(verdict, gate.junit, suite)
    if gate.badge is not None:
        write_badge(verdict, gate.badge)
