"""Failure detectors: hysteresis over simulated time, motors, battery endurance."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from airl_mav.core.constants import US_PER_MS, US_PER_S
from airl_mav.core.frames import Vector
from airl_mav.core.kernels import kernel
from firmware_sim.autopilot.error_state import Q
from firmware_sim.interfaces import BatterySample

RPM = 6_000
"""Motor speed at full command, as reported by the speed controllers [rpm].

Source: PX4 1.16, SimulatorMavlink::send_esc_telemetry. Like PX4, the simulation does not model it.
"""
IDLE_A, SPAN_A = 1.0, 15.0
IDLE_C, SPAN_C = 20.0, 40.0
"""Current [A] and temperature [°C] of a motor at minimum speed, and their rise at full command."""


def current_a(output: float) -> float:
    """Return the current [A] of a healthy motor at this command 0..1."""
    return IDLE_A + SPAN_A * output if output > 0.0 else 0.0


class Undercurrent(NamedTuple):
    """Undercurrent thresholds of a motor."""

    throttle: float
    """FD_ACT_MOT_THR: minimum command 0..1 for the check."""
    per_throttle_a: float
    """FD_ACT_MOT_C2T: minimum current per command [A]."""
    lasting_ms: float
    """FD_ACT_MOT_TOUT: duration until failure [ms]."""


class MotorFailure:
    """Detector of motors with too little current for their command; latched while armed."""

    def __init__(self) -> None:
        """Start with all motors healthy."""
        self.failed = 0
        """Bits of the failed motors."""
        self._since_us: dict[int, int] = {}

    def take(
        self,
        time_us: int,
        commands: Sequence[float],
        outputs: Sequence[float],
        limits: Undercurrent,
    ) -> None:
        """Check all motors.

        Args:
            time_us: Time [µs].
            commands: Commands of the motors, 0..1.
            outputs: Outputs of the motors, as reported by the speed controllers.
            limits: Undercurrent thresholds.
        """
        for motor, (throttle, output) in enumerate(zip(commands, outputs, strict=True)):
            # PX4 expects a minimum current in proportion to the command.
            least_a = throttle * limits.per_throttle_a
            if not (throttle > limits.throttle and current_a(output) < least_a):
                self._since_us.pop(motor, None)
            # The duration counts from the first tick of undercurrent.
            elif time_us - self._since_us.setdefault(motor, time_us) > (
                limits.lasting_ms * US_PER_MS
            ):
                self.failed |= 1 << motor

    def rest(self) -> None:
        """Reset the detector: the vehicle is disarmed."""
        self.failed = 0
        self._since_us.clear()


AVERAGE_S = 50.0
"""Time constant of the mean current [s]."""

_S_PER_H = 3600.0
_MA_PER_A = 1000.0


class Endurance:
    """Estimator of the remaining flight time from the mean current while armed."""

    def __init__(self) -> None:
        self._current_a: float | None = None
        self._time_us = 0

    def update(
        self,
        time_us: int,
        battery: BatterySample,
        capacity_mah: float,
        expected_a: float,
        *,
        armed: bool,
    ) -> float:
        """Return the remaining battery time [s], infinite if the capacity is not set.

        Args:
            time_us: Time of the sample [µs].
            battery: Reading of the power module.
            capacity_mah: BAT1_CAPACITY; 0 or less: not set.
            expected_a: BAT_AVRG_CURRENT, the initial mean.
            armed: True if armed; the mean is only updated while armed.
        """
        if capacity_mah <= 0.0:
            return math.inf
        if self._current_a is None:
            self._current_a = expected_a
        elif armed:
            # Exponential mean for any step: 1 - exp(-dt / tau).
            share = -math.expm1(-(time_us - self._time_us) / (AVERAGE_S * US_PER_S))
            self._current_a += share * (max(battery.current_a, 0.0) - self._current_a)
        self._time_us = time_us
        left_mah = battery.remaining * capacity_mah
        # mAh divided by mA gives hours.
        return left_mah / max(self._current_a * _MA_PER_A, 1e-6) * _S_PER_H


VALID_AFTER_US = US_PER_S
"""Time an estimate must be good again before it counts as valid [µs]."""

HYSTERESIS = 2.5
"""Factor on the required accuracy up to which a valid estimate stays valid."""


class Validity:
    """Validity of an estimate with hysteresis in accuracy and time.

    Source: PX4 1.16, EstimatorChecks::checkPosVelValidity.
    """

    def __init__(self) -> None:
        """Start invalid; the first good estimate is valid immediately."""
        self.valid = False
        self._failed_us: int | None = None

    def update(self, now_us: int, *, good: bool, accuracy: float, needed: float) -> bool:
        """Update with the newest estimate: its standard deviation `accuracy`, limit `needed`."""
        # A valid estimate stays valid up to a wider limit.
        if good and accuracy < (HYSTERESIS * needed if self.valid else needed):
            failed_us = self._failed_us
            self.valid = self.valid or failed_us is None or now_us > failed_us + VALID_AFTER_US
        else:
            self.valid, self._failed_us = False, now_us
        return self.valid


class Lasting:
    """Duration check for a condition."""

    def __init__(self) -> None:
        self.since_us: int | None = None

    def update(self, now_us: int, seconds: float, *, true: bool) -> bool:
        """Return whether the condition has been true at every update for `seconds`."""
        # Any gap restarts the duration.
        if not true:
            self.since_us = None
            return False
        if self.since_us is None:
            self.since_us = now_us
        return now_us - self.since_us >= seconds * US_PER_S


@kernel
def roll_and_pitch(w: float, x: float, y: float, z: float) -> tuple[float, float]:
    """Return the absolute roll and pitch angles of an attitude [rad]."""
    roll = abs(math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y)))
    return roll, abs(math.asin(max(-1.0, min(1.0, 2.0 * (w * y - z * x)))))


class AttitudeFailure:
    """Roll and pitch failure detector: FD_FAIL_R, FD_FAIL_P for FD_FAIL_R_TTRI, _P_TTRI.

    Source: PX4 1.16, FailureDetector::updateAttitudeStatus.
    """

    def __init__(self) -> None:
        self._roll, self._pitch = Lasting(), Lasting()
        self.roll = self.pitch = False

    @property
    def is_calm(self) -> bool:
        """True if both angles were within limits at the newest update."""
        return self._roll.since_us is None and self._pitch.since_us is None

    def update(
        self,
        now_us: int,
        state: Vector,
        limits_deg: tuple[float, float],
        lasting_s: tuple[float, float],
    ) -> bool:
        """Return whether roll or pitch of the nominal state exceeds its limit [deg], 0 = off."""
        roll, pitch = roll_and_pitch(*state[Q : Q + 4].tolist())
        # A limit of 0 disables the check.
        roll_max, pitch_max = math.radians(abs(limits_deg[0])), math.radians(abs(limits_deg[1]))
        self.roll = self._roll.update(now_us, lasting_s[0], true=0.0 < roll_max < roll)
        self.pitch = self._pitch.update(now_us, lasting_s[1], true=0.0 < pitch_max < pitch)
        return self.roll or self.pitch
