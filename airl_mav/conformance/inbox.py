"""What has been heard from the vehicle, put in order as it comes."""

from __future__ import annotations

import json
import threading
from collections import Counter
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from airl_mav.conformance.track import Track
from airl_mav.conformance.transcript import Transcript
from airl_mav.conformance.words import (
    ARMED_FLAG,
    command_name,
    landed_name,
    result_name,
)
from airl_mav.core.clock import NS_PER_US, WallClock
from airl_mav.core.constants import MS_PER_S, US_PER_S

NAMES = (
    "ATTITUDE",
    "AUTOPILOT_VERSION",
    "COMMAND_ACK",
    "EXTENDED_SYS_STATE",
    "HEARTBEAT",
    "HOME_POSITION",
    "LOCAL_POSITION_NED",
    "STATUSTEXT",
    "SYSTEM_TIME",
    "SYS_STATUS",
    "TIMESYNC",
)
"""Messages that are taken in."""

AUTOPILOT_COMPONENT = 1
"""MAV_COMP_ID_AUTOPILOT1: other components of the vehicle have heartbeats and clocks of their own.
"""

Fields = Mapping[str, Any]


class Text(NamedTuple):
    """A STATUSTEXT."""

    boot_s: float
    """When, by the newest telemetry that came before it [s]."""
    text: str


