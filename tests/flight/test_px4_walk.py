"""A real MAVSDK's calls at the built-in autopilot, answered and flown as by a real PX4 1.16."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import pytest

from tests.support.flown_by_mavsdk import flown
from tests.support.px4_walk.row import Row, answered
from tests.support.px4_walk.rows import FLIGHT, GROUND, ROWS
from tests.support.px4_walk.vehicle import Vehicle

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("flight"), pytest.mark.timeout(300)]


@pytest.fixture(scope="module")
def vehicle() -> Iterator[Vehicle]:
    """A vehicle that has booted."""
    with flown(release="1.16") as flight:
        vehicle = Vehicle(flight.companion, pace=flight.at)
        vehicle.until(vehicle.telemetry.health_all_ok, 40.0)
        vehicle.until(lambda: vehicle.telemetry.health().is_armable, 10.0)
        yield vehicle


def differences(rows: Iterable[Row], vehicle: Vehicle) -> list[str]:
    """Make calls; return what differs from PX4."""
    answers = [answered(row, vehicle) for row in rows]
    return [
        f"{answer.row.name}: PX4 {answer.row.expected[0]}, here {answer.outcome} {answer.value}"
        for answer in answers
        if not answer.agrees
    ]


def test_every_call_is_answered_as_by_px4(vehicle: Vehicle) -> None:
    assert differences((row for row in GROUND if not row.slow), vehicle) == []


def test_a_flight_is_flown_as_by_px4(vehicle: Vehicle) -> None:
    assert differences((row for row in FLIGHT if not row.slow), vehicle) == []


@pytest.mark.nightly
def test_what_px4_does_not_answer_is_not_answered_here_either(vehicle: Vehicle) -> None:
    assert differences((row for row in ROWS if row.slow), vehicle) == []


def test_the_rows_have_names_of_their_own() -> None:
    names = [row.name for row in ROWS]
    assert len(names) == len(set(names))
