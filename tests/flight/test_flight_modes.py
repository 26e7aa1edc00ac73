"""Corners of arming, take-off, return and setpoints, flown in simulated time."""

from __future__ import annotations

import math

import numpy as np
import pytest

from airl_mav.core.frames import geodetic_to_local, quat_yaw
from firmware_sim.autopilot.autopilot_state import Arming, Result, Setpoint
from firmware_sim.autopilot.commander import FlightPhase
from firmware_sim.autopilot.flight_modes import Mode
from firmware_sim.mavlink.codec import dialect
from firmware_sim.mavlink.streams.status import heartbeat
from tests.support.flight_rig import NAN, Rig, flight, quad, velocity_setpoint

STILL = velocity_setpoint(0.0, 0.0, 0.0)


def away(rig: Rig, north: float = 0.0, east: float = 0.0) -> float:
    """Return the true horizontal distance from a place [m]."""
    return float(np.hypot(rig.truth.position[0] - north, rig.truth.position[1] - east))


def disarmed(rig: Rig) -> bool:
    return rig.ap.flight.phase < FlightPhase.GROUND


def test_loss_on_the_ground_starts_no_flight() -> None:
    for action in (0, 3, 4, 5):
        with flight(5, parameters={"COM_OBL_RC_ACT": action}) as rig:
            rig.boot()
            rig.go_offboard(STILL)
            assert rig.ap.arm(force=False) is Result.ACCEPTED
            rig.run(1.0)
            rig.stream(None)
            rig.until(lambda: disarmed(rig), 15.0)
            assert rig.said("Failsafe activated") < rig.said("Disarmed by auto preflight")
            assert rig.height < 0.01


def test_arming_before_convergence_is_refused() -> None:
    with flight(0) as rig:
        rig.tick()
        assert rig.ap.state().status.arming is Arming.BOOT
        assert rig.ap.arm(force=True) is Result.TEMPORARILY_REJECTED
        assert not math.isnan(rig.said("Arming denied: Resolve system health failures first"))


def test_a_late_take_off_is_not_cut_short() -> None:
    """The vehicle spools up when the ten seconds end: motors that turn are no standing."""
    with flight(0) as rig:
        rig.arm()
        rig.run(9.5)
        rig.ap.takeoff(2.0)
        rig.until(lambda: rig.mode is Mode.HOLD, 12.0)
        rig.until(lambda: rig.height > 1.5, 6.0)


@pytest.mark.parametrize(
    "share", [0.5, *(pytest.param(s, marks=pytest.mark.nightly) for s in (0.65, 0.8, 1.25)), 1.45]
)
def test_a_vehicle_of_another_weight_than_its_parameters_say(share: float) -> None:
    """MPC_THR_HOVER matches the profile; the true mass is `share` of the profile's mass."""
    body = quad().body
    wrong = {"mass_kg": share * body.mass_kg}
    with flight(0, vehicle=quad(body=wrong)) as rig:
        rig.arm()
        rig.ap.takeoff(2.5)
        rig.until(lambda: rig.mode is Mode.HOLD, 15.0)
        rig.run(5.0)
        assert abs(rig.height - 2.5) < 0.4
        assert rig.ap.set_mode(Mode.LAND) is Result.ACCEPTED
        rig.until(lambda: disarmed(rig), 20.0)
        assert rig.height < 0.01


def test_taking_off_right_after_landing() -> None:
    with flight(0) as rig:
        rig.take_off(1.5, settle_s=1.0)
        rig.ap.set_mode(Mode.LAND)
        rig.until(lambda: rig.ap.flight.phase is FlightPhase.GROUND, 20.0)
        rig.run(1.0)
        rig.ap.takeoff(1.5)
        rig.until(lambda: rig.mode is Mode.HOLD, 12.0)
        rig.until(lambda: rig.height > 1.0, 6.0)


def test_arming_in_the_tick_of_the_disarming_starts_the_clock_anew() -> None:
    with flight(0) as rig:
        rig.arm()
        rig.until(lambda: disarmed(rig), 12.0)
        assert rig.ap.arm(force=False) is Result.ACCEPTED
        rig.run(9.9)
        assert not disarmed(rig)


