"""Time budget of a tick for MAVLink that can wait: arrivals and bulk transfers.

A tick is late where this takes too long. In the time that is left before the next tick it makes
nothing late, so there is more room for it there.
"""

from __future__ import annotations

from airl_mav.core.clock import Clock
from airl_mav.core.constants import TICK_US

LISTEN_US = TICK_US // 8
"""Longest time of a tick that goes into what arrives on one link [µs of the pacing clock]. What is
left waits for the next tick."""

IDLE_LISTEN_US = TICK_US // 4
"""Longest time that goes, beside that, into what arrives on all links while nothing else is to do
before the next tick [µs of the pacing clock]. A flood must leave the companion, on the same host,
some of the processor."""

BULK_RESERVE_US = TICK_US // 8
"""Bulk transfers stop so long before the next tick [µs of the pacing clock]: what arrives is read
then."""


class TickTime:
    """The time before the next tick, for all links together."""

    def __init__(self, clock: Clock | None) -> None:
        """Take the pacing clock; None: nobody waits for a tick, and all may take any time."""
        self.clock = clock
        self.next_us = 0
        """When the next tick begins, in simulated time [µs]."""
        self.idle_us = IDLE_LISTEN_US
        """What may still go into listening before that [µs]."""

    def renew(self, next_us: int) -> None:
        """Begin another tick's time, which ends with the tick at simulated `next_us` [µs]."""
        self.next_us = next_us
        self.idle_us = IDLE_LISTEN_US

    def is_short(self) -> bool:
        """Return whether the next tick is so near that bulk transfers have to wait."""
        return self.clock is not None and self.clock.time_us() > self.next_us - BULK_RESERVE_US


class ListeningTime:
    """The part of a tick's time that goes into what arrives on one link."""

    def __init__(self, tick: TickTime) -> None:
        self._tick = tick
        self._tick_us = tick.next_us
        self._left_us = LISTEN_US
        self._looked_us = 0

    def renew(self) -> None:
        """Begin another tick: what arrives may take its time again."""
        self._left_us = LISTEN_US

    def begin(self) -> bool:
        """Begin to listen, in another tick with its own time; return whether that is bounded."""
        tick = self._tick
        if tick.clock is None:
            return False
        if self._tick_us != tick.next_us:
            self._tick_us, self._left_us = tick.next_us, LISTEN_US
        self._looked_us = tick.clock.time_us()
        return True

    def left(self) -> bool:
        """Count the time since the last look; return whether there is time for more."""
        tick = self._tick
        if tick.clock is None:
            return True
        now_us = tick.clock.time_us()
        spent_us, self._looked_us = now_us - self._looked_us, now_us
        idle = now_us < tick.next_us
        if idle and tick.idle_us > 0:
            tick.idle_us -= spent_us
        else:
            self._left_us -= spent_us
        return self._left_us > 0 or (idle and tick.idle_us > 0)
