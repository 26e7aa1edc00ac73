"""Detectors with hysteresis and duration over simulated time."""

from __future__ import annotations

import math

from airl_mav.core.constants import US_PER_S
from airl_mav.core.frames import Vector
from airl_mav.core.kernels import kernel
from firmware_sim.autopilot.error_state import Q

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
        roll_max, pitch_max = math.radians(abs(limits_deg[0])), math.radians(abs(limits_deg[1]))
        self.roll = self._roll.update(now_us, lasting_s[0], true=0.0 < roll_max < roll)
        self.pitch = self._pitch.update(now_us, lasting_s[1], true=0.0 < pitch_max < pitch)
        return self.roll or self.pitch
