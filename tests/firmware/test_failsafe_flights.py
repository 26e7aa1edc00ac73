"""Each failsafe flown to its end: where the vehicle ends up, in which state, how hard it lands."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from firmware_sim.autopilot.autopilot_state import Result
from firmware_sim.autopilot.commander import FlightPhase
from firmware_sim.autopilot.flight_modes import Mode
from firmware_sim.interfaces import ActuatorControls, SensorSample
from tests.support.flight_rig import Rig, flight, velocity_setpoint

SEED = 3
NORTHWARD = velocity_setpoint(2.0, 0.0, 0.0)

GENTLE_M_S = 1.0
"""Bound of the touch-down speed where the descent is controlled: MPC_LAND_SPEED and a margin."""

Change = Callable[[SensorSample], SensorSample]


class Tamper:
    """Changes what the autopilot is shown, from when it is set."""

    def __init__(self, rig: Rig) -> None:
        self.change: Change | None = None
        self._step = rig.ap.step
        rig.step_through(self._tampered)

    def _tampered(self, sample: SensorSample) -> ActuatorControls:
        return self._step(sample if self.change is None else self.change(sample))


def out(rig: Rig, seconds: float = 4.0) -> None:
    """Take off, fly north offboard, then hold there."""
    rig.take_off(5.0, settle_s=0.5)
    rig.go_offboard(NORTHWARD)
    rig.run(seconds)
    rig.stream(None)
    assert rig.ap.set_mode(Mode.HOLD) is Result.ACCEPTED
    rig.run(1.5)
    assert away(rig) > 4.0


def away(rig: Rig) -> float:
    """True distance from where the vehicle started [m]."""
    return float(np.hypot(*rig.truth.position[:2]))


def said(rig: Rig, text: str) -> int:
    return sum(text in told for _, told in rig.texts)


def touch_down(rig: Rig, limit_s: float) -> float:
    """Fly until disarmed; return the maximum descent speed within 0.5 m of the floor [m/s]."""
    fastest = 0.0

    def ended() -> bool:
        nonlocal fastest
        if 0.0 < rig.height < 0.5:
            fastest = max(fastest, float(rig.truth.velocity[2]))
        return rig.ap.flight.phase <= FlightPhase.STANDBY

    rig.until(ended, limit_s)
    return fastest


def until_mode(rig: Rig, mode: Mode, limit_s: float) -> float:
    return rig.until(lambda: rig.mode is mode, limit_s)


def test_ground_station_lost_returns_home() -> None:
    parameters = {"NAV_DLL_ACT": 2, "RTL_RETURN_ALT": 6.0, "COM_DL_LOSS_T": 30}
    with flight(SEED, parameters=parameters) as rig:
        rig.boot()
        assert rig.ap.arm(force=False) is Result.TEMPORARILY_REJECTED
        assert said(rig, "Preflight Fail: No connection to the GCS") > 0
        rig.ap.gcs_heartbeat(rig.sim.time_us)
        out(rig)
        rig.until(lambda: said(rig, "Connection to ground station lost") > 0, 31.0)
        rig.run(0.1)
        assert (rig.mode, rig.ap.flight.failsafe) == (Mode.HOLD, True)
        assert said(rig, "Failsafe activated: entering Hold for 5 seconds") == 1
        assert until_mode(rig, Mode.RETURN, 6.0) == pytest.approx(4.9, abs=0.1)
        # The link is back: the return continues.
        rig.ap.gcs_heartbeat(rig.sim.time_us)
        assert touch_down(rig, 60.0) < GENTLE_M_S
        assert away(rig) < 1.0
        assert said(rig, "Disarmed by landing") == 1


def test_fence_breach_holds_and_lets_the_pilot_out() -> None:
    with flight(SEED) as rig:
        out(rig)
        rig.ap.parameters.set("GF_MAX_HOR_DIST", 4.0)
        rig.run(0.5)
        assert (rig.mode, rig.ap.flight.failsafe) == (Mode.HOLD, True)
        assert said(rig, "Geofence: exceeding maximum distance to Home") == 1
        rig.stream(NORTHWARD)
        rig.tick()
        assert rig.ap.set_mode(Mode.OFFBOARD) is Result.ACCEPTED
        rig.run(0.5)
        assert (rig.mode, rig.ap.flight.failsafe) == (Mode.OFFBOARD, False)


def without_gps(sample: SensorSample) -> SensorSample:
    return sample._replace(gps=None)


def test_gps_lost_descends_after_dead_reckoning() -> None:
    """PX4: EKF2_NOAID_TOUT of dead reckoning, then no position: Hold gives way to Descend."""
    with flight(SEED) as rig:
        tamper = Tamper(rig)
        out(rig)
        place = rig.truth.position
        tamper.change = without_gps
        lost_s = rig.time_s
        until_mode(rig, Mode.DESCEND, 8.0)
        assert 4.8 <= rig.time_s - lost_s <= 5.2
        assert said(rig, "GNSS data fusion stopped") == 1
        assert rig.ap.flight.failsafe
        assert np.linalg.norm((rig.truth.position - place)[:2]) < 3.0, "dead reckoning holds"
        assert rig.ap.set_mode(Mode.RETURN) is Result.TEMPORARILY_REJECTED
        assert said(rig, "Switching to Return is currently not available") == 1
        assert touch_down(rig, 40.0) < GENTLE_M_S
        assert said(rig, "Disarmed by landing") == 1


def test_gps_regained_in_time_is_flown_on() -> None:
    with flight(SEED) as rig:
        tamper = Tamper(rig)
        out(rig)
        place = rig.truth.position
        tamper.change = without_gps
        rig.run(4.0)
        tamper.change = None
        rig.run(6.0)
        assert (rig.mode, rig.ap.flight.failsafe) == (Mode.HOLD, False)
        assert said(rig, "GNSS data fusion started") == 1
        assert np.linalg.norm(rig.truth.position - place) < 3.0


def test_baro_and_compass_lost_are_told_and_flown_on() -> None:
    with flight(SEED) as rig:
        tamper = Tamper(rig)
        out(rig)
        tamper.change = lambda sample: sample._replace(mag=None, pressure_hpa=None)
        height = rig.height
        rig.run(20.0)
        for text in (
            "MAG #0 failed: TIMEOUT!",
            "BARO #0 failed: TIMEOUT!",
            "Preflight Fail: No valid data from Compass 0",
            "Preflight Fail: No valid data from Baro 0",
        ):
            assert said(rig, text) == 1, text
        assert (rig.mode, rig.ap.flight.failsafe) == (Mode.HOLD, False)
        assert rig.height == pytest.approx(height, abs=1.0)
        assert rig.ap.set_mode(Mode.LAND) is Result.ACCEPTED
        assert touch_down(rig, 40.0) < GENTLE_M_S
        # On the ground it is not armed again.
        assert rig.ap.arm(force=False) is Result.TEMPORARILY_REJECTED


def test_a_stuck_barometer_is_not_believed() -> None:
    with flight(SEED) as rig:
        tamper = Tamper(rig)
        rig.take_off(5.0, settle_s=0.5)
        held = rig.ap.state().pressure_hpa

        def stuck(sample: SensorSample) -> SensorSample:
            return sample if sample.pressure_hpa is None else sample._replace(pressure_hpa=held)

        tamper.change = stuck
        rig.run(3.0)
        assert said(rig, "BARO #0 failed: STALE!") == 1
        assert rig.ap.set_mode(Mode.LAND) is Result.ACCEPTED
        assert touch_down(rig, 40.0) < GENTLE_M_S + 0.3
        assert said(rig, "Disarmed by landing") == 1


def test_a_stuck_gyro_terminates() -> None:
    with flight(SEED) as rig:
        tamper = Tamper(rig)
        rig.take_off(3.0, settle_s=0.5)
        held = rig.ap.state().gyro
        tamper.change = lambda sample: sample._replace(gyro=held)
        took = until_mode(rig, Mode.TERMINATION, 3.0)
        assert 1.0 <= took <= 1.1, "the failsafes look at 10 Hz"
        assert said(rig, "GYRO #0 failed: STALE!") == 1
        rig.tick()
        assert rig.ap.state().motors == (0.0, 0.0, 0.0, 0.0)
        # Lockdown needs no estimate, only stopped motors.
        rig.until(lambda: rig.ap.flight.phase <= FlightPhase.STANDBY, 6.0)
        assert said(rig, "Disarmed by lockdown") == 1


@pytest.mark.parametrize(
    ("breaker", "ends"), [(0, Mode.TERMINATION), (121212, Mode.HOLD)], ids=["armed", "breaker"]
)
def test_a_flip_terminates_where_that_is_switched_on(breaker: int, ends: Mode) -> None:
    """A motor that is lost flips the vehicle: PX4's failure detector sees 60 degrees."""
    with flight(SEED, parameters={"CBRK_FLIGHTTERM": breaker}) as rig:
        rig.take_off(8.0, settle_s=0.5)
        step = rig.ap.step

        def crippled(sample: SensorSample) -> ActuatorControls:
            controls = step(sample)
            return controls._replace(motors=(0.0, *controls.motors[1:]))

        rig.step_through(crippled)
        rig.until(lambda: said(rig, "Preflight Fail: Attitude failure") > 0, 5.0)
        rig.run(0.2)
        assert rig.mode is ends
        assert said(rig, "Preflight Fail: Attitude failure") == 1


