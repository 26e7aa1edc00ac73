"""The vehicle's time at the moment when something is sent to it.

It is asked for its time right before: from one exchange of a few milliseconds to the setpoint that
follows it, neither the clocks' drift nor the pace of a simulation has a part in it (F. Cristian,
"Probabilistic clock synchronization", Distributed Computing 3, 1989).
"""

from __future__ import annotations

from collections.abc import Callable
from enum import Enum
from typing import NamedTuple

from airl_mav.conformance.inbox import Inbox
from airl_mav.conformance.words import REQUEST_MESSAGE
from airl_mav.core.constants import US_PER_S

ANSWER_S = 2.0
"""Longest wait for an answer [wall s]."""

CLOCKS_APART_S = 1.0
"""An answer and telemetry tell the same clock if they differ by less [s]."""

TRIES = 8
"""Most exchanges in a row."""

SHORT_US = 2000
"""An exchange whose middle is so short ago tells the time well enough [wall µs]."""

SYSTEM_TIME_ID = 2


class Method(Enum):
    """How the vehicle is asked."""

    TIMESYNC = "TIMESYNC"
    SYSTEM_TIME = "REQUEST_MESSAGE(SYSTEM_TIME)"
    """PX4 1.16 addresses its answer to TIMESYNC at random, and MAVSDK drops it."""
    TELEMETRY = "the newest telemetry"
    """No question at all: up to one message too early."""


class Fix(NamedTuple):
    """One exchange."""

    boot_s: float
    """The vehicle's time since boot when it answered [s]."""
    middle_us: float
    """Middle between asking and hearing the answer, by the inbox's stopwatch [wall µs]."""
    round_trip_us: int
    """From asking to hearing [wall µs]."""


class VehicleClock:
    """Asks in the way that is answered."""

    def __init__(self, inbox: Inbox, send: Callable[[str, dict[str, object]], None]) -> None:
        """Take what is needed to ask.

        Args:
            inbox: Where answers arrive.
            send: Sends a raw message.
        """
        self._inbox, self._send = inbox, send
        self._asked_ns = 0
        self.method = Method.TIMESYNC

    def choose(self) -> Method:
        """Find out what is answered, and ask in this way from now on."""
        for self.method in Method:
            if self.method is Method.TELEMETRY or self._exchange() is not None:
                break
        return self.method

    def fix(self) -> Fix | None:
        """Ask until an exchange is short, a few times; return the shortest, None without any."""
        best: Fix | None = None
        for _ in range(TRIES):
            found = None if self.method is Method.TELEMETRY else self._exchange()
            if found is None:
                return best
            if best is None or found.round_trip_us < best.round_trip_us:
                best = found
            if self._inbox.stopwatch.time_us() - found.middle_us <= SHORT_US:
                # The newest one, although another may have been shorter.
                return found
        return best

    def now(self) -> float:
        """Return the vehicle's time since boot, or that of its newest telemetry [s]."""
        found = self.fix()
        return self._inbox.boot_s if found is None else found.boot_s

    def sending(self, fix: Fix | None, newest_s: float, speed: float) -> tuple[float, bool]:
        """Return when what is sent right after this call comes to the vehicle.

        Before it is sent and not after: a call into MAVSDK sends at once, but returns only when
        Python's other threads let it.

        Args:
            fix: What `fix` returned right before.
            newest_s: Newest time of telemetry [s].
            speed: Simulated seconds per wall second of the vehicle.

        Returns:
            Time since boot [s], and whether it comes from an exchange: without one it is
            `newest_s`.
        """
        if fix is None:
            return newest_s, False
        since_us = self._inbox.stopwatch.time_us() - fix.middle_us
        return fix.boot_s + since_us * speed / US_PER_S, True

    def _exchange(self) -> Fix | None:
        """Ask, and wait for the answer; None when there is none, or by another clock."""
        inbox, newest_s = self._inbox, self._inbox.boot_s
        inbox.answered.clear()
        inbox.answer = None
        # What is asked is known before an answer can come.
        self._asked_ns += 1
        inbox.asked_ns = self._asked_ns if self.method is Method.TIMESYNC else 0
        asked_us = inbox.stopwatch.time_us()
        if self.method is Method.TIMESYNC:
            self._send("TIMESYNC", {"tc1": 0, "ts1": self._asked_ns})
        else:
            inbox.unheard[REQUEST_MESSAGE] += 1
            params = {"param1": SYSTEM_TIME_ID} | {f"param{n}": 0.0 for n in range(2, 8)}
            command = {"command": REQUEST_MESSAGE, "confirmation": 0}
            self._send("COMMAND_LONG", {**command, **params})
        if not inbox.answered.wait(ANSWER_S) or inbox.answer is None:
            return None
        boot_s, heard_us = inbox.answer
        # Before the first telemetry there is nothing to compare with.
        if newest_s > 0.0 and abs(boot_s - newest_s) > CLOCKS_APART_S:
            return None
        return Fix(boot_s, (asked_us + heard_us) / 2.0, heard_us - asked_us)
