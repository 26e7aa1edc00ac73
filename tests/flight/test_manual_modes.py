"""Stick-controlled modes, Orbit and Follow, in simulated time."""

from __future__ import annotations

import math

import numpy as np
import pytest

from airl_mav.core.frames import quat_yaw
from firmware_sim.autopilot.autopilot_state import Result
from firmware_sim.autopilot.commander import FlightPhase
from firmware_sim.autopilot.flight_modes import Mode
from firmware_sim.autopilot.modes.interface import FollowedTarget, OrbitRequest, Source, Sticks
from tests.support.flight_rig import NAN, Rig, flight, velocity_setpoint

CENTRED = Sticks(0.0, 0.0, 0.0, 0.0)


def fly(rig: Rig, sticks: Sticks, seconds: float) -> None:
    """Hold the sticks for some time; a joystick sends at 25 Hz."""
    for _ in range(round(seconds * 25.0)):
        rig.ap.manual_control(sticks, Source.JOYSTICK, rig.sim.time_us)
        rig.run(0.04)


def ask(rig: Rig, mode: Mode) -> Result:
    return rig.ap.set_mode(mode)


def speed(rig: Rig) -> float:
    return float(np.hypot(*rig.truth.velocity[:2]))


def test_position_from_take_off_to_landing() -> None:
    with flight(0) as rig:
        rig.boot()
        fly(rig, Sticks(0.0, 0.0, -1.0, 0.0), 0.2)
        assert ask(rig, Mode.POSITION) is Result.ACCEPTED
        assert rig.ap.arm(force=False) is Result.ACCEPTED
        fly(rig, Sticks(0.0, 0.0, -1.0, 0.0), 1.0)
        assert rig.ap.flight.phase < FlightPhase.AIR
        fly(rig, Sticks(0.0, 0.0, 1.0, 0.0), 7.0)
        assert rig.ap.flight.phase is FlightPhase.AIR
        assert rig.truth.velocity[2] == pytest.approx(-1.5, abs=0.6), (
            "MPC_TKO_SPEED near the ground"
        )
        fly(rig, CENTRED, 3.0)
        height, place = rig.height, rig.truth.position[:2].copy()
        fly(rig, CENTRED, 3.0)
        assert rig.height == pytest.approx(height, abs=0.15)
        assert np.hypot(*(rig.truth.position[:2] - place)) < 0.3

        # Half forward: expo makes less of it; then it brakes to a stop and stays.
        fly(rig, Sticks(0.0, 0.5, 0.0, 0.0), 4.0)
        wanted = rig.ap.state().setpoint.velocity[0]
        assert 1.0 < wanted < 4.0
        assert rig.truth.velocity[0] == pytest.approx(wanted, abs=0.4)
        fly(rig, CENTRED, 3.5)
        assert speed(rig) < 0.2

        # The yaw stick turns; "right" is then another way.
        fly(rig, Sticks(0.0, 0.0, 0.0, 0.5), 1.0)
        turned = quat_yaw(rig.truth.quaternion)
        assert turned > 0.2
        fly(rig, CENTRED, 1.0)
        held = quat_yaw(rig.truth.quaternion)
        fly(rig, Sticks(0.5, 0.0, 0.0, 0.0), 2.0)
        assert quat_yaw(rig.truth.quaternion) == pytest.approx(held, abs=0.05)
        course = math.atan2(rig.truth.velocity[1], rig.truth.velocity[0])
        assert course == pytest.approx(held + math.pi / 2.0, abs=0.15)

        fly(rig, CENTRED, 2.0)
        fly(rig, Sticks(0.0, 0.0, -1.0, 0.0), 25.0)
        assert rig.ap.flight.phase < FlightPhase.AIR
        assert rig.said("Landing detected") > 0.0


def test_the_modes_need_sticks() -> None:
    """In the air they are refused without them; lost, the vehicle descends, level."""
    with flight(0) as rig:
        rig.take_off(5.0, settle_s=0.0)
        for mode in (Mode.POSITION, Mode.ALTITUDE, Mode.STABILIZED, Mode.ACRO):
            assert ask(rig, mode) is Result.TEMPORARILY_REJECTED
            name = mode.name.title()
            assert rig.said(f"Switching to {name} is currently not available") > 0.0
        rig.ap.manual_control(CENTRED, Source.RADIO, rig.sim.time_us)
        assert ask(rig, Mode.POSITION) is Result.TEMPORARILY_REJECTED, "COM_RC_IN_MODE = 1"
        # Nor do sticks take over from offboard, by default.
        rig.go_offboard(velocity_setpoint(0.0, 0.0, 0.0, yaw=NAN))
        fly(rig, CENTRED, 0.2)
        fly(rig, Sticks(1.0, 0.0, 0.0, 0.0), 0.3)
        assert rig.mode is Mode.OFFBOARD


