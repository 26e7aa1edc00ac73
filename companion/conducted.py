"""The companion's lockstep clock: simulated time advances only while the companion sleeps."""

from __future__ import annotations

import threading
from typing import NamedTuple, Protocol

from airl_mav.core.clock import Clock
from companion.interfaces import Due, Quiet
from companion.watchdog import Watchdog


class Poll(NamedTuple):
    """A condition that is checked at an interval."""

    every_us: int
    due: Due
    quiet_us: Quiet | None = None
    """Tells, where `due` does not hold, which checks may be left out; None = none."""


class Sleep(Protocol):
    """Gives the turn back."""

    def __call__(
        self, wake_us: int, interrupt: threading.Event | None = None, poll: Poll | None = None
    ) -> None:
        """Return with the next turn; at `wake_us`, or later while a `poll` is not due."""
        ...


class Abandoned(BaseException):
    """Raised when the scheduler is gone; not an Exception, to pass handlers of failures."""


class ConductedClock:
    """Simulated time of a companion in lockstep, which only sleeping takes, and its guard."""

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

    def poll(self, every_us: int, due: Due, quiet_us: Quiet) -> None:
        """Sleep for one interval [µs] or several, until a condition has to be checked."""
        wake_us = self.time_us() + every_us
        if self._watchdog is None:
            self._sleep(wake_us, None, Poll(every_us, due, quiet_us))
        else:
            self.sleep_until(wake_us)

    def start(self, watchdog: Watchdog) -> None:
        """Check a watchdog's deadlines from now on."""
        self._watchdog = watchdog

    def stop(self) -> None:
        """Stop watching."""
        self._watchdog = None
