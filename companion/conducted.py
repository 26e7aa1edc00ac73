"""Lockstep clock of the companion: simulated time advances only while the companion sleeps."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import NamedTuple, TypeAlias

from airl_mav.core.clock import Clock
from companion.link_interface import Due, Quiet
from companion.watchdog import Watchdog


class Poll(NamedTuple):
    """Condition checked at an interval."""

    every_us: int
    due: Due
    quiet_us: Quiet | None = None
    """Time without required checks while `due` is False; None = check at every interval."""


Sleep: TypeAlias = "Callable[[int, threading.Event | None, Poll | None], None]"
"""Function that returns the turn to the scheduler until `wake_us` [µs], an event, or while a poll
is not due."""


class Abandoned(BaseException):
    """The scheduler is lost; derived from BaseException to bypass handlers of failures."""


class ConductedClock:
    """Simulated clock of a companion in lockstep, advanced only by sleeping, and watchdog guard."""

    def __init__(self, clock: Clock, sleep: Sleep) -> None:
        """Set the clock, which the scheduler advances, and the function that returns the turn."""
        self._clock = clock
        self._sleep = sleep
        self._watchdog: Watchdog | None = None

    def time_us(self) -> int:
        """Return the present simulated time [µs]."""
        return self._clock.time_us()

    def sleep_until(self, time_us: int, interrupt: threading.Event | None = None) -> None:
        """Sleep until simulated `time_us` [µs], or until `interrupt` is set."""
        # Each pass may end early at the watchdog's time.
        while self.time_us() < time_us and not (interrupt is not None and interrupt.is_set()):
            watchdog = self._watchdog
            due_us = None if watchdog is None else watchdog.due_us
            wake_us = time_us if due_us is None else min(time_us, due_us)
            if wake_us > self.time_us():
                self._sleep(wake_us, interrupt, None)
            if watchdog is not None and due_us is not None and self.time_us() >= due_us:
                # The watchdog has no thread in lockstep: it runs here, at its exact simulated
                # time.
                watchdog.look()

    def poll(self, every_us: int, due: Due, quiet_us: Quiet) -> None:
        """Sleep for one interval [µs] or several, until a condition must be checked."""
        wake_us = self.time_us() + every_us
        # With a watchdog, its times limit each sleep, so one interval at a time.
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
