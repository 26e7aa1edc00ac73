"""The vehicle's time at the moment when something is sent to it.

The vehicle is asked for its time right before. Between that exchange of a few milliseconds and the
setpoint that follows, neither the clocks' drift nor the pace of a simulation matters (F. Cristian,
"Probabilistic clock synchronization", Distributed Computing 3, 1989).
"""

from __future__ import annotations

import json
import threading
from collections.abc import Callable
from enum import Enum
from typing import Any, NamedTuple

from airl_mav.conformance.mavlink_names import MavCommand, command_long
from airl_mav.conformance.telemetry import AUTOPILOT_COMPONENT, Telemetry
from airl_mav.core.clock import NS_PER_US, WallClock
from airl_mav.core.constants import MS_PER_S, US_PER_S

MESSAGES = ("SYSTEM_TIME", "TIMESYNC")  # Messages that `VehicleClock.receive` takes
ANSWER_S = 2.0  # Longest wait for an answer [wall s]
SAME_CLOCK_S = 1.0  # An answer and telemetry come from the same clock if they differ by less [s]
ATTEMPTS = 8  # Maximum exchanges in a row
SHORT_US = 2000  # An exchange is good enough if its middle is no longer ago than this [wall µs]
SYSTEM_TIME_ID = 2


class Method(Enum):
    """How the vehicle is asked for its time."""

    TIMESYNC = "TIMESYNC"
    SYSTEM_TIME = "REQUEST_MESSAGE(SYSTEM_TIME)"
    """PX4 1.16 leaves the target of its TIMESYNC answer unset, and MAVSDK drops it."""
    TELEMETRY = "the newest telemetry"
    """Not at all: up to one message too early."""


class Exchange(NamedTuple):
    """A question and its answer."""

    boot_s: float
    """The vehicle's time since boot when it answered [s]."""
    middle_us: float
    """Middle between question and answer [wall µs]."""
    round_trip_us: int
    """From question to answer [wall µs]."""


class VehicleClock:
    """Asks the vehicle for its time, by the first method that it answers."""

    def __init__(
        self, telemetry: Telemetry, send: Callable[[str, dict[str, Any]], None], speed: float
    ) -> None:
        self._telemetry, self._send, self._speed = telemetry, send, speed
        self.wall = WallClock()
        self._question = 0
        """ts1 of the newest TIMESYNC [ns]."""
        self._answer: tuple[float, int] | None = None
        """Time since boot [s], and when it was received [wall µs]."""
        self._answered = threading.Event()
        self.method = Method.TIMESYNC
        self.inexact = 0
        """How many sending times came from telemetry, for want of an answer."""

    def receive(self, message: Any, _: object) -> None:
        """Take a SYSTEM_TIME or TIMESYNC of MAVSDK's mavlink_direct."""
        if message.component_id != AUTOPILOT_COMPONENT or self._answered.is_set():
            return
        received_us, fields = self.wall.time_us(), json.loads(message.fields_json)
        if message.message_name != self.method.name:
            return
        if self.method is Method.SYSTEM_TIME:
            boot_s = fields["time_boot_ms"] / MS_PER_S
        elif fields["tc1"] and fields["ts1"] == self._question:
            boot_s = fields["tc1"] / (US_PER_S * NS_PER_US)
        else:
            return
        self._answer = boot_s, received_us
        self._answered.set()

    def choose_method(self) -> Method:
        """Find the first method that the vehicle answers, and use it from now on."""
        for self.method in Method:
            if self._ask() is not None:
                break
        return self.method

    def exchange(self) -> Exchange | None:
        """Return the first of a few exchanges that is short enough, else the shortest."""
        best: Exchange | None = None
        for _ in range(ATTEMPTS):
            found = self._ask()
            if found is None:
                break
            if self.wall.time_us() - found.middle_us <= SHORT_US:
                return found
            if best is None or found.round_trip_us < best.round_trip_us:
                best = found
        return best

    def now(self) -> float:
        """Return the vehicle's time since boot, or that of its newest telemetry [s]."""
        found = self.exchange()
        return self._telemetry.boot_s if found is None else found.boot_s

    def sending_time(self) -> float:
        """Return the arrival time of a message that is sent right after this call [s]."""
        newest_s, found = self._telemetry.boot_s, self.exchange()
        if found is None:
            self.inexact += 1
            return newest_s
        since_us = self.wall.time_us() - found.middle_us
        return found.boot_s + since_us * self._speed / US_PER_S

    def _ask(self) -> Exchange | None:
        """Exchange once; None when there is no answer, or one by another clock."""
        if self.method is Method.TELEMETRY:
            return None
        newest_s = self._telemetry.boot_s
        self._answer = None
        # Set before an answer can come.
        self._question += 1
        self._answered.clear()
        asked_us = self.wall.time_us()
        if self.method is Method.TIMESYNC:
            self._send("TIMESYNC", {"tc1": 0, "ts1": self._question})
        else:
            self._telemetry.unlogged_acks[MavCommand.REQUEST_MESSAGE] += 1
            question = command_long(MavCommand.REQUEST_MESSAGE, SYSTEM_TIME_ID)
            self._send("COMMAND_LONG", question)
        if not self._answered.wait(ANSWER_S) or self._answer is None:
            return None
        boot_s, received_us = self._answer
        # Before the first telemetry there is nothing to compare with.
        if newest_s > 0.0 and abs(boot_s - newest_s) > SAME_CLOCK_S:
            return None
        return Exchange(boot_s, (asked_us + received_us) / 2.0, received_us - asked_us)
