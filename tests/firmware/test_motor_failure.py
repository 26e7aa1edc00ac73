"""Motor faults: slow and unequal motors against closed forms, and failure detection."""

from __future__ import annotations

import math
import struct

import numpy as np
import pytest

from airl_mav.core.constants import TICK_S
from airl_mav.vehicle.airframe import Airframe, lag, settle, steady_speed
from firmware_sim.addons.fault_injection.failing_parts import slowed, weakened
from firmware_sim.autopilot.failsafes.detectors import MotorFailure, Undercurrent
from firmware_sim.autopilot.flight_modes import Mode
from firmware_sim.interfaces import ActuatorControls
from firmware_sim.mavlink.telemetry import payload
from tests.firmware.test_fault_parts import witnessed
from tests.support.flight_rig import flight, quad

AIRFRAME = Airframe.from_profile(quad())
LIMITS = Undercurrent(0.2, 2.0, 100.0)
HEALTHY = (0.5, 0.5, 0.5, 0.5)


@pytest.mark.parametrize("factor", [1.0, 4.0, 20.0])
def test_a_slow_motor_has_its_time_constant(factor: float) -> None:
    """From rest, s(t) = s_inf (1 - exp(-t / (k tau))); the others are as fast as ever."""
    command, seconds = 0.4, 0.2
    _, simulation = witnessed(f"motor3 slow {factor}x", seconds=seconds, motors=command)
    settled, tau = steady_speed(command, AIRFRAME.thrust_curve), AIRFRAME.rotor_time_constant
    speeds = simulation.plant.rotor_speeds
    for motor, k in enumerate((1.0, 1.0, factor, 1.0)):
        expected = settled * (1.0 - math.exp(-seconds / (k * tau)))
        assert speeds[motor] == pytest.approx(expected, rel=1e-6)


def test_a_slow_motor_brakes_as_slowly() -> None:
    """After a stop: s(t) = s(0) exp(-t / (k tau)), from a healthy rotor at the slowed command."""
    factor, ticks, speed = 10.0, 25, 0.9
    stop = ActuatorControls(0, (0.0,) * 4, armed=True)
    share = lag(AIRFRAME, TICK_S)
    for _ in range(ticks):
        told = slowed(stop, {0: factor}, (speed,) * 4, share, AIRFRAME.thrust_curve)
        assert told.motors[1:] == stop.motors[1:]
        speed = settle(speed, told.motors[0], AIRFRAME, share)
    tau = factor * AIRFRAME.rotor_time_constant
    assert speed == pytest.approx(0.9 * math.exp(-ticks * TICK_S / tau), rel=1e-9)


@pytest.mark.parametrize("share", [-0.3, 0.2])
def test_a_mismatch_is_a_constant_share_of_thrust(share: float) -> None:
    _, simulation = witnessed(f"motor2 mismatch {share}", seconds=1.0, motors=0.4)
    speeds = np.array(simulation.plant.rotor_speeds)
    assert speeds[1] ** 2 / speeds[0] ** 2 == pytest.approx(1.0 + share, rel=1e-6)


def test_no_motor_gives_more_than_its_greatest_thrust() -> None:
    full = ActuatorControls(0, (1.0, 1.0, 1.0, 1.0), armed=True)
    assert weakened(full, {0: 1.5}, AIRFRAME.thrust_curve).motors[0] == pytest.approx(1.0)


def seen(outputs: tuple[float, ...], told: tuple[float, ...], until_ms: int) -> bool:
    """Return whether the detector has seen a failure, looking every 4 ms."""
    detector = MotorFailure()
    for now_ms in range(0, until_ms + 1, 4):
        detector.take(now_ms * 1000, told, outputs, LIMITS)
    return detector.failed != 0


@pytest.mark.parametrize(
    ("output", "told", "until_ms", "failed"),
    [
        (0.0, 0.5, 100, False),
        (0.0, 0.5, 104, True),
        # Command too low for the check: the motor may be stopped.
        (0.0, 0.2, 500, False),
        # 1 A plus 15 A times the command: healthy from 2 A times the command.
        (0.06, 0.96, 500, True),
        (0.07, 0.96, 500, False),
    ],
)
def test_a_motor_that_draws_too_little_has_failed(
    output: float, told: float, until_ms: int, failed: bool
) -> None:
    outputs, commands = (0.5, output, 0.5, 0.5), (0.5, told, 0.5, 0.5)
    assert seen(outputs, commands, until_ms) is failed


def test_it_has_failed_until_disarmed_and_a_moment_counts_for_nothing() -> None:
    detector = MotorFailure()
    for now_ms in range(0, 400, 4):
        standing = now_ms % 80 < 40
        outputs = (0.0 if standing else 0.5, 0.5, 0.5, 0.5)
        detector.take(now_ms * 1000, HEALTHY, outputs, LIMITS)
    assert not detector.failed
    for now_ms in range(400, 600, 4):
        detector.take(now_ms * 1000, HEALTHY, (0.0, 0.5, 0.5, 0.5), LIMITS)
    detector.take(600_000, HEALTHY, HEALTHY, LIMITS)
    assert detector.failed
    detector.rest()
    assert not detector.failed


@pytest.mark.parametrize("enabled", [True, False])
def test_a_motor_that_stops_in_flight_is_told_and_acted_on(enabled: bool) -> None:
    parameters = {"COM_ACT_FAIL_ACT": 2, "COM_FAIL_ACT_T": 0.0, "FD_ACT_EN": int(enabled)}
    with flight(faults=("motor1 off at hold",), parameters=parameters) as rig:
        rig.arm()
        rig.ap.takeoff(5.0)
        rig.until(lambda: rig.mode is Mode.HOLD, 20.0)
        began_s = rig.time_s
        rig.run(0.4)
        assert (rig.mode is Mode.LAND) is enabled
        status = payload("ESC_STATUS", rig.ap.state()) or b""
        rpm, current_a = struct.unpack_from("<8xi28xf", status.ljust(57, b"\0"))
        assert rpm == 0
        assert current_a == 0.0
        if enabled:
            after_s = rig.said("Preflight Fail: Motor failure detected") - began_s
            assert 0.1 < after_s < 0.25, "FD_ACT_MOT_TOUT, and a look at 10 Hz"
        else:
            assert math.isnan(rig.said("Motor failure"))
