"""Keep simulated time level with the wall clock, and measure how well that works."""

from __future__ import annotations

import select
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from airl_mav.clock import WallClock

MAX_LAG_US = 200_000
"""Further behind than this, simulated time gives up the difference instead of racing through it:
a burst of ticks would outrun the companion [µs]."""

SPIN_US = 150
"""The last stretch before a tick is polled: select() overshoots by about this much [µs]."""


class Pacer:
    """Waits for each tick's wall time while watching sockets."""

    def __init__(self, clock: WallClock) -> None:
        self._clock = clock
        self._lateness: list[int] = []
        self.slipped_us = 0
        """Simulated time given up because the host could not keep up."""

    def wait(self, tick_us: int, sockets: Sequence[int], readable: Callable[[], None]) -> None:
        """Return at the wall time of simulated `tick_us`; call `readable` when a socket talks.

        What arrives early is handled at once, stamped with its own time, and waits for the tick.
        """
        clock = self._clock
        while (wait_s := clock.wall_seconds_until(tick_us)) > 0.0:
            timeout = max(0.0, wait_s - SPIN_US * 1e-6)
            ready, _, _ = select.select(sockets, [], [], timeout)
            if ready:
                readable()
        late_us = clock.time_us() - tick_us
        if late_us > MAX_LAG_US:
            clock.slip(late_us)
            self.slipped_us += late_us
            late_us = 0
        self._lateness.append(late_us)

    def take_lateness(self) -> NDArray[np.int64]:
        """Return how late each tick began since the last call [µs of simulated time]."""
        lateness = np.array(self._lateness, np.int64)
        self._lateness.clear()
        return lateness
