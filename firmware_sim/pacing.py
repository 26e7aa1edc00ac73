"""How simulated time relates to the wall clock: paced by it, or as fast as possible."""

from __future__ import annotations

import ctypes
import select
from collections.abc import Callable, Sequence
from typing import Protocol

from airl_mav.core.clock import Clock, SimClock, WallClock
from airl_mav.core.constants import US_PER_S
from airl_mav.core.scheduling import ask_for_short_slices

MAX_LAG_US = 200_000
"""A greater lag is given up instead of caught up: a burst of ticks would outrun the companion
[µs]."""

MAX_WAKES = 16
"""So often in one tick is the wait for it broken by what arrives; more waits for the tick."""

READ_AFTER_S = 300e-6
"""What arrives so shortly before a tick is read when it has begun, and taken by it all the same.
What many clients send takes as long to be carried out, and must not make it late [s]."""

PR_SET_TIMERSLACK = 29
"""Option of prctl(2) (linux/prctl.h): how late the kernel may wake the calling thread [ns]."""


class Arrivals(Protocol):
    """Messages to the flight controller whose times are known ahead."""

    @property
    def next_us(self) -> float:
        """Simulated time of the next one [µs]; inf = none."""

    def arrive(self, tick_us: int) -> None:
        """Let the flight controller receive everything up to simulated `tick_us` [µs]."""


class Pacing(Protocol):
    """Decides when the next tick runs."""

    slipped_us: int
    """Simulated time given up because the host could not keep up [µs]."""

    @property
    def clock(self) -> Clock:
        """Simulated time; between ticks it advances only where it is paced by the wall clock."""

    @property
    def epoch_ns(self) -> int | None:
        """Host monotonic time of simulated time 0 [ns]; None when it is not paced."""

    @property
    def quiet_until_us(self) -> float:
        """Simulated time before which only `arrivals` can arrive [µs]; 0 = at any tick."""

    @property
    def arrivals(self) -> Arrivals | None:
        """Messages that arrive before then; None = none."""

    def restart(self, tick_us: int) -> None:
        """Declare that it is simulated `tick_us` now: time before that belongs to no episode."""

    def wait(self, tick_us: int, sockets: Sequence[int], readable: Callable[[int], object]) -> int:
        """Wait until simulated `tick_us` is due and return the time then [µs].

        When a socket becomes readable before, `readable` is called with the time of that.
        """

    def read_by(self, began_us: int) -> int:
        """Return a time by which what was just read had arrived, reading began at `began_us` [µs].

        Never before `began_us`, nor before a time that was handed out.
        """


class WallPacing:
    """Runs every tick at its wall time."""

    quiet_until_us = 0.0
    arrivals = None

    def __init__(self, speed: float) -> None:
        """Take the speed: simulated seconds per wall second, > 0.

        The calling thread is woken as soon as its waits end; by default Linux takes up to 50 µs
        more, to wake several threads at once. Then it runs before what has the processor for
        longer: a tick that waits for a whole slice of somebody else's is late by more than its
        length.
        """
        ctypes.CDLL(None).prctl(PR_SET_TIMERSLACK, ctypes.c_ulong(1), 0, 0, 0)
        ask_for_short_slices()
        self.clock = WallClock(speed)
        self.slipped_us = 0
        self._stamp_us = 0

    @property
    def epoch_ns(self) -> int:
        """Host monotonic time of simulated time 0 [ns]."""
        return self.clock.epoch_ns

    def restart(self, tick_us: int) -> None:
        """Declare that it is simulated `tick_us` now, whatever the wall clock says.

        External firmware boots as fast as possible, far ahead of the wall clock.
        """
        self.clock.slip(self.clock.time_us() - tick_us)
        self._stamp_us = 0

    def wait(self, tick_us: int, sockets: Sequence[int], readable: Callable[[int], object]) -> int:
        """Wait until the wall time of simulated `tick_us`; return the time then [µs].

        What arrives early is handled at once, stamped with its own time, and waits for the tick; in
        the last moments before it (`READ_AFTER_S`) it is left to be read then. A quiet tick
        has one wait: a second one costs as much processor time as all the rest of it.
        Every time handed out is read once and checked for lag first. A process that was stopped
        while it waited must not stamp what has arrived with a time that is about to be given up.
        """
        clock = self.clock
        wall_s = 1.0 / (clock.speed * US_PER_S)
        now_us, woken = clock.time_us(), 0
        while now_us < tick_us:
            # A flood must not keep the processor busy until the tick: what it lacks then is missed
            # by the companion.
            reads = woken < MAX_WAKES and (tick_us - now_us) * wall_s > READ_AFTER_S
            ready, _, _ = select.select(
                sockets if reads else (), (), (), (tick_us - now_us) * wall_s
            )
            now_us, woken = clock.time_us(), woken + 1
            if ready and (tick_us - now_us) * wall_s > READ_AFTER_S:
                readable(self._stamp(now_us))
                now_us = clock.time_us()
        if now_us - tick_us > MAX_LAG_US:
            # Back to the tick that is due, but not behind a time that was handed out.
            resumed_us = max(tick_us, self._stamp_us)
            lost_us = now_us - resumed_us
            clock.slip(lost_us)
            self.slipped_us += lost_us
            now_us = resumed_us
        return self._stamp(now_us)

    def read_by(self, began_us: int) -> int:
        """Return the time now [µs]; `began_us` where so much passed since that it is given up.

        Between its reading of the clock and of the sockets a process can lose the processor: what
        arrived meanwhile would bear a time from before it was sent.
        """
        now_us = self.clock.time_us()
        return self._stamp(now_us if now_us - began_us <= MAX_LAG_US else began_us)

    def _stamp(self, now_us: int) -> int:
        """Return a time that never goes back."""
        self._stamp_us = max(self._stamp_us, now_us)
        return self._stamp_us


class Unpaced:
    """No pacing: simulated time runs as fast as the ticks are computed."""

    epoch_ns = None
    slipped_us = 0
    quiet_until_us = 0.0
    arrivals = None

    def __init__(self) -> None:
        self.clock = SimClock()

    def restart(self, tick_us: int) -> None:
        """Set the clock to `tick_us`."""
        self.clock.sleep_until(tick_us)

    def wait(self, tick_us: int, sockets: Sequence[int], readable: Callable[[int], object]) -> int:
        """Set the clock to `tick_us`; sockets are read once a tick by the caller anyway."""
        del sockets, readable
        self.clock.sleep_until(tick_us)
        return tick_us

    def read_by(self, began_us: int) -> int:
        """Return `began_us`: time stands still while sockets are read."""
        return began_us
