"""The due times of a link's streams, in integer microseconds of simulated time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from heapq import heapify, heapreplace

from airl_mav.core.constants import TICK_US

OFF = 0
"""Interval of a stream that is not sent."""


class StreamScheduler:
    """Intervals and due times of one link's streams.

    A stream keeps its phase: the next due time is the last one plus the interval, not the time it
    was sent, so rates are exact over any span. First due times are staggered by one tick each, so
    that the slow streams do not all fall into the same tick. A stream is due at most once per
    call; one that fell behind skips what it missed.
    """

    def __init__(self, names: Sequence[str], default_us: Mapping[str, int]) -> None:
        """Start at simulated time 0 with the default intervals [µs].

        The order of the names is that within a tick; one without a default is off.
        """
        self._names = tuple(names)
        self._index = {name: i for i, name in enumerate(self._names)}
        self._default = [default_us.get(name, OFF) for name in self._names]
        self._interval = list(self._default)
        self._heap: list[tuple[int, int]] = []
        """Due time [µs] and index of each stream that is on."""
        self._rebase_pending = False
        self._rebase(0)

    def interval_us(self, name: str) -> int:
        """Return a stream's interval [µs], `OFF` when it is not sent."""
        return self._interval[self._index[name]]

    def default_us(self, name: str) -> int:
        """Return a stream's default interval [µs], `OFF` when it is off by default."""
        return self._default[self._index[name]]

    def set_interval(self, name: str, interval_us: int, now_us: int) -> None:
        """Send a stream every `interval_us` [µs] from `now_us` on, or stop it (`OFF`)."""
        if interval_us < 0:
            raise ValueError(f"interval_us={interval_us}: must be >= 0")
        index = self._index[name]
        if interval_us == self._interval[index]:
            return
        self._interval[index] = interval_us
        self._heap = [entry for entry in self._heap if entry[1] != index]
        if interval_us != OFF:
            self._heap.append((now_us, index))
        heapify(self._heap)

    def restart(self) -> None:
        """Keep the intervals, take the time base from the next `due` call (it may have jumped)."""
        self._rebase_pending = True

    def due(self, now_us: int) -> list[str]:
        """Return the streams to send at `now_us` [µs] and plan their next time."""
        if self._rebase_pending:
            self._rebase(now_us)
        heap = self._heap
        names: list[str] = []
        while heap and heap[0][0] <= now_us:
            due_us, index = heap[0]
            interval = self._interval[index]
            next_us = due_us + interval
            if next_us <= now_us:
                next_us = now_us + interval - (now_us - due_us) % interval
            heapreplace(heap, (next_us, index))
            names.append(self._names[index])
        return names

    def _rebase(self, now_us: int) -> None:
        self._rebase_pending = False
        self._heap = [
            (now_us + index * TICK_US % interval, index)
            for index, interval in enumerate(self._interval)
            if interval != OFF
        ]
        heapify(self._heap)