def test_termination_is_for_good() -> None:
    with flight(SEED) as rig:
        rig.boot()
        assert rig.ap.terminate() is Result.DENIED
        rig.take_off(2.5, settle_s=0.0)
        assert rig.ap.terminate() is Result.ACCEPTED
        rig.tick()
        assert rig.ap.state().motors == (0.0, 0.0, 0.0, 0.0)
        assert rig.ap.set_mode(Mode.HOLD) is Result.TEMPORARILY_REJECTED
        stopped = rig.until(lambda: rig.ap.flight.phase is not FlightPhase.AIR, 6.0)
        assert stopped == pytest.approx(5.0, abs=0.02)
        assert said(rig, "Disarmed by lockdown") == 1
        assert rig.ap.arm(force=True) is Result.TEMPORARILY_REJECTED
        assert said(rig, "Preflight Fail: Flight termination active") >= 1
        assert rig.mode is Mode.TERMINATION


def test_modes_that_cannot_be_armed_in() -> None:
    """PX4: Return and Land are refused, with the reason."""
    with flight(SEED) as rig:
        rig.boot()
        for mode in (Mode.RETURN, Mode.LAND):
            assert rig.ap.set_mode(mode) is Result.ACCEPTED
            assert rig.ap.arm(force=False) is Result.TEMPORARILY_REJECTED
        assert said(rig, "Preflight Fail: Mode not suitable for arming") == 2
        assert said(rig, "Arming denied: Resolve system health failures first") == 2
        for mode in (Mode.HOLD, Mode.TAKEOFF):
            assert rig.ap.set_mode(mode) is Result.ACCEPTED
            assert rig.ap.arm(force=False) is Result.ACCEPTED
            assert rig.ap.disarm(force=False) is Result.ACCEPTED


@pytest.mark.nightly
def test_flight_time_over_returns() -> None:
    with flight(SEED, parameters={"COM_FLT_TIME_MAX": 12.0, "RTL_RETURN_ALT": 5.0}) as rig:
        out(rig, 3.0)
        rig.until(lambda: rig.mode is Mode.RETURN, 20.0)
        assert said(rig, "Maximum flight time reached") == 1
        assert touch_down(rig, 60.0) < GENTLE_M_S
        assert away(rig) < 1.0


def test_without_any_sensor_it_never_gets_ready_nor_grows() -> None:
    """A sensor that is missing from the start: no alignment, bounded memory."""
    with flight(SEED) as rig:
        tamper = Tamper(rig)
        tamper.change = without_gps
        rig.run(25.0)
        assert rig.ap.flight.phase is FlightPhase.BOOT
        assert rig.ap.record["rest_count"].max() <= 2600
        assert rig.ap.arm(force=False) is Result.TEMPORARILY_REJECTED
        assert said(rig, "Preflight Fail: ekf2 missing data") == 1
        tamper.change = None
        rig.boot()
        assert rig.ap.arm(force=False) is Result.ACCEPTED
