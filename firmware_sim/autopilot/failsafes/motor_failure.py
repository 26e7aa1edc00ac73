"""Motor failure detector: FD_ACT_*, based on the current reported by speed controllers.

Source: PX4 1.16, FailureDetector::updateMotorStatus. Its timeout for silent speed controllers is
not implemented, as they always report here.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from airl_mav.core.constants import US_PER_MS
from firmware_sim.autopilot.esc import current_a


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
        self.failed = False
        """True if a motor has failed."""
        self._since_us: dict[int, int] = {}

    def take(
        self,
        time_us: int,
        told: Sequence[float],
        outputs: Sequence[float],
        limits: Undercurrent,
    ) -> None:
        """Check all motors.

        Args:
            time_us: Time [µs].
            told: Commands of the motors, 0..1.
            outputs: Outputs of the motors, as reported by the speed controllers.
            limits: Undercurrent thresholds.
        """
        for motor, (throttle, output) in enumerate(zip(told, outputs, strict=True)):
            least_a = throttle * limits.per_throttle_a
            if not (throttle > limits.throttle and current_a(output) < least_a):
                self._since_us.pop(motor, None)
            elif time_us - self._since_us.setdefault(motor, time_us) > (
                limits.lasting_ms * US_PER_MS
            ):
                self.failed = True

    def rest(self) -> None:
        """Reset the detector: the vehicle is disarmed."""
        self.failed = False
        self._since_us.clear()
