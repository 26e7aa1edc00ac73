"""Clocks. All other modules use a Clock and never read the time directly.

All times are integer microseconds of simulated time. `SimClock` is advanced by its owner;
`WallClock` follows the host's monotonic clock, multiplied by a speed factor.
"""

from __future__ import annotations

import threading
import time
from datetime import datetime, timezone
from typing import Protocol

from airl_mav.core.constants import US_PER_S

NS_PER_US = 1_000


def processor_time_us() -> int:
    """Return the processor time used by all threads of this process [µs]."""
    return time.process_time_ns() // NS_PER_US


class Clock(Protocol):
    """Interface of a source of simulated time."""

    def time_us(self) -> int:
        """Return the current simulated time [µs]."""

    def sleep_until(self, time_us: int, interrupt: threading.Event | None = None) -> None:
        """Wait until `time_us()` reaches a time [µs], or until `interrupt` is set."""


class SimClock:
    """Simulated time advanced by its owner: unpaced, deterministic."""

    def __init__(self, start_us: int = 0) -> None:
        self._now_us = start_us

    def time_us(self) -> int:
        """Return the current simulated time [µs]."""
        return self._now_us

    def advance(self, step_us: int) -> None:
        """Advance time by `step_us` [µs]. Raises ValueError for a negative step."""
        if step_us < 0:
            raise ValueError(f"time cannot go back: step_us={step_us}")
        self._now_us += step_us

    def sleep_until(self, time_us: int, interrupt: threading.Event | None = None) -> None:
        """Jump to `time_us` [µs]; no effect if it has passed or `interrupt` is set."""
        if interrupt is None or not interrupt.is_set():
            self._now_us = max(self._now_us, time_us)


class WallClock:
    """Simulated time = (host monotonic - epoch) x speed.

    CLOCK_MONOTONIC is shared by all processes of a host, so two processes with the same epoch
    and speed read the same simulated time.
    """

    def __init__(self, speed: float = 1.0, epoch_ns: int | None = None) -> None:
        """Start at simulated time 0 now, or at another clock's epoch (host monotonic time [ns]).

        `speed` is simulated seconds per wall second, > 0.
        """
        if not speed > 0.0:
            raise ValueError(f"speed={speed}: must be > 0")
        self.speed = speed
        self.epoch_ns = time.monotonic_ns() if epoch_ns is None else epoch_ns

    def time_us(self) -> int:
        """Return the current simulated time [µs]."""
        return int((time.monotonic_ns() - self.epoch_ns) * self.speed) // NS_PER_US

    def wall_seconds_until(self, time_us: int) -> float:
        """Return the wall seconds left until simulated `time_us`; negative if it has passed."""
        target_ns = self.epoch_ns + time_us * NS_PER_US / self.speed
        return (target_ns - time.monotonic_ns()) / (US_PER_S * NS_PER_US)

    def sleep_until(self, time_us: int, interrupt: threading.Event | None = None) -> None:
        """Sleep until simulated `time_us` [µs], or until `interrupt` is set."""
        while (wait_s := self.wall_seconds_until(time_us)) > 0.0:
            if interrupt is None:
                time.sleep(wait_s)
            elif interrupt.wait(wait_s):
                return

    def slip(self, step_us: int) -> None:
        """Skip `step_us` [µs] of simulated time: the host could not keep up."""
        self.epoch_ns += int(step_us * NS_PER_US / self.speed)


GREATEST_GAP_US = 2 * US_PER_S
"""Maximum interval counted as waiting: after a longer one the process was stopped [wall µs]."""


class Patience:
    """Stopwatch of waiting time that excludes time in which the process is stopped."""

    def __init__(self) -> None:
        self._clock = WallClock()
        self._seen_us = 0
        self._waited_us = 0

    def so_far_s(self) -> float:
        """Return the total waiting time [s]. Call more often than `GREATEST_GAP_US`."""
        now_us = self._clock.time_us()
        self._waited_us += min(now_us - self._seen_us, GREATEST_GAP_US)
        self._seen_us = now_us
        return self._waited_us / US_PER_S


def utc_now() -> datetime:
    """Return the calendar time, for names and log headers; never for timing."""
    return datetime.now(timezone.utc)


def since_1970_us(timestamp: str) -> int:
    """Return a calendar time, given in ISO 8601 with its offset from UTC, since 1970 [µs].

    Raises ValueError for an invalid text.
    """
    return round(datetime.fromisoformat(timestamp).timestamp() * US_PER_S)


def utc_us() -> int:
    """Return the calendar time since 1970 [µs], for time stamps only: it may jump."""
    return time.time_ns() // NS_PER_US
