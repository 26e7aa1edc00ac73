"""Traffic of all clients: tlog files, unidentified commanders, forwarding between clients.

A tlog is raw MAVLink with receive times, for MAVProxy, QGroundControl and pymavlink. A record is an
8-byte big-endian time [µs since 1970, UTC] and one frame.
"""

from __future__ import annotations

import struct
from collections import Counter, OrderedDict, deque
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

from airl_mav.core.files import LogFile
from firmware_sim.mavlink.clients import Client
from firmware_sim.mavlink.codec import COMPONENT_ID, Encoder, WireMessage, dialect, layout, trimmed
from firmware_sim.mavlink.services import ANY, sender

_TIME = struct.Struct(">Q")
_LINK_BITS = 0b11
"""Low bits of a time stamp, where MAVProxy stores a link number; always 0 here."""

_SETUP_SIGNING = layout("SETUP_SIGNING")
_KEY_START = 10
"""Offset of the key in the payload of SETUP_SIGNING, after time stamp and target."""

MAX_LOGS = 16
"""Maximum number of additional logs per flight."""

MAX_BYTES = 1 << 28
"""Maximum size of an additional log [bytes]: hours of telemetry. A flood cannot fill the disk."""


class TlogWriter(LogFile):
    """Writer of a log of MAVLink frames."""

    def __init__(
        self, path: Path, start_unix_us: int, on_lost: Callable[[str], None] = lambda _: None
    ) -> None:
        """Open the file with final name `path`; see `LogFile`.

        `start_unix_us` is the calendar time of simulated time 0 [µs since 1970, UTC].
        """
        super().__init__(path, on_lost)
        self.start_unix_us = start_unix_us

    def write(self, time_us: int, *frames: bytes) -> None:
        """Add frames sent or received at simulated `time_us` [µs]."""
        stamp = _TIME.pack(self.start_unix_us + time_us & ~_LINK_BITS)
        # MAVLink 1 has no ids above 255.
        public = [
            _without_key(raw) if raw[7:10] == _SETUP_SIGNING.id_bytes and raw[0] == 0xFD else raw
            for raw in frames
        ]
        self.add(time_us, *[part for raw in public for part in (stamp, raw)])


def _without_key(frame: bytes) -> bytes:
    """Return a MAVLink 2 frame of SETUP_SIGNING with a zeroed key and without signature."""
    # A valid frame suits tlog readers best: they show the message, its sender and time, and find no
    # gap in the sequence numbers. The signature covers the key, so it would be wrong.
    encoder = Encoder(frame[5], frame[6])
    encoder.skip(frame[4])
    return encoder.frame(_SETUP_SIGNING, trimmed(frame[10 : 10 + min(frame[1], _KEY_START)]))


class TrafficLog:
    """Set of tlogs, one per client. The main log belongs to the preset remote."""

    def __init__(self, now_us: Callable[[], int]) -> None:
        """Store the callable that returns the simulated time [µs]."""
        self._now_us = now_us
        self._main: TlogWriter | None = None
        self._logged: dict[Client, TlogWriter] = {}
        """Writers by client, in order of arrival."""
        self._names: Counter[str] = Counter()

    def begin(self, tlog: TlogWriter, client: Client | None) -> None:
        """Log `client` to `tlog`, which the caller closes, and other clients to additional logs."""
        self.end()
        self._main = tlog
        if client is not None:
            self._names[client.link.name] += 1
            self._tap(client, tlog)

    def record_first(self, client: Client, message: WireMessage) -> None:
        """Start a client's log at its first frame."""
        main = self._main
        # The limit bounds the open files during a flood of clients.
        if main is None or client in self._logged or len(self._logged) > MAX_LOGS:
            return
        name = client.link.name
        self._names[name] += 1
        number = "" if self._names[name] == 1 else f"-{self._names[name]}"
        # flight-001.NAME.tlog next to flight-001.tlog
        path = main.path.with_name(f"{main.path.stem}.{name}{number}{main.path.suffix}")
        try:
            tlog = TlogWriter(path, main.start_unix_us, main.on_lost)
        except OSError:
            self._main = None  # disk full: the flight continues without new logs
            return
        # The client's first frame came before the tap was set.
        tlog.write(self._now_us(), bytes(message.get_msgbuf()))
        self._tap(client, tlog)

    def end(self) -> None:
        """Stop logging and close the additional logs."""
        for client, tlog in self._logged.items():
            # The tap ends first, so that no frame reaches a closed file.
            client.link.tap = None
            if tlog is not self._main:
                tlog.close()
        self._main = None
        self._logged.clear()
        self._names.clear()

    def _tap(self, client: Client, tlog: TlogWriter) -> None:
        self._logged[client] = tlog

        def write(frames: Sequence[bytes]) -> None:
            if tlog is not self._main and tlog.size_bytes >= MAX_BYTES:
                client.link.tap = None
                return
            tlog.write(self._now_us(), *frames)

        client.link.tap = write


