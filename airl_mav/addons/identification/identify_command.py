"""`airl identify`: estimate vehicle and computer profiles from a recorded flight."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import Field
from rich.console import Console

from airl_mav.cli.options import POSITIONAL, check_installed
from airl_mav.core import errors, fields, progress
from airl_mav.report.document import NONE, Column, TableView, columns_of, print_table

if TYPE_CHECKING:
    from airl_mav.addons.identification.flown import FittedQuantity
    from airl_mav.addons.identification.identify import Identification


class IdentifyOptions(fields.ProfileModel):
    """Fit a vehicle, a computer and the wind to a flight recorded with --black-box.

    The flight controller's log (.ulg) adds mass or thrust, and the link latency. A PX4 log alone,
    of any flight, gives everything except the computer. Several logs give more precise vehicle
    parameters. Writes profiles that load without changes, and lists quantities that the flights do
    not determine.

    Examples:
        airl identify log_12.ulg --vehicle quad --out identified
        airl identify log_10.ulg log_11.ulg log_12.ulg --vehicle quad --out identified
        airl identify flights/20261123T172437.230467Z.mcap --ulg log_12.ulg --out identified
        airl rehearse-flight flights/20261123T172437.230467Z.mcap --identified identified
    """

    flights: Annotated[tuple[Path, ...], POSITIONAL] = Field(
        min_length=1,
        description="black box of a flight (.mcap), or the flight controller's log alone (.ulg);"
        " logs of several flights of one vehicle, the newest last",
    )
    ulg: Path | None = Field(
        default=None,
        description="the flight controller's log of the flight of a black box (.ulg)",
    )
    vehicle: str | None = Field(
        default=None,
        description="vehicle profile to start from: a shipped name, or a path to a .toml; default:"
        " the one that the black box names, quad for a log alone",
    )
    known: Literal["thrust", "mass"] = Field(
        default="thrust",
        description="quantity taken from the profile: a flight determines only thrust per mass, so"
        " the other one is fitted",
    )
    out: Path = Field(
        description="new folder for vehicle.toml, computer.toml, latency.txt, scenario.toml and"
        " identification.json"
    )


OPTIONS = IdentifyOptions
READS_FILES = True

SHORT = {
    "mass_kg": "mass",
    "thrust_max_n": "thrust",
    "drag_1_s": "drag",
    "wind_north_m_s": "wind north",
    "wind_east_m_s": "wind east",
    "dead_time_s": "dead time",
}
"""Quantities in the table of several flights, with their column titles."""


def run(options: IdentifyOptions, console: Console | None = None) -> int:
    """Identify. Returns exit status 0; raises UsageError as `identify` does."""
    console = console or progress.new_console()
    check_installed("sim", "identify")
    # Imported here: MCAP and pyulog are extras.
    from airl_mav.addons.identification.identify import identify, identify_together

    if len(options.flights) > 1:
        if options.ulg is not None:
            raise errors.FieldError("ulg", f"{options.ulg}", "nothing beside several logs")
        found = identify_together(
            options.flights, vehicle=options.vehicle, known=options.known, out=options.out
        )
    else:
        found = identify(
            options.flights[0],
            ulg=options.ulg,
            vehicle=options.vehicle,
            known=options.known,
            out=options.out,
        )
    print_table(table_of(found), console)
    if found.flights:
        print_table(table_of_flights(found.flights), console)
    for line in (*unobserved_lines(found), *found.notes, f"written: {options.out}"):
        console.print(line, highlight=False, soft_wrap=True)
    return 0


def table_of(found: Identification) -> TableView:
    """Return the table of fitted quantities."""
    columns = columns_of("<quantity | <unit | fitted | 95 % interval | profile")
    rows = tuple(
        (
            each.meaning,
            "" if each.unit == "1" else each.unit,
            _number(each, each.value),
            f"{_number(each, each.low)} to {_number(each, each.high)}" if each.observed else NONE,
            _number(each, each.profile),
        )
        for each in found.estimates
    )
    return TableView("identification", f"{found.base}, identified", columns, rows)


def table_of_flights(flights: Sequence[Identification]) -> TableView:
    """Return the table of vehicle and wind estimates from each flight."""
    told = [key for key in SHORT if any(each.estimate(key).observed for each in flights)]
    columns = (
        Column("flight", number=False),
        *(Column(SHORT[key], flights[0].estimate(key).unit) for key in told),
    )
    rows = tuple(
        (
            "" if each.ulg is None else each.ulg.name,
            *(_number(each.estimate(key), each.estimate(key).value) for key in told),
        )
        for each in flights
    )
    return TableView("flights", "Each flight alone", columns, rows)


def unobserved_lines(found: Identification) -> list[str]:
    """Return a line for each quantity that the flight does not determine."""
    return [
        f"not observable{' in this flight' if not found.flights else ''}: {each.meaning}:"
        f" {each.unobservable}"
        for each in found.estimates
        if not each.observed
    ]


def _number(estimate: FittedQuantity, value: float | None) -> str:
    if value is None:
        return NONE
    return f"{value:.1f}" if estimate.unit == "ms" else f"{value:.3f}"
