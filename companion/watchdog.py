"""What happens when the loop, the camera or the link goes quiet.

MAVSDK repeats the last setpoint at 20 Hz whatever this process does, so a hung policy would keep
the vehicle moving for ever and the offboard-loss failsafe would never fire. Three lines of
defence, each for the case that the one before cannot see:

1. A decision that is overdue zeroes the velocity.
2. Still none: offboard is left, the flight controller holds.
3. This thread itself cannot run (a policy that holds Python's interpreter lock): a C-level timer
   ends the process, the setpoints stop, and the flight controller's offboard-loss failsafe acts.
"""

from __future__ import annotations

import faulthandler
import threading
from dataclasses import dataclass

from airl_mav.clock import Clock
from airl_mav.constants import US_PER_S
from companion.link import STOP, BodyVelocity, Link, LinkError

POLL_US = 10_000
"""How often deadlines are looked at [µs]."""

STDERR = 2
"""File descriptor for the last words of a process that is ended."""

STARVED_S = 5.0
"""When this thread has not run for so long, the process ends [s of wall time]."""


@dataclass(frozen=True)
class WatchdogSettings:
    """Bounds, in seconds of simulated time."""

    decision_timeout_s: float = 2.0
    """Time since the last action after which the velocity is zeroed."""
    leave_after_s: float = 2.0
    """Further time after which offboard is left."""
    hover_after_s: float | None = None
    """Zero the velocity so long after an action's hold time has run out, decision or not: AirSim's
    semantics (0.06 s there). None = the last setpoint persists, PX4's and MAVSDK's semantics."""


class Watchdog:
    """Guards the setpoints of one mission. All commands of the pilot go through `command`."""

    def __init__(self, link: Link, clock: Clock, settings: WatchdogSettings) -> None:
        self.notes: list[str] = []
        """What it had to do, in words."""
        self.left_offboard = False
        """The mission is over: the flight controller holds."""
        self._link = link
        self._clock = clock
        self._settings = settings
        self._lock = threading.Lock()
        self._activity = "start"
        self._fed_us = clock.time_us()
        self._hover_us: int | None = None
        self._stopped = False
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._run, name="watchdog", daemon=True)

    def start(self) -> None:
        """Begin to watch: the first decision is due."""
        self._fed_us = self._clock.time_us()
        self._thread.start()

    def stop(self) -> None:
        """Stop watching."""
        self._done.set()
        if self._thread.is_alive():
            self._thread.join()
        faulthandler.cancel_dump_traceback_later()

    def doing(self, activity: str) -> None:
        """Say what the pilot is at: it names the culprit when a decision is overdue."""
        self._activity = activity

    def command(self, setpoint: BodyVelocity, hold_us: int) -> bool:
        """Send a decided setpoint; False when offboard has been left and it is too late.

        Args:
            setpoint: What to fly.
            hold_us: How long the action is meant to hold [µs].
        """
        with self._lock:
            if self.left_offboard:
                return False
            self._link.set_velocity_body(setpoint)
            self._fed_us = self._clock.time_us()
            self._stopped = False
            hover_s = self._settings.hover_after_s
            self._hover_us = None
            if hover_s is not None:
                self._hover_us = self._fed_us + hold_us + int(hover_s * US_PER_S)
            return True

    def _run(self) -> None:
        try:
            while not self._done.is_set():
                faulthandler.dump_traceback_later(STARVED_S, exit=True, file=STDERR)
                for _ in range(25):
                    if self._done.is_set():
                        return
                    self._look()
                    self._clock.sleep_until(self._clock.time_us() + POLL_US)
        finally:
            faulthandler.cancel_dump_traceback_later()

    def _look(self) -> None:
        settings = self._settings
        with self._lock:
            now_us = self._clock.time_us()
            overdue_s = (now_us - self._fed_us) / US_PER_S - settings.decision_timeout_s
            try:
                if overdue_s > settings.leave_after_s and not self.left_offboard:
                    self.left_offboard = True
                    self._note("left offboard", now_us)
                    self._link.leave_offboard()
                elif overdue_s > 0.0 and not self._stopped:
                    self._stopped = True
                    self._note("velocity zeroed", now_us)
                    self._link.set_velocity_body(STOP)
                elif self._hover_us is not None and now_us >= self._hover_us:
                    self._hover_us = None
                    self._link.set_velocity_body(STOP)
            except LinkError as error:
                self._note(str(error), now_us)

    def _note(self, what: str, now_us: int) -> None:
        age_s = (now_us - self._fed_us) / US_PER_S
        self.notes.append(
            f"watchdog at {now_us / US_PER_S:.2f} s: {what} ({self._activity}; last action "
            f"{age_s:.2f} s ago)"
        )
