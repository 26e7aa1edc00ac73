"""Reactions to a silent decision loop, camera or link, and the guard that calls them in time.

MAVSDK repeats the last setpoint at 20 Hz, so a hung policy would keep the vehicle moving and
prevent the offboard-loss failsafe. Three lines of defence:

1. If a decision is overdue, the watchdog zeroes the velocity.
2. Without a decision after that, it leaves offboard and the flight controller holds.
3. If a policy holds Python's interpreter lock, a C-level timer ends the process and the
   offboard-loss failsafe acts.

In lockstep, `ConductedClock` is the guard: simulated time advances only while the companion sleeps.
"""

from __future__ import annotations

import faulthandler
import threading
from collections.abc import Callable
from typing import NamedTuple, Protocol, TypeAlias

from airl_mav.core.clock import Clock
from airl_mav.core.constants import US_PER_S
from airl_mav.policy.actions import Attitude, BodyRates
from airl_mav.scenario.model import WatchdogSettings
from companion.link_interface import STOP, BodyVelocity, Due, LinkError, PilotLink, Quiet, Setpoint


class Watchdog:
    """Watchdog of a mission's setpoints, sent by `command`; a guard calls `look` at deadlines."""

    def __init__(self, link: PilotLink, clock: Clock, settings: WatchdogSettings) -> None:
        self.notes: list[str] = []
        """Actions of the watchdog, as text."""
        self.left_offboard = False
        """True if the mission is over and the flight controller holds."""
        self.culprit: str | None = None
        """Activity of the pilot when offboard was left; None = offboard was not left."""
        self._link = link
        self._clock = clock
        self._settings = settings
        self._lock = threading.Lock()
        self._activity = "start"
        self._fed_us = clock.time_us()
        self._hover_us: int | None = None
        self._stopped = False
        self._last: Setpoint = STOP

    def begin(self) -> None:
        """Start to wait for the first decision."""
        self._fed_us = self._clock.time_us()

    def doing(self, activity: str) -> None:
        """Set the pilot's activity, reported when a decision is overdue."""
        self._activity = activity

    def command(self, setpoint: Setpoint, hold_us: int) -> bool:
        """Send a setpoint with its hold time [µs]; return False if offboard was left before."""
        with self._lock:
            # A setpoint after leaving offboard would have no effect, or a late one.
            if self.left_offboard:
                return False
            self._link.send_setpoint(setpoint)
            self._last = setpoint
            self._fed_us = self._clock.time_us()
            self._stopped = False
            # The velocity is zeroed when the hold and `hover_after_s` are over.
            hover_s = self._settings.hover_after_s
            self._hover_us = None
            if hover_s is not None:
                self._hover_us = self._fed_us + hold_us + int(hover_s * US_PER_S)
            return True

    @property
    def by_velocity(self) -> bool:
        """True if the newest setpoint is a velocity, which is safe for seconds."""
        return self._stopped or isinstance(self._last, BodyVelocity)

    @property
    def hover_after_s(self) -> float | None:
        """Time from the end of an action's hold until the velocity is zeroed [s]; None = never."""
        return self._settings.hover_after_s

    @property
    def due_us(self) -> int | None:
        """Time of the next action of `look` without another decision [µs]; None = never."""
        if self.left_offboard:
            return None
        bound_us = self._leave_us if self._stopped else self._overdue_us
        return bound_us if self._hover_us is None else min(bound_us, self._hover_us)

    def look(self) -> None:
        """Perform the due action, if any."""
        with self._lock:
            now_us = self._clock.time_us()
            try:
                # The most severe action comes first.
                if now_us >= self._leave_us and not self.left_offboard:
                    self.left_offboard = True
                    self.culprit = self._activity
                    self._note("left offboard", now_us)
                    if self._link.status().offboard:
                        self._link.leave_offboard()
                    else:
                        # A pilot or a failsafe has taken over.
                        self._link.release()
                elif now_us >= self._overdue_us and not self._stopped:
                    self._stopped = True
                    self._hover_us = None
                    self._note("velocity zeroed", now_us)
                    # The note comes before the command, which may fail.
                    self._stop()
                elif self._hover_us is not None and now_us >= self._hover_us:
                    self._hover_us = None
                    self._stop()
            except LinkError as error:
                self._note(str(error), now_us)

    def _stop(self) -> None:
        """Command the flight controller to stop the vehicle."""
        last = self._last
        # After body rates or an attitude, PX4 applies a velocity up to half a second later. Until
        # then the last setpoint must neither rotate nor tilt the vehicle.
        if isinstance(last, BodyRates | Attitude):
            self._link.send_setpoint(last.stopped())
        self._link.send_setpoint(STOP)

    @property
    def _overdue_us(self) -> int:
        return self._fed_us + int(self._settings.timeout_s() * US_PER_S)

    @property
    def _leave_us(self) -> int:
        return self._overdue_us + int(self._settings.leave_after_s * US_PER_S)

    def _note(self, what: str, now_us: int) -> None:
        age_s = (now_us - self._fed_us) / US_PER_S
        self.notes.append(
            f"watchdog at {now_us / US_PER_S:.2f} s: {what} ({self._activity}; last action "
            f"{age_s:.2f} s ago)"
        )


POLL_US = 10_000
"""Interval of deadline checks [µs]."""

CHECKS_PER_RESTART = 25
"""Number of checks between restarts of the timer that ends a starved process."""

STDERR = 2
"""File descriptor for the traceback of an ended process."""

STARVED_S = 5.0
"""Time without a run of the thread after which the process ends [wall s]."""

TURNING_STARVED_S = 1.0
"""Equivalent of `STARVED_S` while an attitude or body rates are commanded [wall s]: MAVSDK repeats
them, and the flight controller's failsafe can act only when the repetition ends."""


class Guard(Protocol):
    """Guard that calls a watchdog's `look` in time."""

    def start(self, watchdog: Watchdog) -> None:
        """Start to watch."""

    def stop(self) -> None:
        """Stop watching. Allowed without a start."""


class ThreadGuard:
    """Guard with a thread; ends the process if this thread is starved."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._done = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self, watchdog: Watchdog) -> None:
        """Start to watch."""
        self._thread = threading.Thread(
            target=self._run, args=(watchdog,), name="watchdog", daemon=True
        )
        self._thread.start()

    def stop(self) -> None:
        """Stop watching. Allowed without a start."""
        self._done.set()
        if self._thread is not None:
            self._thread.join()
        faulthandler.cancel_dump_traceback_later()

    def _run(self, watchdog: Watchdog) -> None:
        try:
            while not self._done.is_set():
                # Turning setpoints leave less time, see TURNING_STARVED_S.
                starved_s = STARVED_S if watchdog.by_velocity else TURNING_STARVED_S
                # faulthandler's timer runs in C, without the interpreter lock.
                faulthandler.dump_traceback_later(starved_s, exit=True, file=STDERR)
                for _ in range(CHECKS_PER_RESTART):
                    if self._done.is_set():
                        return
                    watchdog.look()
                    self._clock.sleep_until(self._clock.time_us() + POLL_US)
        finally:
            faulthandler.cancel_dump_traceback_later()


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
