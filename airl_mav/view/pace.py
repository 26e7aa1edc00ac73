"""Pacing of a lockstep flight by its viewers: speed, pause, single steps.

Pacing affects only wall time. The flight stays bit-identical.
"""

from __future__ import annotations

from collections.abc import Callable

from airl_mav.core.clock import WallClock
from airl_mav.core.constants import US_PER_S
from airl_mav.view.ends import ViewEnds
from airl_mav.view.feed import Asked
from airl_mav.view.messages import Steering

REAL_TIME = 1.0
"""Default speed of a lockstep flight in a view, in simulated seconds per wall second."""

LOOK_S = 0.1
"""Poll timeout for viewers' requests while paused [wall s]."""

BEHIND_S = 0.2
"""Maximum delay that a flight catches up; a longer delay is skipped [wall s]."""


class Pace:
    """Limiter of a flight's speed. Call from one thread at a time."""

    def __init__(
        self,
        ends: ViewEnds,
        speed: float | None,
        new_clock: Callable[[float], WallClock] = WallClock,
    ) -> None:
        """Connect to a view; `speed` applies until the view sets another, None = unlimited."""
        self._asked = Asked(ends, Steering(speed=speed))
        self._new_clock = new_clock
        self._clock: WallClock | None = None
        self._steps: int | None = None
        self._left = 0
        """Single steps requested but not yet executed."""
        self._released = False

    def tick(self, time_us: int) -> None:
        """Block until the flight may continue from simulated `time_us` [µs]."""
        if self._released:
            return
        asked = self._heard(self._asked.newest())
        while asked.paused and not self._left and not self._released:
            self._clock = None
            asked = self._heard(self._asked.newest(LOOK_S))
        if asked.speed is None:
            self._clock = None
            return
        clock = self._clock
        if (
            clock is None
            or clock.speed != asked.speed
            or clock.time_us() - time_us > BEHIND_S * US_PER_S * clock.speed
        ):
            self._clock = clock = self._new_clock(asked.speed)
            clock.epoch_ns -= int(time_us * 1_000 / asked.speed)
        clock.sleep_until(time_us)

    def decided(self) -> None:
        """End a single step: a decision was sent."""
        self._left = max(0, self._left - 1)

    def let_go(self) -> None:
        """Stop limiting the flight; thread-safe."""
        self._released = True

    def close(self) -> None:
        """Disconnect."""
        self._asked.close()

    def _heard(self, asked: Steering) -> Steering:
        if self._steps is None or asked.steps < self._steps or not asked.paused:
            # The first request, the count of another view, or no pause: no step is pending.
            self._left = 0
        else:
            self._left += asked.steps - self._steps
        self._steps = asked.steps
        return asked