class Inbox:
    """Telemetry, texts and answers; fed from threads of MAVSDK's, read from any."""

    def __init__(self, transcript: Transcript) -> None:
        self._transcript = transcript
        self._lock = threading.Lock()
        self.stopwatch = WallClock()
        """Wall time."""
        self._latest: dict[str, Fields] = {}
        self._motion: list[tuple[float, ...]] = []
        self._heading: list[tuple[float, ...]] = []
        self._partial: tuple[int, str] = (0, "")
        self._last_sound_us = 0
        self.counts: Counter[str] | None = None
        """How often each message came, while somebody counts."""
        self.texts: list[Text] = []
        self.landed_states: list[int] = []
        """landed_state, each change of it."""
        self.modes: list[int] = []
        """custom_mode, each change of it."""
        self.asked_ns = 0
        """Time stamp of the TIMESYNC that is to be answered; 0: SYSTEM_TIME is."""
        self.answer: tuple[float, int] | None = None
        """The vehicle's time since boot [s] in the answer, and when it came [wall µs]."""
        self.answered = threading.Event()
        """Set with `answer`."""
        self.unheard: Counter[int] = Counter()
        """COMMAND_ACKs that are left out of the transcript, by command."""
        self.boot_s = 0.0
        """Newest time since boot that telemetry has told [s]."""
        self.mode_name: Callable[[int], str] = str
        """How a custom_mode is called."""

    @property
    def silence_s(self) -> float:
        """Wall time since anything was heard [s]."""
        return (self.stopwatch.time_us() - self._last_sound_us) / US_PER_S

    def latest(self, name: str) -> Fields | None:
        """Return the fields of the newest message of a name; None when there was none."""
        return self._latest.get(name)

    def count(self, message: Any, _: object) -> None:
        """Count a message of any name."""
        counts = self.counts
        if counts is not None and message.component_id == AUTOPILOT_COMPONENT:
            counts[message.message_name] += 1

    def hear(self, message: Any, _: object) -> None:
        """Take a message in."""
        if message.component_id != AUTOPILOT_COMPONENT:
            return
        fields: Fields = json.loads(message.fields_json)
        name = message.message_name
        with self._lock:
            self._last_sound_us = self.stopwatch.time_us()
            old = self._latest.get(name)
            self._latest[name] = fields
            if name == "LOCAL_POSITION_NED":
                self._motion.append(self._row(fields, ("x", "y", "z", "vx", "vy", "vz")))
            elif name == "ATTITUDE":
                self._heading.append(self._row(fields, ("yaw", "yawspeed")))
            elif name in ("TIMESYNC", "SYSTEM_TIME"):
                self._take_time(name, fields)
        if name == "STATUSTEXT":
            self._take_text(fields)
        elif name == "COMMAND_ACK":
            self._take_answer(fields)
        elif name == "HEARTBEAT":
            self._take_heartbeat(fields, old)
        elif name == "EXTENDED_SYS_STATE":
            self._take_landed(fields)

    def track(self) -> Track:
        """Return all motion heard so far."""
        with self._lock:
            motion, heading = self._motion[:], self._heading[:]
        return Track(np.array(motion).reshape(-1, 7), np.array(heading).reshape(-1, 3))

    def recent(self, seconds: float) -> Track:
        """Return the motion of the last seconds, by the vehicle's clock [s]."""
        # A hundred a second, and some to spare: not the whole flight at every look.
        rows = int(seconds * 250.0) + 10
        with self._lock:
            motion, heading = self._motion[-rows:], self._heading[-rows:]
        track = Track(np.array(motion).reshape(-1, 7), np.array(heading).reshape(-1, 3))
        return track.between(self.boot_s - seconds, self.boot_s)

    def said(self, text: str, since: int = 0) -> Text | None:
        """Return the first text that contains another, from the n-th text on."""
        return next((said for said in self.texts[since:] if text in said.text), None)

    def _row(self, fields: Fields, names: tuple[str, ...]) -> tuple[float, ...]:
        boot_s = fields["time_boot_ms"] / MS_PER_S
        self.boot_s = max(self.boot_s, boot_s)
        # What is not known is sent as NaN, which JSON has no word for.
        nan = float("nan")
        return (boot_s, *(nan if fields[name] is None else fields[name] for name in names))

    def _take_time(self, name: str, fields: Fields) -> None:
        if name == "TIMESYNC" and fields["tc1"] and fields["ts1"] == self.asked_ns:
            boot_s = fields["tc1"] / (US_PER_S * NS_PER_US)
        elif name == "SYSTEM_TIME" and not self.asked_ns and not self.answered.is_set():
            boot_s = fields["time_boot_ms"] / MS_PER_S
        else:
            return
        self.answer = boot_s, self._last_sound_us
        self.answered.set()

    def _take_answer(self, fields: Fields) -> None:
        number = fields["command"]
        if self.unheard[number]:
            self.unheard[number] -= 1
            return
        what = f"{command_name(number)} {result_name(fields['result'])}"
        self._transcript.say("heard", f"COMMAND_ACK {what}")

    def _take_text(self, fields: Fields) -> None:
        """Put the parts of a long text together: full ones are followed by another."""
        part, number = fields["text"].rstrip("\0"), fields.get("id", 0)
        old_number, old = self._partial
        whole = old + part if number and number == old_number else part
        if number and len(part) >= 50:
            self._partial = number, whole
            return
        self._partial = 0, ""
        whole = whole.strip()
        self.texts.append(Text(self.boot_s, whole))
        self._transcript.say("heard", f'STATUSTEXT {fields["severity"]} "{whole}"')

    def _take_heartbeat(self, fields: Fields, old: Fields | None) -> None:
        mode, armed = fields["custom_mode"], bool(fields["base_mode"] & ARMED_FLAG)
        seen = mode, armed, fields["system_status"]
        if old is not None:
            was = old["custom_mode"], bool(old["base_mode"] & ARMED_FLAG), old["system_status"]
            if seen == was:
                return
        if not self.modes or self.modes[-1] != mode:
            self.modes.append(mode)
        self._transcript.say(
            "heard",
            f"HEARTBEAT {self.mode_name(mode)}, {'armed' if armed else 'disarmed'}, "
            f"system_status {fields['system_status']}",
        )

    def _take_landed(self, fields: Fields) -> None:
        state = fields["landed_state"]
        if not self.landed_states or self.landed_states[-1] != state:
            self.landed_states.append(state)
            self._transcript.say("heard", f"EXTENDED_SYS_STATE {landed_name(state)}")
