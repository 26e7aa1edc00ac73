"""The failure detector's motors: FD_ACT_*, by the currents that the speed controllers report.

Source: PX4 1.16, FailureDetector::updateMotorStatus. What it does about controllers that stop to
report is left out: here they never do.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from airl_mav.core.constants import US_PER_MS
from firmware_sim.autopilot.esc import current_a


class Undercurrent(NamedTuple):
    """When a motor draws too little."""

    throttle: float
    """FD_ACT_MOT_THR: it is looked at above this command 0..1."""
    per_throttle_a: float
    """FD_ACT_MOT_C2T: it has to draw this times its command [A]."""
    lasting_ms: float
    """FD_ACT_MOT_TOUT: it has failed after so long."""


class MotorFailure:
    """Motors that draw too little current for what they are told; for good, while armed."""

    def __init__(self) -> None:
        """Begin with all of them healthy."""
        self.failed = False
        """Whether one of them has."""
        self._since_us: dict[int, int] = {}

    def take(
        self,
        time_us: int,
        told: Sequence[float],
        outputs: Sequence[float],
        limits: Undercurrent,
    ) -> None:
        """Look at all motors.

        Args:
            time_us: When [µs].
            told: What each is told, 0..1.
            outputs: What each does, as its speed controller reports it.
            limits: When one draws too little.
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
        """Forget it all: the vehicle is disarmed."""
        self.failed = False
        self._since_us.clear()
