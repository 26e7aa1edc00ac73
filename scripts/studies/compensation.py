"""Compensation: cost of errors in its model.

    python scripts/studies/compensation.py [--quick] [--episodes N] [--out DIR] [--config FILE]

A policy flies undelayed, delayed, and delayed with latency compensation: with the vehicle profile's
values, and with a wrong response, expected latency or number of images. All use the same seeds, at
level gym. Prints a table, and writes it as compensation.md and table.json.
"""

from __future__ import annotations

import shlex
import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from common import StudyConfig, StudyOptions, rate_with_interval, study
from numpy.typing import NDArray
from pydantic import Field, create_model
from rich.console import Console
from rich.progress import track

from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.cli.options import run_command, scenario_of
from airl_mav.core.errors import FieldError
from airl_mav.core.files import replace_file
from airl_mav.core.machine import provenance
from airl_mav.core.progress import new_console
from airl_mav.envs.evaluation import EpisodeResult, fly_seeds
from airl_mav.envs.fleet import FlightStatus
from airl_mav.experiments.gym_flier import navigation_of, pilots_of
from airl_mav.flight.statistics import median_ratio, wilson
from airl_mav.prediction import RECENT, Compensator, ExpectedLatency
from airl_mav.profiles.vehicle import VehicleProfile
from airl_mav.report.document import (
    NONE,
    Column,
    TableView,
    markdown_table,
    print_table,
    with_interval,
    write_table,
)
from airl_mav.scenario.model import Scenario
from airl_mav.scenario.resolve import resolve

OPTIONS = create_model("Options", __base__=StudyOptions, __doc__=__doc__)

FACTORS = (0.5, 0.75, 1.5, 2.0)
"""Factors of each part of the response."""

LATENCIES = (0.5, 0.75, 1.25, 1.5)
"""Factors of the expected latency."""

IMAGES = (1, 2, 8)
"""Numbers of stored images; the default is 4."""

QUANTILE = 0.9
"""Quantile of recent latencies, expected in place of their mean."""

SLOTS = 256


class CompensationConfig(StudyConfig):
    reference: str = Field(description="t2 of the undelayed policy")
    spread_latency: str = Field(description="t2 that differs from decision to decision")


class Scaled(ExpectedLatency):
    """Expected latency with a wrong factor."""

    def __init__(self, n: int, factor: float) -> None:
        super().__init__(n)
        self._factor = factor

    def expected_us(self) -> NDArray[np.int64]:
        scaled: NDArray[np.int64] = np.rint(self._factor * super().expected_us()).astype(np.int64)
        return scaled


class Quantile(ExpectedLatency):
    """Expected latency as a quantile of recent latencies."""

    def expected_us(self) -> NDArray[np.int64]:
        newest = np.ma.masked_array(
            self.measured_us, np.arange(RECENT) >= np.minimum(self.count, RECENT)[:, None]
        )
        return np.array(
            [np.quantile(row.compressed(), QUANTILE) if row.count() else 0 for row in newest],
            np.int64,
        )


class Case(NamedTuple):
    """Row of the table."""

    what: str
    latency: str
    compensate: bool = True
    vehicle: Callable[[VehicleProfile], VehicleProfile] = lambda vehicle: vehicle
    """Function that changes the compensation's response model; the flown vehicle is unchanged."""
    expected: Callable[[int], ExpectedLatency] = ExpectedLatency
    images: int = 4


def with_response(vehicle: VehicleProfile, name: str, factor: float) -> VehicleProfile:
    """Return a vehicle with a part of its response scaled."""
    response = vehicle.response
    if response is None:
        raise FieldError("vehicle", vehicle.description, "with a table `response`")
    other = response.model_copy(update={name: factor * getattr(response, name)})
    return vehicle.model_copy(update={"response": other})