@pytest.mark.parametrize("home_north", [pytest.param(0.0, marks=pytest.mark.nightly), 12.0])
def test_return_flies_home_and_lands(home_north: float) -> None:
    """Home is where the vehicle was armed, also on its second flight."""
    with flight(2, parameters={"RTL_RETURN_ALT": 8.0, "COM_DISARM_LAND": 0.2}) as rig:
        home = np.zeros(2)
        if home_north:
            rig.take_off(1.5, settle_s=0.0)
            rig.go_offboard(velocity_setpoint(4.0, 0.0, 0.0))
            rig.until(lambda: rig.truth.position[0] > home_north, 10.0)
            rig.ap.set_mode(Mode.LAND)
            rig.until(lambda: disarmed(rig), 20.0)
            rig.ap.set_mode(Mode.HOLD)
            home = rig.truth.position[:2].copy()
        rig.take_off(2.0, settle_s=0.0)
        rig.go_offboard(velocity_setpoint(1.0, 4.0, 0.0))
        rig.run(4.0)
        rig.stream(None)
        out = away(rig, *home)
        assert out > 10.0
        assert rig.ap.state().destination is None
        assert rig.ap.set_mode(Mode.RETURN) is Result.ACCEPTED
        rig.tick()
        above = rig.ap.state().destination
        assert above is not None
        assert away(rig, *above[:2]) < 1.0
        rig.until(lambda: rig.height > 7.5, 20.0)
        assert away(rig, *home) > 0.8 * out, "climbs first"
        rig.until(lambda: disarmed(rig), 60.0)
        assert away(rig, *home) < 0.6
        assert rig.height < 0.05


def test_home_can_be_moved_to_where_the_vehicle_is() -> None:
    with flight(2, parameters={"RTL_RETURN_ALT": 4.0}) as rig:
        rig.take_off(3.0, settle_s=0.0)
        rig.go_offboard(velocity_setpoint(4.0, 0.0, 0.0))
        rig.run(4.0)
        rig.stream(STILL)
        rig.run(2.0)
        assert rig.ap.set_home(None) is Result.ACCEPTED
        home = rig.truth.position.copy()
        rig.stream(velocity_setpoint(0.0, 4.0, 0.0))
        rig.run(4.0)
        rig.stream(None)
        rig.ap.set_mode(Mode.RETURN)
        rig.until(lambda: disarmed(rig), 60.0)
        assert away(rig, *home[:2]) < 0.8


def test_home_follows_a_vehicle_that_has_landed_elsewhere() -> None:
    with flight(2) as rig:
        rig.take_off(1.5, settle_s=0.0)
        rig.go_offboard(velocity_setpoint(4.0, 0.0, 0.0))
        rig.run(2.0)
        begun = rig.ap.state().home
        rig.ap.set_mode(Mode.LAND)
        rig.until(lambda: rig.ap.flight.phase is FlightPhase.GROUND, 30.0)
        assert rig.ap.state().home == begun
        rig.until(lambda: disarmed(rig), 5.0)
        home, origin = rig.ap.state().home, rig.ap.state().origin
        assert home is not None
        assert origin is not None
        assert away(rig, *geodetic_to_local(home, origin)[:2]) < 0.5


def test_a_setpoint_that_leaves_an_axis_open_hovers() -> None:
    with flight(0) as rig:
        rig.take_off(3.0, settle_s=1.0)
        rig.go_offboard(velocity_setpoint(NAN, 1.0, 0.0))
        rig.run(3.0)
        assert rig.mode is Mode.OFFBOARD
        assert np.abs(rig.truth.velocity).max() < 0.15


def test_heading_is_held_when_none_is_commanded() -> None:
    with flight(0) as rig:
        rig.take_off(3.0, settle_s=1.0)
        rig.go_offboard(velocity_setpoint(0.0, 0.0, 0.0, yaw=1.0))
        rig.run(4.0)
        rig.stream(velocity_setpoint(1.0, 0.0, 0.0, yaw=NAN))
        rig.run(6.0)
        assert quat_yaw(rig.truth.quaternion) == pytest.approx(1.0, abs=0.05)


def test_positions_are_flown_to() -> None:
    with flight(0) as rig:
        rig.take_off(3.0, settle_s=1.0)
        rig.go_offboard(Setpoint(np.array([3.0, -2.0, -5.0]), np.full(3, NAN), 0.0, NAN))
        rig.run(10.0)
        assert away(rig, 3.0, -2.0) < 0.4
        assert rig.height == pytest.approx(5.0, abs=0.4)


def test_speed_is_limited() -> None:
    with flight(0) as rig:
        rig.take_off(3.0, settle_s=0.0)
        rig.go_offboard(velocity_setpoint(30.0, 0.0, 0.0))
        rig.run(8.0)
        assert rig.ap.state().setpoint.velocity[0] == pytest.approx(12.0)  # MPC_XY_VEL_MAX
        assert 9.0 < rig.truth.velocity[0] < 12.9
        assert rig.height == pytest.approx(3.0, abs=1.0)


def test_clients_are_told_whether_the_present_mode_can_be_armed() -> None:
    """HEARTBEAT and SYS_STATUS: a running PX4 1.16 says UNINIT in Return and Land."""
    with flight(0) as rig:
        rig.boot()
        rig.run(0.3)
        assert rig.ap.state().health.armable
        rig.ap.set_mode(Mode.LAND)
        rig.run(0.3)
        assert not rig.ap.state().health.armable
        assert heartbeat(rig.ap.state())[4] == dialect.MAV_STATE_UNINIT
        rig.ap.set_mode(Mode.HOLD)
        rig.run(0.3)
        assert heartbeat(rig.ap.state())[4] == dialect.MAV_STATE_STANDBY
