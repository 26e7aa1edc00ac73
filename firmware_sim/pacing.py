"""Pacing of simulated time: by the wall clock, or as fast as possible."""

from __future__ import annotations

import ctypes
import select
from collections.abc import Callable, Sequence
from typing import Protocol

from airl_mav.core import constants, scheduling
from airl_mav.core.clock import NS_PER_US, Clock, SimClock, WallClock

MAX_LAG_US = 200_000
"""Maximum lag to catch up [µs]; a larger lag is skipped: a burst of ticks would outrun the
companion."""

MAX_WAKES = 16
"""Maximum wake-ups by arriving data in the wait for one tick; later data wait for the tick."""

READ_AFTER_S = 300e-6
"""Time before a tick in which arriving data are left until the tick begins, and still used by it.
Handling the data of many clients takes as long, and must not delay the tick [s]."""

PR_SET_TIMERSLACK = 29
"""Option of prctl(2) (linux/prctl.h): maximum wake-up delay of the calling thread [ns]."""


class Arrivals(Protocol):
    """Messages to the flight controller with arrival times known in advance."""

    @property
    def next_us(self) -> float:
        """Simulated time of the next message [µs]; inf = no message."""

    def arrive(self, tick_us: int) -> None:
        """Deliver all messages up to simulated `tick_us` [µs] to the flight controller."""


class Pacing(Protocol):
    """Scheduler of the next tick."""

    slipped_us: int
    """Simulated time skipped because the host could not keep up [µs]."""

    @property
    def clock(self) -> Clock:
        """Simulated time; advances between ticks only when paced by the wall clock."""

    @property
    def epoch_ns(self) -> int | None:
        """Host monotonic time of simulated time 0 [ns]; None = simulated time is not paced."""

    @property
    def quiet_until_us(self) -> float:
        """Simulated time before which only `arrivals` can arrive [µs]; 0 = any tick has input."""

    @property
    def arrivals(self) -> Arrivals | None:
        """Messages that arrive before `quiet_until_us`; None = no messages."""

    def restart(self, tick_us: int) -> None:
        """Set simulated time to `tick_us` [µs]; earlier time belongs to no episode."""

    def wait(self, tick_us: int, sockets: Sequence[int], readable: Callable[[int], object]) -> int:
        """Wait until simulated `tick_us` is due and return the time then [µs].

        When a socket becomes readable earlier, `readable` is called with that time.
        """

    def read_by(self, began_us: int) -> int:
        """Return a time by which the data of a read begun at `began_us` had arrived [µs].

        Never earlier than `began_us` or a time returned before.
        """


class WallPacing:
    """Pacing by the wall clock: every tick runs at its wall time."""

    quiet_until_us = 0.0
    arrivals = None

    def __init__(self, speed: float, behind_us: int = 0) -> None:
        """Set the speed: simulated seconds per wall second, > 0.

        Ticks begin `behind_us` after their time by the clock of other processes [simulated µs].
        Minimizes the timer slack of the calling thread; the default of Linux delays a wake-up by
        up to 50 µs to batch it with others. Requests short scheduler slices, to run before threads
        with longer ones: waiting for a whole foreign slice delays a tick by more than its length.
        """
        ctypes.CDLL(None).prctl(PR_SET_TIMERSLACK, ctypes.c_ulong(1), 0, 0, 0)
        scheduling.ask_for_short_slices()
        self.clock = WallClock(speed)
        self._behind_ns = round(behind_us * NS_PER_US / speed)
        self.slipped_us = 0
        self._stamp_us = 0

    @property
    def epoch_ns(self) -> int:
        """Host monotonic time of simulated time 0 [ns]."""
        return self.clock.epoch_ns - self._behind_ns

    def restart(self, tick_us: int) -> None:
        """Set simulated time to `tick_us` [µs] at the present wall time.

        External firmware boots as fast as possible, far ahead of the wall clock.
        """
        self.clock.slip(self.clock.time_us() - tick_us)
        self._stamp_us = 0

    def wait(self, tick_us: int, sockets: Sequence[int], readable: Callable[[int], object]) -> int:
        """Wait until the wall time of simulated `tick_us`; return the time then [µs].

        Early data are read at once, stamped with their arrival time, and wait for the tick. Data
        of the last `READ_AFTER_S` are read when the tick begins. A tick without data has one wait:
        a second wait costs as much processor time as the rest of the tick.
        Every returned time is read once and checked for lag first. A process that was stopped
        during the wait must not stamp data with a time that is about to be skipped.
        """
        clock = self.clock
        wall_s = 1.0 / (clock.speed * constants.US_PER_S)
        now_us, woken = clock.time_us(), 0
        while now_us < tick_us:
            # A flood of data must not take the processor time that the companion needs.
            reads = woken < MAX_WAKES and (tick_us - now_us) * wall_s > READ_AFTER_S
            ready, _, _ = select.select(
                sockets if reads else (), (), (), (tick_us - now_us) * wall_s
            )
            now_us, woken = clock.time_us(), woken + 1
            if ready and (tick_us - now_us) * wall_s > READ_AFTER_S:
                readable(self._stamp(now_us))
                now_us = clock.time_us()
        if now_us - tick_us > MAX_LAG_US:
            # Return to the due tick, but not to before a time that was already returned.
            resumed_us = max(tick_us, self._stamp_us)
            lost_us = now_us - resumed_us
            clock.slip(lost_us)
            self.slipped_us += lost_us
            now_us = resumed_us
        return self._stamp(now_us)

    def read_by(self, began_us: int) -> int:
        """Return the time now [µs], or `began_us` if the lag since then is large enough to skip.

        A process can be preempted between reading the clock and the sockets: data that arrived in
        between would get a time stamp from before they were sent.
        """
        now_us = self.clock.time_us()
        return self._stamp(now_us if now_us - began_us <= MAX_LAG_US else began_us)

    def _stamp(self, now_us: int) -> int:
        """Return a monotonic time [µs]."""
        self._stamp_us = max(self._stamp_us, now_us)
        return self._stamp_us


class Unpaced:
    """No pacing: simulated time advances as fast as ticks are computed."""

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
        """Set the clock to `tick_us` [µs]; the caller reads the sockets once per tick."""
        del sockets, readable
        self.clock.sleep_until(tick_us)
        return tick_us

    def read_by(self, began_us: int) -> int:
        """Return `began_us`: time does not advance while sockets are read."""
        return began_us
