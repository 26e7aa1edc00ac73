"""Telemetry of the vehicle: newest messages, motion, texts and state changes."""

from __future__ import annotations

import json
import threading
from collections import Counter
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from airl_mav.addons.conformance.checklist import (
    ARMED_FLAG,
    LandedState,
    MavCommand,
    MavResult,
    Transcript,
    name_of,
)
from airl_mav.core.clock import WallClock
from airl_mav.core.constants import MS_PER_S, US_PER_S

MESSAGES = (
    "ATTITUDE",
    "AUTOPILOT_VERSION",
    "COMMAND_ACK",
    "EXTENDED_SYS_STATE",
    "HEARTBEAT",
    "LOCAL_POSITION_NED",
    "STATUSTEXT",
    "SYS_STATUS",
)
"""Messages that `TelemetryBuffer.receive` accepts."""

AUTOPILOT_COMPONENT = 1
"""MAV_COMP_ID_AUTOPILOT1: other components of the vehicle send separate heartbeats and clocks."""

FULL_TEXT = 50  # Length of a STATUSTEXT that may continue in another part
MOTION_HZ = 250.0  # Above the requested sample rates
Fields = Mapping[str, Any]


class EstimatedMotion(NamedTuple):
    """The vehicle's estimated motion by the vehicle's clock, over a part of the flight."""

    position: NDArray[np.float64]
    """(n, 7) LOCAL_POSITION_NED: time since boot [s], north, east, down [m], their rates [m/s]."""
    heading: NDArray[np.float64]
    """(m, 3) ATTITUDE: time since boot [s], yaw [rad], yawspeed [rad/s]."""

    @property
    def velocity(self) -> NDArray[np.float64]:
        """(n, 3) north, east, down [m/s]."""
        return self.position[:, 4:7]

    def between(self, start_s: float, end_s: float) -> EstimatedMotion:
        """Return the part between two times since boot [s]."""
        return EstimatedMotion(
            *(part[(part[:, 0] >= start_s) & (part[:, 0] <= end_s)] for part in self)
        )


class StatusText(NamedTuple):
    """STATUSTEXT of the vehicle."""

    boot_s: float
    """Time since boot of the newest telemetry before it [s]."""
    text: str


class TelemetryBuffer:
    """Telemetry, texts and answers; written by MAVSDK's threads, read from any."""

    def __init__(self, transcript: Transcript) -> None:
        self._transcript = transcript
        self._lock = threading.Lock()
        self._wall = WallClock()
        self._latest: dict[str, Fields] = {}
        self._position: list[tuple[float, ...]] = []
        self._heading: list[tuple[float, ...]] = []
        self._partial_text: tuple[int, str] = (0, "")
        self._last_received_us = 0
        self.texts: list[StatusText] = []
        self.landed_states: list[int] = []
        """Each new value of landed_state."""
        self.unlogged_acks: Counter[int] = Counter()
        """Number of pending COMMAND_ACKs to omit from the transcript, by command."""
        self.boot_s = 0.0
        """Newest time since boot in telemetry [s]."""
        self.mode_name: Callable[[int], str] = str
        """Function that returns the name of a custom_mode."""

    @property
    def silence_s(self) -> float:
        """Wall time since the last message [s]."""
        return (self._wall.time_us() - self._last_received_us) / US_PER_S

    def latest(self, name: str) -> Fields | None:
        """Return the fields of the newest message of a name; None before the first."""
        return self._latest.get(name)

    def receive(self, message: Any, _: object) -> None:
        """Process a message of MAVSDK's mavlink_direct."""
        if message.component_id != AUTOPILOT_COMPONENT:
            return
        fields: Fields = json.loads(message.fields_json)
        name = message.message_name
        with self._lock:
            self._last_received_us = self._wall.time_us()
            previous = self._latest.get(name)
            self._latest[name] = fields
            if name == "LOCAL_POSITION_NED":
                self._position.append(self._row(fields, ("x", "y", "z", "vx", "vy", "vz")))
            elif name == "ATTITUDE":
                self._heading.append(self._row(fields, ("yaw", "yawspeed")))
        if name == "STATUSTEXT":
            self._take_text(fields)
        elif name == "COMMAND_ACK":
            self._take_ack(fields)
        elif name == "HEARTBEAT":
            self._take_heartbeat(fields, previous)
        elif name == "EXTENDED_SYS_STATE":
            self._take_landed(fields["landed_state"])

    def recent(self, seconds: float) -> EstimatedMotion:
        """Return the motion of the last seconds, by the vehicle's clock [s]."""
        rows = int(seconds * MOTION_HZ) + 10  # Avoids copying the whole flight
        with self._lock:
            position, heading = self._position[-rows:], self._heading[-rows:]
        motion = EstimatedMotion(
            np.array(position).reshape(-1, 7), np.array(heading).reshape(-1, 3)
        )
        return motion.between(self.boot_s - seconds, self.boot_s)

    def find_text(self, part: str, since: int = 0) -> StatusText | None:
        """Return the first text that contains a part, from index `since` on."""
        return next((each for each in self.texts[since:] if part in each.text), None)

    def _row(self, fields: Fields, names: tuple[str, ...]) -> tuple[float, ...]:
        boot_s = fields["time_boot_ms"] / MS_PER_S
        self.boot_s = max(self.boot_s, boot_s)
        # JSON has null for NaN.
        nan = float("nan")
        return (boot_s, *(nan if fields[name] is None else fields[name] for name in names))

    def _take_ack(self, fields: Fields) -> None:
        command = fields["command"]
        if self.unlogged_acks[command]:
            self.unlogged_acks[command] -= 1
            return
        answer = f"{name_of(MavCommand, command)} {name_of(MavResult, fields['result'])}"
        self._transcript.add("heard", f"COMMAND_ACK {answer}")

    def _take_text(self, fields: Fields) -> None:
        """Join the parts of a long text: another part follows a full one with the same id."""
        part, number = fields["text"].rstrip("\0"), fields.get("id", 0)
        partial_number, partial = self._partial_text
        whole = partial + part if number and number == partial_number else part
        if number and len(part) >= FULL_TEXT:
            self._partial_text = number, whole
            return
        self._partial_text = 0, ""
        whole = whole.strip()
        self.texts.append(StatusText(self.boot_s, whole))
        self._transcript.add("heard", f'STATUSTEXT {fields["severity"]} "{whole}"')

    def _take_heartbeat(self, fields: Fields, previous: Fields | None) -> None:
        def state(beat: Fields) -> tuple[int, bool, int]:
            return beat["custom_mode"], bool(beat["base_mode"] & ARMED_FLAG), beat["system_status"]

        if previous is not None and state(previous) == state(fields):
            return
        mode, armed, status = state(fields)
        self._transcript.add(
            "heard",
            f"HEARTBEAT {self.mode_name(mode)}, {'armed' if armed else 'disarmed'}, "
            f"system_status {status}",
        )

    def _take_landed(self, state: int) -> None:
        if not self.landed_states or self.landed_states[-1] != state:
            self.landed_states.append(state)
            self._transcript.add("heard", f"EXTENDED_SYS_STATE {name_of(LandedState, state)}")
