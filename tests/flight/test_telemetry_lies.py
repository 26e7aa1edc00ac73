"""A man in the middle in lockstep: false telemetry is found before it moves the vehicle."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import telemetry_lies
from telemetry_lies import LIES, UNDETECTABLE, Flown, Lie, LieFlight

from airl_mav.scenario.resolve import ResolvedScenario

SEED = 1
LIE_OF = {lie.name: lie for lie in LIES}


@pytest.fixture(scope="module")
def resolved() -> ResolvedScenario:
    return telemetry_lies.scenario()


@pytest.fixture(scope="module")
def honest(resolved: ResolvedScenario) -> Flown:
    return telemetry_lies.fly(resolved, SEED, None, 0)


def flown(
    resolved: ResolvedScenario, honest: Flown, lie: Lie, phase: str
) -> tuple[Flown, LieFlight, int]:
    """Fly a lie; return the flight, its result and the onset [µs]."""
    onset_us = telemetry_lies.onset_of(phase, honest, resolved.arena_of(SEED).goal_point)
    flight = telemetry_lies.fly(resolved, SEED, lie, onset_us)
    result = telemetry_lies.compared(lie, phase, SEED, honest, flight, onset_us, "")
    return flight, result, onset_us


def test_the_lies_cover_fields_and_kinds() -> None:
    assert len(LIES) == len(LIE_OF) >= 40
    for kind in ("frozen", "jump", "drift", "creep", "mirrored", "NaN", "late", "replayed"):
        assert any(kind in lie.how for lie in LIES), kind
    assert UNDETECTABLE.keys() <= LIE_OF.keys()


@pytest.mark.parametrize(
    ("name", "phase", "note"),
    [
        ("height jumps -100 m", "cruise", "position and velocity have parted by 10"),
        ("height jumps +100 m", "take-off", "the take-off to 2.5 m changed the height by 10"),
        ("north position jumps 10 m", "idle", "position and velocity have parted by 10.0 m"),
        ("depth creeps 1 m/s", "cruise", "position and velocity have parted by 1"),
        ("vertical velocity jumps 5 m/s", "near goal", "position and velocity have parted by"),
        ("roll jumps 180 deg", "cruise", "the vehicle is upside down"),
        ("yaw rate ten turns/s", "cruise", "a body rate of 6"),
        ("heading jumps 90 deg", "cruise", "heading and yaw rate have parted by"),
        ("all telemetry late 1.5 s", "near goal", "its time stamps have moved by -1.5 s"),
        ("position and velocity late 1.5 s", "cruise", "position has not changed for 1.0 s"),
    ],
)
def test_a_lie_is_found_before_it_moves_the_vehicle(
    resolved: ResolvedScenario, honest: Flown, name: str, phase: str, note: str
) -> None:
    flight, result, onset_us = flown(resolved, honest, LIE_OF[name], phase)
    # Two checks a second: the fourth comes up to half a second after the bound.
    assert result.found_s <= telemetry_lies.FOUND_S + 0.5
    assert result.moved_m < telemetry_lies.MOVED_M
    assert result.end == "landed"
    assert any(note in each for each in flight.result.notes), flight.result.notes
    # Up to the onset both flights are equal, bit by bit.
    before = np.count_nonzero(honest.path.time_us < onset_us)
    assert before > 20
    assert np.array_equal(honest.path.position[:before], flight.path.position[:before])


def test_an_error_of_all_values_is_not_found(resolved: ResolvedScenario, honest: Flown) -> None:
    lie = LIE_OF["position and velocity drift north 1 m/s together"]
    _, result, _ = flown(resolved, honest, lie, "cruise")
    assert math.isnan(result.found_s)
    assert result.moved_m > telemetry_lies.MOVED_M
    assert lie.name in UNDETECTABLE


def test_a_landing_does_not_depend_on_telemetry(resolved: ResolvedScenario, honest: Flown) -> None:
    _, result, _ = flown(resolved, honest, LIE_OF["height jumps -100 m"], "landing")
    assert (result.reason, result.end, result.moved_m) == ("goal reached", "landed", 0.0)


def test_a_miss_without_a_reason_is_shown() -> None:
    row = {"found_s": "nan", "moved_m": "3.1", "end": "landed"}
    assert telemetry_lies.is_missed(row)
    assert telemetry_lies.cell([row, row | {"found_s": "1.5"}]) == "1.5 s (1 not); 3.1 m; landed"
    assert not telemetry_lies.is_missed(row | {"found_s": "1.5"})
    assert not telemetry_lies.is_missed(row | {"moved_m": "1.9"})


@pytest.mark.nightly
@pytest.mark.timeout(900)
def test_every_miss_has_a_reason(tmp_path: Path) -> None:
    """A seed of the published matrix, in the phases in which a policy flies."""
    words = ["--seeds", "1", "--phases", "cruise", "near goal", "--out", str(tmp_path)]
    assert telemetry_lies.main(words) == 0
