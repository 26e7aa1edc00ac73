"""Vehicle time at the moment of sending.

The vehicle's time is requested right before. Between that exchange of a few milliseconds and the
next setpoint, neither clock drift nor simulation speed matters (F. Cristian, "Probabilistic clock
synchronization", Distributed Computing 3, 1989).
"""

from __future__ import annotations

import json
import threading
from collections.abc import Callable
from enum import Enum
from typing import Any, NamedTuple

from airl_mav.addons.conformance.mavlink_names import MavCommand, command_long
from airl_mav.addons.conformance.telemetry import AUTOPILOT_COMPONENT, TelemetryBuffer
from airl_mav.core.clock import NS_PER_US, WallClock
from airl_mav.core.constants import MS_PER_S, US_PER_S

MESSAGES = ("SYSTEM_TIME", "TIMESYNC")  # Messages that `VehicleClock.receive` takes
ANSWER_S = 2.0  # Answer timeout [wall s]
SAME_CLOCK_S = 1.0  # Maximum difference between an answer and telemetry of the same clock [s]
ATTEMPTS = 8  # Maximum exchanges in a row
SHORT_US = 2000  # Maximum age of an exchange's middle [wall µs]
SYSTEM_TIME_ID = 2


class Method(Enum):
    """Method to request the vehicle's time."""

    TIMESYNC = "TIMESYNC"
    SYSTEM_TIME = "REQUEST_MESSAGE(SYSTEM_TIME)"
    """Needed for PX4 1.16, whose TIMESYNC answer lacks a target, so that MAVSDK drops it."""
    TELEMETRY = "the newest telemetry"
    """No request: up to one message early."""


class Exchange(NamedTuple):
    """Request and answer."""

    boot_s: float
    """Vehicle time since boot at the answer [s]."""
    middle_us: float
    """Midpoint between request and answer [wall µs]."""
    round_trip_us: int
    """Time from request to answer [wall µs]."""


class VehicleClock:
    """Requests the vehicle's time, by the first supported method."""

    def __init__(
        self, telemetry: TelemetryBuffer, send: Callable[[str, dict[str, Any]], None], speed: float
    ) -> None:
        self._telemetry, self._send, self._speed = telemetry, send, speed
        self.wall = WallClock()
        self._question = 0
        """ts1 of the newest TIMESYNC [ns]."""
        self._answer: tuple[float, int] | None = None
        """Time since boot [s], and its reception time [wall µs]."""
        self._answered = threading.Event()
        self.method = Method.TIMESYNC
        self.inexact = 0
        """Number of sending times taken from telemetry because an answer was missing."""

    def receive(self, message: Any, _: object) -> None:
        """Process a SYSTEM_TIME or TIMESYNC of MAVSDK's mavlink_direct."""
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
        """Select the first method that the vehicle answers."""
        for self.method in Method:
            if self._ask() is not None:
                break
        return self.method

    def exchange(self) -> Exchange | None:
        """Return the first exchange that is short enough, or the shortest of several."""
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
        """Return the vehicle's time since boot [s], from the newest telemetry without an answer."""
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
        """Exchange once; None without an answer, or for an answer by another clock."""
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
