"""The vertical movements of the automatic modes: closed forms, and PX4's own take-off."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from airl_mav.core.constants import TICK_US
from firmware_sim.autopilot.climb import Climb, ClimbLimits
from firmware_sim.autopilot.flight_modes import Mode
from firmware_sim.autopilot.smooth_trajectory import braking_speed
from firmware_sim.engine.record import SETTLING
from tests.support.flight_rig import flight

GENTLE = ClimbLimits(1.5, 0.5, 4.0)
BRISK = ClimbLimits(3.0, 4.0, 4.0)

PX4_EVERY_S = 0.5
PX4_HEIGHT_M = (0.16, 0.47, 0.92, 1.32, 1.67, 1.94, 2.04, 2.13)
PX4_CLIMB_M_S = (0.43, 0.80, 0.88, 0.75, 0.66, 0.32, 0.18, 0.20)
"""Truth of the shipped quad under PX4 1.16 alpha, take-off to 2.5 m, from 0.1 m above its place on
the floor: mean of two flights (`airl-sitl --firmware px4 --episodes 2`)."""


@given(
    distance=st.floats(0.0, 100.0),
    acceleration=st.floats(0.2, 15.0),
    jerk=st.floats(1.0, 80.0),
)
def test_the_braking_speed_can_be_braked(distance: float, acceleration: float, jerk: float) -> None:
    """v v / 2a at full deceleration, and 2 v a / jerk to build it up, fill the distance."""
    v = braking_speed(distance, acceleration, jerk)
    covered = v * v / (2.0 * acceleration) + 2.0 * v * acceleration / jerk
    assert covered == pytest.approx(distance, rel=1e-6, abs=1e-6)


@pytest.mark.parametrize("limits", [GENTLE, BRISK])
@pytest.mark.parametrize("way", [7.0, -7.0, 0.4])
def test_a_climb_keeps_its_limits_and_arrives(limits: ClimbLimits, way: float) -> None:
    climb = Climb()
    climb.aim(way, 0.0, math.inf, 0.0, (limits, limits, limits))
    climb.restart(0.0)
    speeds, heights = [], []
    for tick in range(round(25e6 / TICK_US)):
        climb.fly(SETTLING, tick * TICK_US)
        speeds.append(climb.speed_m_s)
        heights.append(climb.height_m)
    assert np.max(np.abs(speeds)) <= limits.speed_m_s + 1e-9
    steps = np.abs(np.diff(speeds)) / (TICK_US * 1e-6)
    assert steps.max() <= limits.acceleration_m_s2 * (1.0 + 1e-9)
    assert heights[-1] == pytest.approx(way, abs=0.01)
    beyond = np.max(np.array(heights) * math.copysign(1.0, way)) - abs(way)
    assert beyond < 0.02


def test_take_off_follows_px4s() -> None:
    with flight(3) as rig:
        rig.arm()
        floor = rig.height
        rig.ap.takeoff(2.5)
        rig.until(lambda: rig.height > floor + 0.1, 10.0)
        flown = []
        for _ in PX4_HEIGHT_M:
            flown.append((rig.height - floor, -float(rig.truth.velocity[2])))
            rig.run(PX4_EVERY_S)
        heights, climbs = np.array(flown).T
        # Remaining differences: 0.1 s at each change of speed, and the estimation error.
        np.testing.assert_allclose(heights, np.array(PX4_HEIGHT_M) - 0.06, atol=0.12)
        np.testing.assert_allclose(climbs, PX4_CLIMB_M_S, atol=0.15)
        assert rig.mode is Mode.HOLD
