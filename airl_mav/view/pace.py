"""Pace of a lockstep flight by its viewers: speed, pause, single steps.

Only wall time passes here. The flight stays bit-identical.
"""

from __future__ import annotations

from collections.abc import Callable

from airl_mav.core.clock import WallClock
from airl_mav.core.constants import US_PER_S
from airl_mav.view.ends import ViewEnds
from airl_mav.view.feed import Asked
from airl_mav.view.messages import Steering

REAL_TIME = 1.0
"""The pace of a watched flight in lockstep, unless the scenario has another."""

LOOK_S = 0.1
"""While it is paused, the watchers are listened to for so long at a time [wall s]."""

BEHIND_S = 0.2
"""A flight that falls behind by more does not hurry to catch up [wall s]."""


class Pace:
    """Holds a flight back. Calls come from one thread at a time."""

    def __init__(
        self,
        ends: ViewEnds,
        speed: float | None,
        new_clock: Callable[[float], WallClock] = WallClock,
    ) -> None:
        """Connect to a view; `speed` is the pace until it says otherwise, None: no limit."""
        self._asked = Asked(ends, Steering(speed=speed))
        self._new_clock = new_clock
        self._clock: WallClock | None = None
        self._steps: int | None = None
        self._left = 0
        """Single steps that were asked for and are not done."""
        self._released = False

    def tick(self, time_us: int) -> None:
        """Return when the flight may go on; it is at simulated `time_us` [µs]."""
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
        """A decision was sent: a single step ends here."""
        self._left = max(0, self._left - 1)

    def let_go(self) -> None:
        """Hold the flight back no longer, from any thread."""
        self._released = True

    def close(self) -> None:
        """Disconnect."""
        self._asked.close()

    def _heard(self, asked: Steering) -> Steering:
        if self._steps is None or asked.steps < self._steps or not asked.paused:
            # Of another page, or no longer wanted.
            self._left = 0
        else:
            self._left += asked.steps - self._steps
        self._steps = asked.steps
        return asked
