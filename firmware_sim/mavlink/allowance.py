"""How much one sender may say: a number of frames a second of simulated time, and a burst."""

from __future__ import annotations

from airl_mav.core.constants import US_PER_S

FRAMES_PER_S = 2_000
"""Frames that one client may send for long: eight times what a setpoint in every tick takes."""

BURST_FRAMES = 500
"""Frames that it may send at once: a ground station asks for that many parameters."""


class Allowance:
    """A generic cell rate algorithm (ITU-T I.371) in integer microseconds of simulated time.

    It counts, and reads no clock, so the same frames at the same simulated times are always
    treated alike.
    """

    def __init__(self, per_s: int = FRAMES_PER_S, burst: int = BURST_FRAMES) -> None:
        """Allow `per_s` frames a second for long, and `burst` at once."""
        self._each_us = US_PER_S // per_s
        self._ahead_us = self._each_us * burst
        self._until_us = 0
        """When everything that was taken is paid for."""

    def left(self, now_us: int) -> bool:
        """Return whether another frame is allowed at simulated `now_us` [µs]."""
        return self._until_us - now_us < self._ahead_us

    def take(self, frames: int, now_us: int) -> None:
        """Count frames that came at simulated `now_us` [µs]."""
        self._until_us = max(self._until_us, now_us) + self._each_us * frames

    def renew(self) -> None:
        """Forget what was taken: simulated time may start anew."""
        self._until_us = 0
