"""TIMESYNC with the flight controller through `mavlink_direct`: clock offset and round trip."""

from __future__ import annotations

import json
import threading
from contextlib import AbstractContextManager
from typing import Any

import numpy as np

from airl_mav.core.clock import NS_PER_US
from airl_mav.core.constants import US_PER_S
from airl_mav.latency.clock_offset import Exchanges
from companion.mavsdk_link import MavsdkLink
from companion.periodic import every

MESSAGE = "TIMESYNC"

AUTOPILOT_COMPONENT = 1
"""MAV_COMP_ID_AUTOPILOT1: other components of the vehicle may answer too, by other clocks."""

LAST_ANSWER_S = 0.2
"""Wait for the last answer of a series [s]."""


class TimesyncLink(MavsdkLink):
    """A link that also exchanges TIMESYNC with the flight controller."""

    _system_id: int
    _pending: set[int]
    """Times at which the unanswered requests were sent [µs]."""
    _answered: list[tuple[int, int, int]]

    def connect(self, timeout_s: float, stop: threading.Event | None = None) -> None:
        """Wait for a flight controller, as `MavsdkLink.connect`."""
        super().connect(timeout_s, stop)
        self._pending, self._answered = set(), []
        self._system_id = self._system.get_system_id()
        self._hear_messages(MESSAGE, self._hear)

    def exchange(self, count: int, interval_s: float, stop: threading.Event) -> None:
        """Send requests at an interval [s] after `connect`, and wait for the answers or `stop`."""
        asked_us = self._clock.time_us()
        for _ in range(count):
            if stop.is_set():
                return
            self._ask()
            asked_us += int(interval_s * US_PER_S)
            self._clock.sleep_until(asked_us, stop)
        self._clock.sleep_until(self._clock.time_us() + int(LAST_ANSWER_S * US_PER_S), stop)

    def exchanging(self, interval_s: float) -> AbstractContextManager[None]:
        """Send requests at an interval [s] from a thread, for as long as the context lasts."""
        return every(int(interval_s * US_PER_S), self._ask, self._clock, "timesync")

    def take_exchanges(self) -> Exchanges:
        """Return the answered requests since the last call, in the order of the answers."""
        # Another answer may arrive meanwhile: it stays.
        taken = self._answered[:]
        del self._answered[: len(taken)]
        columns = np.array(taken, np.int64).reshape(-1, 3)
        return Exchanges(columns[:, 0], columns[:, 1], columns[:, 2])

    def _ask(self) -> None:
        sent_us = self._clock.time_us()
        self._pending.add(sent_us)
        if not self.send_message(MESSAGE, {"tc1": 0, "ts1": sent_us * NS_PER_US}):
            # Treated as lost.
            self._pending.discard(sent_us)

    def _hear(self, message: Any, _: object) -> None:
        """Take an answer; called from a thread of MAVSDK's."""
        received_us = self._clock.time_us()
        sender = message.system_id, message.component_id
        if sender != (self._system_id, AUTOPILOT_COMPONENT):
            return
        fields = json.loads(message.fields_json)
        remote_ns, sent_us = fields["tc1"], fields["ts1"] // NS_PER_US
        # Requests of the flight controller have no tc1; a second answer is of no use.
        if remote_ns == 0 or sent_us not in self._pending:
            return
        self._pending.discard(sent_us)
        self._answered.append((sent_us, remote_ns // NS_PER_US, received_us))
