"""Offboard setpoints beyond velocity, flown as a PX4 was seen to fly them."""

from __future__ import annotations

import math

import numpy as np
import pytest

from airl_mav.control.demand import KIND_US, AttitudeDemand, RateDemand
from airl_mav.core.constants import TICK_US, US_PER_S
from airl_mav.core.frames import quat_yaw
from firmware_sim.autopilot.autopilot_state import Setpoint
from firmware_sim.autopilot.flight_modes import Mode
from tests.support.flight_rig import NAN, Rig, flight, velocity_setpoint

NOTHING = np.full(3, NAN)
STILL = velocity_setpoint(0.0, 0.0, 0.0)


def attitude(rig: Rig, demand: AttitudeDemand | RateDemand, seconds: float) -> None:
    """Command an attitude or rates at 20 Hz, once its kind is followed: before that the same thrust
    without tilt or turn."""
    rig.stream(None)
    level: AttitudeDemand | RateDemand = RateDemand((0.0, 0.0, 0.0), demand.thrust)
    if isinstance(demand, AttitudeDemand):
        level = AttitudeDemand((1.0, 0.0, 0.0, 0.0), 0.0, demand.thrust)
    for wanted, time_s in ((level, KIND_US / US_PER_S), (demand, seconds)):
        for _ in range(round(time_s * 20.0)):
            rig.ap.offer_attitude(wanted, rig.sim.time_us)
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

        # Rejected setpoints are no sign of life, and the failsafe reports the error.
        rig.stream(None)
        for _ in range(30):
            rig.ap.refuse_setpoint("SET_POSITION_TARGET_LOCAL_NED invalid", rig.sim.time_us)
            rig.run(0.05)
        assert rig.ap.flight.mode is Mode.RETURN
        assert rig.said("Offboard setpoints refused: SET_POSITION_TARGET_LOCAL_NED invalid") > 0.0


def test_another_kind_of_setpoint_is_followed_half_a_second_later() -> None:
    """PX4 publishes its control mode twice a second: measured."""
    turn = RateDemand((0.0, 0.0, 1.0), 0.5)
    with flight(0) as rig:
        rig.take_off(5.0, settle_s=0.5)
        rig.go_offboard(STILL)
        rig.stream(None)
        asked_us = rig.sim.time_us
        while rig.ap.state().rate_setpoint[2] != 1.0:
            rig.ap.offer_attitude(turn, rig.sim.time_us)
            rig.run(TICK_US / US_PER_S)
        # Its mode was published right now: that is when it is looked at, and not before.
        assert rig.sim.time_us - asked_us <= KIND_US + TICK_US
        rig.stream(STILL)
        rig.run(0.45)
        turning = [rig.truth.angular_velocity[2]]
        rig.run(3.0)
        turning.append(rig.truth.angular_velocity[2])
        assert turning == pytest.approx([1.0, 0.0], abs=0.15)


def test_entering_offboard_follows_the_newest_kind_at_once() -> None:
    turn = RateDemand((0.0, 0.0, 1.0), 0.5)
    with flight(0) as rig:
        rig.take_off(5.0, settle_s=0.5)
        rig.ap.offer_attitude(turn, rig.sim.time_us)
        rig.ap.set_mode(Mode.OFFBOARD)
        for _ in range(20):
            rig.ap.offer_attitude(turn, rig.sim.time_us)
            rig.run(0.01)
        assert rig.truth.angular_velocity[2] > 0.3