def test_altitude_stabilized_and_acro() -> None:
    with flight(0) as rig:
        rig.take_off(8.0, settle_s=0.0)
        fly(rig, CENTRED, 0.1)
        assert ask(rig, Mode.ALTITUDE) is Result.ACCEPTED
        height = rig.height
        fly(rig, Sticks(0.3, 0.0, 0.0, 0.0), 1.5)
        assert rig.truth.velocity[1] > 1.0
        assert rig.height == pytest.approx(height, abs=0.4)
        east = rig.truth.velocity[1]
        fly(rig, CENTRED, 1.0)
        assert rig.truth.velocity[1] > 0.5 * east, "nothing brakes it but drag"

        assert ask(rig, Mode.STABILIZED) is Result.ACCEPTED
        fly(rig, Sticks(0.0, 0.5, 0.1, 0.0), 1.0)
        w, x, y, z = rig.truth.quaternion
        pitch = math.asin(2.0 * (w * y - z * x))
        assert math.degrees(pitch) == pytest.approx(-0.5 * 35.0, abs=2.0), "MPC_MAN_TILT_MAX"

        assert ask(rig, Mode.ACRO) is Result.ACCEPTED
        fly(rig, Sticks(0.0, -0.2, 0.1, 0.0), 0.5)
        assert rig.truth.angular_velocity[1] == pytest.approx(math.radians(20.0), abs=0.1)

        # The sticks are put down: Position stops it. Moved in an automatic mode, they take over.
        assert ask(rig, Mode.POSITION) is Result.ACCEPTED
        fly(rig, CENTRED, 3.0)
        assert speed(rig) < 0.4
        ask(rig, Mode.HOLD)
        fly(rig, CENTRED, 0.5)
        assert rig.mode is Mode.HOLD
        fly(rig, Sticks(0.0, 0.8, 0.0, 0.0), 0.2)
        assert rig.ap.flight.mode is Mode.POSITION
        assert rig.said("Pilot took over using sticks") > 0.0


def test_an_orbit() -> None:
    """The walk's orbit on PX4: radius 8 m at 3 m/s flew 8.4 m at 2.9 m/s."""
    with flight(0) as rig:
        rig.take_off(8.0, settle_s=0.0)
        circle = OrbitRequest((10.0, 0.0, -8.0), 8.0, 3.0, 0)
        assert rig.ap.set_mode(Mode.ORBIT, circle) is Result.ACCEPTED
        rig.run(12.0)
        off = rig.truth.position[:2] - np.array([10.0, 0.0])
        assert np.hypot(*off) == pytest.approx(8.0, abs=0.6)
        assert speed(rig) == pytest.approx(3.0, abs=0.3)
        turning = off[0] * rig.truth.velocity[1] - off[1] * rig.truth.velocity[0]
        assert turning > 0.0, "clockwise"
        facing = math.atan2(-off[1], -off[0]) - quat_yaw(rig.truth.quaternion)
        assert abs((facing + math.pi) % (2.0 * math.pi) - math.pi) < 0.3, "it looks at the centre"
        orbit = rig.ap.state().orbit
        assert orbit is not None
        assert (orbit.radius_m, orbit.centre) == (8.0, (10.0, 0.0, -8.0))
        rig.ap.set_mode(Mode.ORBIT, OrbitRequest(radius_m=5000.0))
        assert rig.said("Orbit radius limit exceeded") > 0.0


def test_following_a_walker() -> None:
    """It stays FLW_TGT_DST behind and FLW_TGT_HT above; it waits for a silent one."""
    with flight(0) as rig:
        rig.take_off(5.0, settle_s=0.0)
        assert ask(rig, Mode.FOLLOW) is Result.ACCEPTED
        began, walked = rig.time_s, 0.0
        for _ in range(20 * 5):
            walked = 2.0 * (rig.time_s - began)
            place, pace = (12.0 + walked, 0.0, 0.0), (2.0, 0.0, 0.0)
            rig.ap.follow(FollowedTarget(place, pace, rig.sim.time_us))
            rig.run(0.2)
        assert 12.0 + walked - rig.truth.position[0] == pytest.approx(8.0, abs=1.5)
        assert rig.height == pytest.approx(8.0, abs=0.5)
        assert rig.truth.velocity[0] == pytest.approx(2.0, abs=0.3)
        rig.run(8.0)
        assert speed(rig) < 0.3
