"""Validity of ranges: the cases of PX4's own tests (test_SensorRangeFinder.cpp), and others.

PX4 1.16 has no test of its RangeFinderConsistencyCheck; the reference is its definition.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from airl_mav.core.constants import US_PER_S
from firmware_sim.addons.auxiliary_estimation.range_finder import RangeConsistency, RangeSensor
from firmware_sim.interfaces import DistanceReading

LEAST_M, GREATEST_M = 0.5, 10.0


@dataclass(frozen=True)
class Sample:
    time_us: int = 2 * US_PER_S
    range_m: float = 5.0
    quality: int = 100


GOOD = Sample()


def sensor(fog_m: float = 2.0) -> RangeSensor:
    made = RangeSensor()
    made.fog_m = fog_m
    return made


def feed(finder: RangeSensor, sample: Sample, cos_tilt: float = 1.0) -> None:
    """Give it a sample, and let it look at once."""
    give(finder, sample)
    finder.check(sample.time_us, cos_tilt)


def give(finder: RangeSensor, sample: Sample) -> None:
    reading = DistanceReading(sample.range_m, LEAST_M, GREATEST_M, quality=sample.quality)
    finder.take(reading, sample.time_us)


def at_rate(finder: RangeSensor, sample: Sample, duration_us: int, sensor_us: int) -> int:
    """PX4's updateSensorAtRate: looked at every 10 ms. Returns when the last sample was taken."""
    now_us, range_m, taken_us = sample.time_us, sample.range_m, sample.time_us
    for i in range(duration_us // 10_000):
        now_us += 10_000
        if i % (sensor_us // 10_000) == 0:
            range_m += 0.2
            if range_m > GREATEST_M:
                range_m = LEAST_M
            taken_us = now_us
            give(finder, Sample(now_us, range_m, sample.quality))
        finder.check(now_us, 1.0)
    return taken_us


def test_good_data() -> None:
    finder = sensor()
    feed(finder, GOOD)
    assert finder.is_healthy and finder.is_valid and finder.is_regular


@pytest.mark.parametrize(
    ("roll", "pitch", "yaw", "believed"),
    [
        (0.0, 0.0, 0.0, True),
        (0.0, 0.8, 0.0, False),
        (0.0, -0.8, 0.0, False),
        (0.0, 0.7, 1.0, True),
        (0.0, -0.7, 0.0, True),
        (0.8, 0.0, 0.0, False),
        (-0.8, 0.0, 0.0, False),
        (0.7, 0.0, 2.0, True),
        (-0.7, 0.0, 3.0, True),
        (0.5, -0.5, 4.0, True),
        (0.8, -0.8, 4.0, False),
    ],
)
def test_tilt(roll: float, pitch: float, yaw: float, believed: bool) -> None:
    down = Rotation.from_euler("ZYX", [yaw, pitch, roll]).apply([0.0, 0.0, 1.0])
    finder = sensor()
    feed(finder, GOOD, float(down[2]))
    assert finder.is_healthy is believed


@pytest.mark.parametrize("range_m", [GREATEST_M + 0.01, LEAST_M - 0.01])
def test_out_of_range(range_m: float) -> None:
    finder = sensor()
    feed(finder, replace(GOOD, range_m=range_m))
    assert not finder.is_healthy


def test_out_of_date() -> None:
    finder = sensor()
    give(finder, replace(GOOD, time_us=0))
    finder.check(GOOD.time_us, 1.0)
    assert not finder.is_healthy


def test_a_range_that_is_stuck_after_a_time_without() -> None:
    finder, sample, dt = sensor(), replace(GOOD, quality=0), 300_000
    finder.quality_s = 1.0
    for _ in range(11 * US_PER_S // dt):
        feed(finder, sample)
        sample = replace(sample, time_us=sample.time_us + dt)
    assert not finder.is_healthy
    sample = replace(sample, quality=100)
    for _ in range(2 * US_PER_S // dt):
        feed(finder, sample)
        sample = replace(sample, time_us=sample.time_us + dt)
    # Good quality, but constant.
    assert not finder.is_healthy
    for _ in range(2):
        sample = replace(sample, range_m=sample.range_m + 1.0)
        feed(finder, sample)
        sample = replace(sample, time_us=sample.time_us + dt)
    assert finder.is_healthy


def test_quality_has_to_be_good_for_a_while() -> None:
    finder, dt = sensor(), 300_000
    finder.quality_s = 1.0
    feed(finder, replace(GOOD, quality=0))
    assert not finder.is_healthy
    feed(finder, GOOD)
    assert not finder.is_healthy
    sample = GOOD
    for _ in range(US_PER_S // dt + 2):
        feed(finder, sample)
        sample = replace(sample, time_us=sample.time_us + dt)
    assert finder.is_healthy


def test_continuity() -> None:
    finder = sensor()
    at_rate(finder, GOOD, 8 * US_PER_S, 4 * US_PER_S)
    assert not finder.is_valid and not finder.is_regular
    at_rate(finder, GOOD, 500_000, 300_000)
    assert not finder.is_valid
    at_rate(finder, GOOD, 500_000, 300_000)
    assert finder.is_valid


def test_how_far_below_the_ground_is() -> None:
    finder = sensor()
    feed(finder, Sample(US_PER_S, 1.0, 9))
    assert finder.dist_bottom_m == 1.0
    finder.check(US_PER_S, math.cos(-0.35))
    assert finder.dist_bottom_m == pytest.approx(math.cos(0.35))


def test_fog() -> None:
    finder, sensor_us, duration_us = sensor(), 300_000, 2 * US_PER_S
    taken_us = at_rate(finder, GOOD, duration_us, sensor_us)
    assert finder.is_valid
    taken_us = at_rate(finder, Sample(taken_us, 1.0), duration_us, sensor_us)
    assert not finder.is_valid
    taken_us = at_rate(finder, Sample(taken_us, 5.0), duration_us, sensor_us)
    assert finder.is_valid
    # Coming down slowly is no fog.
    range_m = 5.0
    while range_m > LEAST_M:
        taken_us += 10_000
        feed(finder, Sample(taken_us, range_m))
        range_m -= 0.5
    assert finder.is_healthy


def climb(
    check: RangeConsistency,
    seconds: float,
    told_m_s: float,
    flown_m_s: float,
    *,
    sideways: bool = False,
    start_s: float = 1.0,
) -> None:
    """Let ranges grow at one speed while the vehicle is thought to climb at another."""
    for i in range(round(seconds * 20)):
        t = start_s + i / 20
        check.update(
            2.0 + told_m_s * (t - start_s),
            0.05**2,
            -flown_m_s,
            0.01,
            1.0,
            round(t * US_PER_S),
            sideways=sideways,
        )


def test_ranges_that_change_as_the_vehicle_climbs_are_consistent() -> None:
    check = RangeConsistency()
    climb(check, 5.0, 1.0, 1.0)
    assert check.is_consistent
    assert abs(check.mean_ratio) < 1e-6


def test_ranges_that_do_not_move_are_found_in_a_climb_and_believed_again_in_another() -> None:
    check = RangeConsistency()
    climb(check, 10.0, 0.0, 6.0)
    assert not check.is_consistent
    # var = 2 sd^2/dt^2 + 0.01 = 2.01; the ratio is 36/2.01, its mean takes 2 s.
    expected = 36.0 / (2.0 * 0.05**2 * 20**2 + 0.01)
    assert check.ratio == pytest.approx(expected)
    steps = round(10.0 * 20) - 1
    share = 0.05 / (0.05 + 2.0)
    # The vehicle is thought to climb (negative down) and the ranges stay: the innovation is up.
    assert check.mean_ratio == pytest.approx(expected * (1.0 - (1.0 - share) ** steps), rel=1e-6)
    climb(check, 20.0, 0.2, 0.2, start_s=12.0)
    # Too slow for a decision.
    assert not check.is_consistent
    climb(check, 3.0, 1.0, 1.0, start_s=40.0)
    assert check.is_consistent


def test_ground_that_rises_under_a_vehicle_that_moves_over_it_is_no_fault() -> None:
    check = RangeConsistency()
    climb(check, 10.0, 6.0, 0.0, sideways=True)
    assert abs(check.mean_ratio) > 1.0 and check.is_consistent


def test_a_gap_in_the_ranges_is_no_motion() -> None:
    check = RangeConsistency()
    check.update(1.0, 0.01, 0.0, 0.01, 1.0, US_PER_S, sideways=False)
    check.update(9.0, 0.01, 0.0, 0.01, 1.0, 3 * US_PER_S, sideways=False)
    assert check.ratio == 0.0
    assert np.isfinite(check.mean_ratio)
