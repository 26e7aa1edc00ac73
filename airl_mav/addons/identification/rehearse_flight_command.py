"""`airl rehearse-flight`: rehearse a recorded flight and compare the two."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from pydantic import Field
from rich.console import Console

from airl_mav.cli.options import POSITIONAL, check_installed
from airl_mav.core.clock import utc_now
from airl_mav.core.errors import FieldError
from airl_mav.core.fields import ProfileModel, quantity
from airl_mav.core.progress import new_console
from airl_mav.report.comparison.show import compare_folders, show_comparison
from airl_mav.report.document import NONE, TableView, columns_of, print_table
from airl_mav.scenario.model import GREATEST_SEED

if TYPE_CHECKING:
    from airl_mav.addons.identification.rehearse_flight import Changes, PartFlown


class RehearseFlightOptions(ProfileModel):
    """Rehearse a flight recorded by `airl-companion --black-box`, and compare the two.

    The same policy flies to the same goal in lockstep, with the decision latencies of the flight.
    If the flight differs from all rehearsals, the aircraft differs from the vehicle profile, or the
    world from the arena.

    Examples:
        airl rehearse-flight flights/20261123T172437.230467Z.mcap
        airl rehearse-flight flights/20261123T172437.230467Z.mcap --arena yard.toml
        airl rehearse-flight flights/20261123T172437.230467Z.mcap --identified identified --parts
    """

    flight: Annotated[Path, POSITIONAL] = Field(description="black box of a flight (.mcap)")
    arena: str | None = Field(
        default=None,
        description="arena profile of the flight's surroundings: a shipped name, or a path to a"
        " .toml; default: an empty plain",
    )
    arena_seed: int | None = quantity(
        "seed of the arena; by default that of the flight",
        "1",
        ge=0,
        le=GREATEST_SEED,
        default=None,
    )
    episodes: int = quantity(
        "rehearsals, each with the noise of other sensors", "1", ge=1, le=1000, default=20
    )
    policy: str | None = Field(
        default=None,
        description="policy to rehearse: a name, or a path; by default the one that flew, where it"
        " lay then",
    )
    identified: Path | None = Field(
        default=None,
        description="folder of airl identify: fly its vehicle in its wind",
    )
    parts: bool = Field(
        default=False,
        description="with --identified: also rehearse with its latency, vehicle and wind alone,"
        " and with none of them, on the same seeds, to explain the flight",
    )
    vehicle: str | None = Field(
        default=None,
        description="vehicle profile to rehearse: a shipped name, or a path to a .toml; by default"
        " that of the identification, or the one that the flight names",
    )
    trust: bool = Field(default=False, description="run code that the policy or the arena names")
    out: Path | None = Field(
        default=None,
        description="folder of the comparison, with both runs in it; by default"
        " runs/<UTC time>-rehearse-flight",
    )


OPTIONS = RehearseFlightOptions


def run(options: RehearseFlightOptions, console: Console | None = None) -> int:
    """Rehearse the flight. Returns exit status 0; raises UsageError as `rehearse_flight` does."""
    console = console or new_console()
    check_installed("black-box", "sim")
    _check(options)
    # Imported here: MCAP is an extra.
    from airl_mav.addons.identification.rehearse_flight import (
        FLOWN,
        REHEARSED,
        Rehearsals,
        rehearse_flight,
        rehearse_flight_parts,
    )

    out = options.out or Path("runs") / f"{utc_now():%Y%m%dT%H%M%SZ}-rehearse-flight"
    asked = Rehearsals(
        options.arena,
        options.arena_seed,
        options.episodes,
        options.policy,
        options.trust,
        progress=True,
    )
    parts: tuple[PartFlown, ...] = ()
    if options.parts and options.identified is not None:
        check_installed("identify")
        found, parts = rehearse_flight_parts(options.flight, out, options.identified, asked)
    else:
        found = rehearse_flight(options.flight, out, asked, _changes(options))
    comparison, runs = compare_folders([out / REHEARSED, out / FLOWN], (REHEARSED, FLOWN))
    show_comparison(comparison, runs, out, console)
    console.print()
    for sentence in found.sentences:
        console.print(sentence)
    if parts:
        print_table(parts_table(parts, found.flown_s), console)
    return 0


def parts_table(parts: Sequence[PartFlown], flown_s: float) -> TableView:
    """Return the differences between flight and rehearsals, with each part of an identification."""
    columns = columns_of("<with | reached | time [s] | off [%] | path apart [m]")
    rows = tuple(
        (
            each.part,
            f"{each.reached} of {each.rehearsals}",
            NONE if each.time_s is None else f"{each.time_s:.2f}",
            NONE if each.time_share is None else f"{100.0 * each.time_share:+.1f}",
            f"{each.apart_m:.2f}",
        )
        for each in parts
    )
    title = f"rehearsed part by part, medians; the flight took {flown_s:.2f} s"
    return TableView("parts", title, columns, rows)


def _check(options: RehearseFlightOptions) -> None:
    if options.parts and options.identified is None:
        raise FieldError("parts", options.parts, "with --identified")
    if options.parts and options.vehicle is not None:
        accepted = "without --parts, which flies the identified values"
        raise FieldError("vehicle", options.vehicle, accepted)


def _changes(options: RehearseFlightOptions) -> Changes:
    """Return the changes to the flight's settings in the rehearsals."""
    from airl_mav.addons.identification.rehearse_flight import AS_FLOWN, changes_of

    changes = AS_FLOWN
    if options.identified is not None:
        check_installed("identify")
        changes = changes_of(options.identified)
    return replace(changes, vehicle=options.vehicle or changes.vehicle)
