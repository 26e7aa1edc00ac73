"""Checks the watchdog's deadlines; on the real aircraft from a thread of its own."""

from __future__ import annotations

import faulthandler
import threading
from typing import Protocol

from airl_mav.core.clock import Clock
from companion.watchdog import Watchdog

POLL_US = 10_000
"""Interval at which deadlines are checked [µs]."""

CHECKS_PER_RESTART = 25
"""Checks between two restarts of the timer that ends a starved process."""

STDERR = 2
"""File descriptor for the traceback of a process that is ended."""

STARVED_S = 5.0
"""The process ends when the thread has not run for this long [wall s]."""

TURNING_STARVED_S = 1.0
"""The same while an attitude or body rates are commanded: MAVSDK repeats them meanwhile, and the
flight controller's failsafe can act only when it no longer does [wall s]."""


class Guard(Protocol):
    """Calls a watchdog's `look` in time."""

    def start(self, watchdog: Watchdog) -> None:
        """Begin to watch."""
        ...

    def stop(self) -> None:
        """Stop watching; harmless when it never began."""
        ...


class ThreadGuard:
    """Checks from a thread, and ends the process when that thread is starved."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._done = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self, watchdog: Watchdog) -> None:
        """Begin to watch."""
        self._thread = threading.Thread(
            target=self._run, args=(watchdog,), name="watchdog", daemon=True
        )
        self._thread.start()

    def stop(self) -> None:
        """Stop watching; harmless when it never began."""
        self._done.set()
        if self._thread is not None:
            self._thread.join()
        faulthandler.cancel_dump_traceback_later()

    def _run(self, watchdog: Watchdog) -> None:
        try:
            while not self._done.is_set():
                starved_s = STARVED_S if watchdog.by_velocity else TURNING_STARVED_S
                faulthandler.dump_traceback_later(starved_s, exit=True, file=STDERR)
                for _ in range(CHECKS_PER_RESTART):
                    if self._done.is_set():
                        return
                    watchdog.look()
                    self._clock.sleep_until(self._clock.time_us() + POLL_US)
        finally:
            faulthandler.cancel_dump_traceback_later()
