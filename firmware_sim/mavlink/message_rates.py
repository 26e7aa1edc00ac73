"""Message rates of a link: intervals and due times of its streams.

Due times are in integer µs of simulated time.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType

import numpy as np

from airl_mav.core.constants import TICK_US, US_PER_S


def interval_us(rate_hz: float) -> int:
    """Return the interval of a rate [µs]; 0 Hz gives 0 (off)."""
    return round(US_PER_S / rate_hz) if rate_hz > 0.0 else 0


OFF = 0
"""Interval of a disabled stream."""

_NEVER = np.iinfo(np.int64).max
_NONE: Mapping[str, int] = MappingProxyType({})


class StreamScheduler:
    """Scheduler of one link's streams: intervals and due times.

    A stream keeps its phase: the next due time is the last due time plus the interval, so rates are
    exact over any span. First due times are staggered by one tick each, which spreads the slow
    streams over several ticks. A stream is due at most once per call; missed times are skipped.

    Compiled code (`telemetry`) packs the fast streams from the arrays; `due` returns the others.
    """

    def __init__(
        self,
        names: Sequence[str],
        default_us: Mapping[str, int],
        fast: Mapping[str, int] = _NONE,
        every_us: int = 0,
    ) -> None:
        """Start at simulated time 0 with the default intervals [µs].

        Args:
            names: All streams, in their order within a tick.
            default_us: Default intervals; a stream without a default is off.
            fast: Indices of the fast streams in the table of compiled code.
            every_us: Time grid of the slow streams from the first tick [µs]; 0 = any tick.
        """
        self._every_us = every_us or 1
        self._names = tuple(names)
        self._index = {name: i for i, name in enumerate(self._names)}
        self._default = [default_us.get(name, OFF) for name in self._names]
        self.numbers = np.array([fast.get(name, -1) for name in self._names], np.int64)
        """(s,) indices of the fast streams in the table; -1 = a slow stream."""
        self.intervals_us = np.array(self._default, np.int64)
        """(s,) intervals [µs]; `OFF` = disabled."""
        self.due_us = np.zeros(len(self._names), np.int64)
        """(s,) due times of the fast streams [µs]."""
        self._slow_due_us: dict[int, int] = {}
        """Due times of the enabled slow streams [µs], by index."""
        self.fast_us = 0
        """Due time of the next fast stream, or an earlier time [µs]."""
        self._next_us = 0
        """Due time of the next slow stream [µs]."""
        self.quiet: set[str] = set()
        """Slow streams without content when last due: no sensor, no radio."""
        self.wake_us = 0
        """The earlier of both due times [µs]; nothing is due before."""
        self._rebase_pending = False
        self._rebase(0)

    def interval_us(self, name: str) -> int:
        """Return a stream's interval [µs]; `OFF` if disabled."""
        return self.intervals_us.item(self._index[name])

    def default_us(self, name: str) -> int:
        """Return a stream's default interval [µs]; `OFF` if disabled by default."""
        return self._default[self._index[name]]

    def set_interval(self, name: str, interval_us: int, now_us: int) -> None:
        """Send a stream every `interval_us` [µs] from `now_us`, or disable it (`OFF`)."""
        if interval_us < 0:
            raise ValueError(f"interval_us={interval_us}: must be >= 0")
        index = self._index[name]
        if interval_us == self.intervals_us[index]:
            # An unchanged interval keeps its phase.
            return
        self.intervals_us[index] = interval_us
        self._plan(index, now_us)
        # The next call recomputes the due times from here.
        self.wake_us = self._next_us = self.fast_us = min(self.wake_us, now_us)

    def restart(self) -> None:
        """Keep the intervals. The next call sets the time base, which may have jumped."""
        self._rebase_pending = True
        self.wake_us = 0

    def packed(self, next_us: int) -> None:
        """Store the due time of the next fast stream [µs], after packing."""
        self.fast_us = next_us
        self.wake_us = min(next_us, self._next_us)

    def next_slow_us(self, now_us: int) -> float:
        """Return the next time of the slow streams, from `now_us` [µs]. Ignores quiet streams."""
        if self._rebase_pending:
            return now_us
        names, quiet = self._names, self.quiet
        # A stream without content must not wake the server on its account.
        due = [due_us for i, due_us in self._slow_due_us.items() if names[i] not in quiet]
        return self.grid_us(max(now_us, min(due, default=_NEVER)))

    def grid_us(self, time_us: int) -> int:
        """Return the first time on the grid at or after `time_us` [µs]."""
        return TICK_US - (TICK_US - time_us) // self._every_us * self._every_us

    def is_time(self, now_us: int) -> bool:
        """Return True if slow streams may be sent at `now_us` [µs]."""
        return (now_us - TICK_US) % self._every_us == 0

    def due(self, now_us: int) -> list[str]:
        """Return the streams due at `now_us` [µs] and schedule their next time."""
        begins = self._rebase_pending  # the first heartbeat is sent immediately
        if begins:
            self._rebase(now_us)
        if now_us < self._next_us or not (begins or self.is_time(now_us)):
            return []
        plan, names = self._slow_due_us, []
        # In order of the due times; equal times keep the order of the table.
        for due_us, i in sorted([(due_us, i) for i, due_us in plan.items() if due_us <= now_us]):
            interval_us = self.intervals_us.item(i)
            # Advance by whole intervals beyond now: missed times are skipped, the phase stays.
            plan[i] = due_us + interval_us * (1 + (now_us - due_us) // interval_us)
            names.append(self._names[i])
        self._next_us = min(plan.values(), default=_NEVER)
        self.wake_us = min(self.fast_us, self._next_us)
        return names

    def _plan(self, index: int, due_us: int) -> None:
        """Schedule the next time of an enabled stream, or remove a disabled stream."""
        sent = self.intervals_us.item(index) != OFF
        if self.numbers.item(index) >= 0:
            # Compiled code reads `due_us`; the dictionary holds only slow streams.
            self.due_us[index] = due_us if sent else _NEVER
        elif sent:
            self._slow_due_us[index] = due_us
        else:
            self._slow_due_us.pop(index, None)

    def _rebase(self, now_us: int) -> None:
        self._rebase_pending = False
        # Align to the grid that starts at the first tick.
        if self._every_us > 1:
            now_us = TICK_US + (now_us - TICK_US - 1) // self._every_us * self._every_us
        for i, interval_us in enumerate(self.intervals_us.tolist()):
            # The stagger of one tick per stream spreads the first messages.
            self._plan(i, now_us if interval_us == OFF else now_us + i * TICK_US % interval_us)
        self.wake_us = self._next_us = self.fast_us = now_us
