"""The companion's lockstep clock: simulated time advances only while the companion sleeps."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import TypeAlias

from airl_mav.core.clock import Clock
from companion.watchdog import Watchdog

Sleep: TypeAlias = "Callable[[int, threading.Event | None], None]"
"""Gives the turn back until a simulated time [µs], or until the event is set; returns with the next
turn, which may come earlier."""


class Abandoned(BaseException):
    """Raised when the scheduler is gone; not an Exception, to pass handlers of failures."""


class ConductedClock:
    """Simulated time of a companion in lockstep, and the watchdog's guard. Implements `Clock`.

    Only sleeping takes simulated time, so deadlines can only pass there.
    """

    def __init__(self, clock: Clock, sleep: Sleep) -> None:
        """Take the simulated time, which the scheduler advances, and what gives the turn back."""
        self._clock = clock
        self._sleep = sleep
        self._watchdog: Watchdog | None = None

    def time_us(self) -> int:
        """Return the present simulated time [µs]."""
        return self._clock.time_us()

    def sleep_until(self, time_us: int, interrupt: threading.Event | None = None) -> None:
        """Sleep until simulated `time_us` [µs], or until `interrupt` is set."""
        while self.time_us() < time_us and not (interrupt is not None and interrupt.is_set()):
            watchdog = self._watchdog
            due_us = None if watchdog is None else watchdog.due_us
            wake_us = time_us if due_us is None else min(time_us, due_us)
            if wake_us > self.time_us():
                self._sleep(wake_us, interrupt)
            if watchdog is not None and due_us is not None and self.time_us() >= due_us:
                watchdog.look()

    def start(self, watchdog: Watchdog) -> None:
        """Check a watchdog's deadlines from now on."""
        self._watchdog = watchdog

    def stop(self) -> None:
        """Stop watching."""
        self._watchdog = None
