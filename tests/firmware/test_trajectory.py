"""The smooth trajectories against closed forms and against their own limits."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_sim.autopilot.smooth_trajectory import (
    Axis,
    PathLimits,
    PathSegment,
    SmoothTrajectory,
    braking_speed,
    synchronise,
)

LIMITS = PathLimits(5.0, 3.0, 1.5, 3.0, 4.0, 3.0, 4.0, 2.0, 0.8, 2.0, 0.5)
"""PX4's defaults."""

TICK_S = 0.004
ROUNDING = 1.005
"""Axes that are slowed down for one another overshoot a speed by this at most."""

SPEEDS = st.floats(-10.0, 10.0)


def fly(path: SmoothTrajectory, leg: PathSegment, seconds: float) -> np.ndarray:
    """Follow a trajectory exactly; return (n, 9) positions, velocities and accelerations."""
    rows = []
    for _ in range(round(seconds / TICK_S)):
        path.advance(path.position, leg, LIMITS, TICK_S)
        rows.append((*path.position, *path.velocity, *path.acceleration))
    return np.array(rows)


def test_a_step_of_the_speed_in_closed_form() -> None:
    """v / a + a / j seconds and v / 2 as mean speed, where the acceleration limit is reached."""
    axis = Axis()
    axis.plan(4.0, 2.0, 5.0)
    assert axis.duration_s == pytest.approx(4.0 / 2.0 + 2.0 / 5.0)
    axis.advance(axis.duration_s)
    assert axis.velocity == pytest.approx(4.0)
    assert axis.acceleration == pytest.approx(0.0, abs=1e-9)
    assert axis.position == pytest.approx(2.0 * 2.4)
    axis.advance(1.0)
    assert axis.position == pytest.approx(2.0 * 2.4 + 4.0)


def test_a_small_step_does_not_reach_the_acceleration_limit() -> None:
    axis = Axis()
    axis.plan(0.2, 2.0, 5.0)
    assert axis.duration_s == pytest.approx(2.0 * math.sqrt(0.2 / 5.0))
    axis.advance(0.5 * axis.duration_s)
    assert axis.acceleration == pytest.approx(math.sqrt(0.2 * 5.0))


@given(SPEEDS, SPEEDS, st.floats(-3.0, 3.0), st.floats(0.0, 5.0))
def test_any_plan_ends_at_its_speed_without_acceleration(
    start: float, end: float, acceleration: float, longer: float
) -> None:
    axis = Axis()
    axis.restart(0.0, start)
    axis.acceleration = acceleration
    axis.plan(end, 3.0, 4.0)
    quickest = axis.duration_s
    axis.advance(quickest)
    assert axis.velocity == pytest.approx(end, abs=1e-6)
    assert abs(axis.acceleration) < 1e-6
    stretched = Axis()
    stretched.restart(0.0, start)
    stretched.plan(end, 3.0, 4.0)
    wanted = stretched.duration_s + longer
    stretched.stretch(wanted)
    stretched.advance(wanted)
    if stretched.duration_s > 0.0:
        assert stretched.velocity == pytest.approx(end, abs=1e-6)


def test_axes_that_start_together_arrive_together() -> None:
    axes = [Axis(), Axis(), Axis()]
    for axis, speed in zip(axes, (4.0, -1.0, 0.1), strict=True):
        axis.plan(speed, 3.0, 4.0)
    longest = axes[0].duration_s
    synchronise(axes)
    assert [axis.duration_s for axis in axes] == pytest.approx([longest] * 3)


@given(st.floats(0.01, 50.0), st.floats(1.0, 5.0), st.floats(1.0, 20.0), st.floats(0.0, 3.0))
def test_the_braking_speed_can_be_braked(
    distance: float, acceleration: float, jerk: float, final: float
) -> None:
    v = braking_speed(distance, acceleration, jerk, final)
    needed = (v * v - final * final) / (2.0 * acceleration) + v * 2.0 * acceleration / jerk
    assert v == final or needed == pytest.approx(distance)


@pytest.mark.parametrize(
    "target", [(12.0, 6.0, -10.0), (0.5, 0.0, -3.0), (-30.0, 5.0, 4.0), (0.0, 0.0, -12.0)]
)
def test_a_target_is_reached_within_all_limits(target: tuple[float, float, float]) -> None:
    path = SmoothTrajectory()
    rows = fly(path, PathSegment(target), 25.0)
    assert path.position == pytest.approx(target, abs=0.02)
    assert np.abs(rows[-1, 3:]).max() < 0.02
    assert np.hypot(rows[:, 3], rows[:, 4]).max() <= LIMITS.cruise_m_s * ROUNDING
    assert rows[:, 5].max() <= LIMITS.down_m_s * ROUNDING
    assert -rows[:, 5].min() <= LIMITS.up_m_s * ROUNDING
    assert np.abs(rows[:, 6:8]).max() <= LIMITS.acceleration_m_s2 + 1e-6
    jerk = np.diff(rows[:, 6:], axis=0) / TICK_S
    assert np.abs(jerk).max() <= LIMITS.jerk_m_s3 * (1.0 + 1e-6)
    beyond = rows[:, :3] @ np.array(target) / np.linalg.norm(target) - np.linalg.norm(target)
    assert beyond.max() < 0.1, "no overshoot"


def test_a_long_leg_is_cruised() -> None:
    """Most of 100 m is flown at 5 m/s: PX4 takes 100 / 5 plus acceleration and braking."""
    path = SmoothTrajectory()
    rows = fly(path, PathSegment((100.0, 0.0, 0.0)), 30.0)
    assert np.median(rows[:, 3]) == pytest.approx(5.0, abs=0.01)
    arrived = float(np.argmax(rows[:, 0] > 99.0)) * TICK_S
    assert 22.0 < arrived < 25.0


def test_a_corner_is_rounded_without_a_stop() -> None:
    path = SmoothTrajectory()
    corner, end = (30.0, 0.0, 0.0), (30.0, 30.0, 0.0)
    slowest = math.inf
    for _ in range(round(12.0 / TICK_S)):
        path.advance(path.position, PathSegment(corner, (0.0, 0.0, 0.0), end), LIMITS, TICK_S)
        if path.position[0] > 1.0:
            slowest = min(slowest, path.velocity[0])
        if math.dist(path.position, corner) < LIMITS.acceptance_m:
            break
    assert 1.0 < slowest < 3.0
    fly(path, PathSegment(end, corner), 15.0)
    assert path.position == pytest.approx(end, abs=0.05)


def test_the_trajectory_waits_for_a_vehicle_that_is_held_back() -> None:
    path = SmoothTrajectory()
    for _ in range(2000):
        path.advance((0.0, 0.0, 0.0), PathSegment((50.0, 0.0, 0.0)), LIMITS, TICK_S)
    assert path.position[0] <= LIMITS.error_m