def cases(late: str, spread: str) -> Iterator[Case]:
    """Yield the rows of the table below the reference."""
    yield Case("not compensated", late, compensate=False)
    yield Case("compensated", late)
    parts = {
        "velocity_time_s": "velocity's time constant",
        "dead_time_s": "dead time",
        "yaw_rate_time_s": "yaw rate's time constant",
        "drag_1_s": "drag",
    }
    for name, title in parts.items():
        for factor in FACTORS:
            changed = partial(with_response, name=name, factor=factor)
            yield Case(f"{title} x {factor:g}", late, vehicle=changed)
    for factor in LATENCIES:
        yield Case(f"expected latency x {factor:g}", late, expected=partial(Scaled, factor=factor))
    for images in IMAGES:
        yield Case(f"{images} image{'s' if images > 1 else ''} remembered", late, images=images)
    yield Case("t2 spread, not compensated", spread, compensate=False)
    yield Case("t2 spread, its mean expected", spread)
    yield Case(f"t2 spread, its {QUANTILE:.0%} quantile expected", spread, expected=Quantile)


def fly(scenario: Scenario, case: Case) -> dict[int, EpisodeResult]:
    """Return the flights of a row by seed."""
    asked = {"latency": case.latency, "compensate": case.compensate}
    resolved = resolve(scenario.model_copy(update=asked))
    seeds = range(scenario.seed, scenario.seed + scenario.episodes)
    slots = min(SLOTS, len(seeds))
    compensator = None
    if case.compensate:
        compensator = Compensator(
            slots,
            case.vehicle(resolved.vehicle),
            Intrinsics.of(resolved.vehicle.camera),
            remembered=case.images,
        )
        compensator.memory.latency = case.expected(slots)
    navigation = navigation_of(resolved, slots, compensator=compensator)
    flights = fly_seeds(navigation, pilots_of(resolved), seeds, zone=scenario.zone)
    return {flight.seed: flight for _, flight in flights}


def cells(flown: dict[int, EpisodeResult], reference: dict[int, EpisodeResult]) -> tuple[str, ...]:
    """Return success, flight time against the reference, and pairs, as text."""
    reached = [flight.verdict == FlightStatus.SUCCESS for flight in flown.values()]
    rate = rate_with_interval(wilson(sum(reached), len(reached)))
    if flown is reference:
        return rate, NONE, NONE
    both = [
        seed
        for seed, flight in flown.items()
        if flight.verdict == reference[seed].verdict == FlightStatus.SUCCESS
    ]
    longer = median_ratio(
        [reference[seed].flight_time_s for seed in both],
        [flown[seed].flight_time_s for seed in both],
    )
    return rate, with_interval(longer, 1, sign="+"), f"{len(both)}"


def run(options: StudyOptions, console: Console | None = None) -> int:
    console = console or new_console()
    with study(options, CompensationConfig, __file__) as (config, root):
        scenario = scenario_of(config)
        planned = [
            Case("undelayed", config.reference, compensate=False),
            *cases(str(config.latency), config.spread_latency),
        ]
        reference: dict[int, EpisodeResult] = {}
        rows = []
        # Commit at the start: another may be checked out before the end.
        made = provenance(shlex.join(["python", *sys.argv]))
        shown = new_console(stderr=True)
        for case in track(planned, "flying", console=shown, disable=not shown.is_terminal):
            flown = fly(scenario, case)
            reference = reference or flown
            rows.append((case.what, *cells(flown, reference)))
    columns = (
        Column("", number=False),
        Column("success", "%"),
        Column("flight time", "%"),
        Column("pairs"),
    )
    note = (
        f"{config.episodes:,} flights a row, seeds from {config.seed:,} on. Flight time: against "
        f"undelayed ({config.reference}), over the seeds that both finished. Late: "
        f"{config.latency}; spread: {config.spread_latency}. In brackets: 95 % intervals."
    )
    view = TableView(
        *("compensation", "Compensated latency", columns, tuple(rows), (note,)),
        in_terminal="stacked",
    )
    print_table(view, console)
    write_table(view, root, made, (scenario.policy,))
    replace_file(root / "compensation.md", f"{markdown_table(view)}\n".encode())
    return 0


if __name__ == "__main__":
    run_command(Path(__file__).name, __name__)