COMMANDS = frozenset(
    (
        "COMMAND_LONG",
        "COMMAND_INT",
        "SET_MODE",
        "SET_POSITION_TARGET_LOCAL_NED",
        "SET_POSITION_TARGET_GLOBAL_INT",
        "SET_ATTITUDE_TARGET",
        "MANUAL_CONTROL",
        "RC_CHANNELS_OVERRIDE",
        "MISSION_COUNT",
        "MISSION_CLEAR_ALL",
        "MISSION_SET_CURRENT",
        "PARAM_SET",
        "SETUP_SIGNING",
    )
)
"""Messages that change the vehicle's behaviour."""

ANNOUNCED = (dialect.MAV_TYPE_GCS, dialect.MAV_TYPE_ONBOARD_CONTROLLER)
"""MAV_TYPE values in the heartbeat of a ground station and of a companion computer."""


class Senders:
    """Record of the systems that send commands and of those announced by a heartbeat."""

    def __init__(self) -> None:
        self._announced: set[tuple[int, int]] = set()
        """Announced system and component ids, kept while the links are open."""
        self._commands: Counter[tuple[int, int, str]] = Counter()

    def note(self, message: WireMessage, kind: str, source: tuple[int, int]) -> None:
        """Count a message from a sender if the message had an effect on this vehicle."""
        if kind in COMMANDS:
            self._commands[(*source, kind)] += 1
        elif kind == "HEARTBEAT" and message.type in ANNOUNCED:
            self._announced.add(source)

    def strangers(self) -> tuple[str, ...]:
        """Return a line per unannounced sender and message type since the last `forget`.

        A heartbeat after a command also announces its sender: MAVSDK starts with commands.
        """
        return tuple(
            f"system {system} component {component}, {kind} ({count} times)"
            for (system, component, kind), count in sorted(self._commands.items())
            if (system, component) not in self._announced
        )

    def forget(self) -> None:
        """Reset the counts for a new episode."""
        self._commands.clear()


REMEMBERED_FRAMES = 128
"""Number of recent frames per sender that are not forwarded again. Below 256, the number of
sequence numbers: a sender of heartbeats alone repeats its frames after that."""

REMEMBERED_SENDERS = 256


class Forwarder:
    """Message forwarder. Sends each frame once: programs that join two links cause no loop."""

    def __init__(self, everybody: Callable[[], Iterable[Client]]) -> None:
        """Store the callable that returns all clients of all links."""
        self._everybody = everybody
        self._recent: OrderedDict[tuple[int, int], deque[bytes]] = OrderedDict()

    def forward(self, message: WireMessage, origin: Client, system_id: int, now_us: int) -> bool:
        """Forward a message to the clients concerned; return True if any received it.

        Args:
            message: Received message.
            origin: Client that sent the message.
            system_id: System id of this vehicle.
            now_us: Simulated time [µs].
        """
        # Messages without target fields are broadcasts.
        target = getattr(message, "target_system", ANY), getattr(message, "target_component", ANY)
        # A signing key is for its recipient only.
        if target == (system_id, COMPONENT_ID) or message.get_type() == "SETUP_SIGNING":
            return False
        if not origin.forwards.left(now_us):
            return False
        # A frame never returns to the client that sent it.
        receivers = [
            client
            for client in self._everybody()
            if client is not origin and _concerns(target, client)
        ]
        if not receivers:
            return False
        # Only frames with a receiver enter the memory of recent frames.
        frame = bytes(message.get_msgbuf())
        if not self._is_new(sender(message), frame):
            return False
        origin.forwards.take(1, now_us)
        for client in receivers:
            client.link.pass_on(frame)
        return True

    def _is_new(self, source: tuple[int, int], frame: bytes) -> bool:
        frames = self._recent.get(source)
        if frames is None:
            # The sender that was silent longest is removed (`move_to_end` below keeps this order).
            if len(self._recent) >= REMEMBERED_SENDERS:
                self._recent.popitem(last=False)
            frames = self._recent[source] = deque(maxlen=REMEMBERED_FRAMES)
        if frame in frames:
            return False
        frames.append(frame)
        self._recent.move_to_end(source)
        return True


def _concerns(target: tuple[int, int], client: Client) -> bool:
    system, component = target
    # A target that no client has announced is unknown: the frame is dropped, as in MAVLink
    # routing.
    if system == ANY:
        return bool(client.components)
    if component == ANY:
        return any(source[0] == system for source in client.components)
    return target in client.components
