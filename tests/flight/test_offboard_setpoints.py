"""Offboard setpoints beyond velocity, flown as a PX4 was seen to fly them."""

from __future__ import annotations

import math

import numpy as np
import pytest

from airl_mav.control.demand import AttitudeDemand, RateDemand
from airl_mav.core.frames import quat_yaw
from firmware_sim.autopilot.autopilot_state import Mode, Setpoint
from tests.support.flight_rig import NAN, Rig, flight, velocity_setpoint

NOTHING = np.full(3, NAN)
STILL = velocity_setpoint(0.0, 0.0, 0.0)


def attitude(rig: Rig, demand: AttitudeDemand | RateDemand, seconds: float) -> None:
    """Command an attitude or rates at 20 Hz."""
    rig.stream(None)
    for _ in range(round(seconds * 20.0)):
        rig.ap.offer_attitude(demand, rig.sim.time_us)
        rig.run(0.05)


def settle(rig: Rig) -> None:
    rig.stream(STILL)
    rig.run(3.0)
    assert np.linalg.norm(rig.truth.velocity) < 0.3


def test_every_kind_of_setpoint() -> None:
    with flight(0) as rig:
        rig.take_off(8.0, settle_s=0.5)
        rig.go_offboard(STILL)
        hover = rig.ap.state().thrust_setpoint

        # An acceleration alone: 1 m/s² for 2 s, drag takes some.
        rig.stream(Setpoint(NOTHING, NOTHING, 0.0, NAN, acceleration=np.array([1.0, 0.0, 0.0])))
        rig.run(2.0)
        assert 1.2 < rig.truth.velocity[0] < 2.1
        assert abs(rig.truth.velocity[1]) < 0.2
        settle(rig)

        # Mixed: a height, an eastward speed.
        place = np.array([NAN, NAN, -6.0])
        rig.stream(Setpoint(place, np.array([0.0, 1.0, NAN]), 0.0, NAN))
        rig.run(4.0)
        assert rig.truth.velocity[1] == pytest.approx(1.0, abs=0.1)
        assert rig.height == pytest.approx(6.0, abs=0.4)
        settle(rig)

        # 10 degrees nose down.
        pitch = math.radians(-10.0)
        q = (math.cos(pitch / 2.0), 0.0, math.sin(pitch / 2.0), 0.0)
        attitude(rig, AttitudeDemand(q, 0.0, hover / math.cos(pitch)), 1.5)
        w, x, y, z = rig.truth.quaternion
        assert math.asin(2.0 * (w * y - z * x)) == pytest.approx(pitch, abs=0.02)
        assert rig.truth.velocity[0] > 1.5
        assert abs(rig.truth.velocity[2]) < 0.5
        assert rig.mode is Mode.OFFBOARD
        settle(rig)

        # 40 degrees a second about yaw.
        before = quat_yaw(rig.truth.quaternion)
        attitude(rig, RateDemand((0.0, 0.0, math.radians(40.0)), hover), 1.0)
        assert math.degrees(quat_yaw(rig.truth.quaternion) - before) == pytest.approx(38.0, abs=5.0)
        settle(rig)

        # Refused setpoints are no sign of life, and the failsafe says what was wrong.
        rig.stream(None)
        for _ in range(30):
            rig.ap.refuse_setpoint("SET_POSITION_TARGET_LOCAL_NED invalid", rig.sim.time_us)
            rig.run(0.05)
        assert rig.ap.flight.mode is Mode.POSITION
        assert rig.said("Offboard setpoints refused: SET_POSITION_TARGET_LOCAL_NED invalid") > 0.0
