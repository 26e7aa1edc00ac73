"""Who looks after the watchdog's deadlines: a thread of its own, on the real aircraft."""

from __future__ import annotations

import faulthandler
import threading
from typing import Protocol

from airl_mav.core.clock import Clock
from companion.watchdog import Watchdog

POLL_US = 10_000
"""How often deadlines are looked at [µs]."""

LOOKS = 25
"""So many looks, then the timer that ends a starved process is wound up again."""

STDERR = 2
"""File descriptor for the last words of a process that is ended."""

STARVED_S = 5.0
"""When the thread has not run for so long, the process ends [s of wall time]."""


class Guard(Protocol):
    """Calls a watchdog's `look` in time."""

    def start(self, watchdog: Watchdog) -> None:
        """Begin to watch."""
        ...

    def stop(self) -> None:
        """Stop watching; harmless when it never began."""
        ...


class ThreadGuard:
    """Looks from a thread, and ends the process when that thread is starved."""

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
                faulthandler.dump_traceback_later(STARVED_S, exit=True, file=STDERR)
                for _ in range(LOOKS):
                    if self._done.is_set():
                        return
                    watchdog.look()
                    self._clock.sleep_until(self._clock.time_us() + POLL_US)
        finally:
            faulthandler.cancel_dump_traceback_later()
