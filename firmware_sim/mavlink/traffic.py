"""Traffic of all clients: tlog files, messages with an effect, forwarding between clients.

A tlog is raw MAVLink with receive times, for MAVProxy, QGroundControl and pymavlink. A record is an
8-byte big-endian time [µs since 1970, UTC] and one frame.
"""

from __future__ import annotations

import struct
from collections import Counter, OrderedDict, deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from airl_mav.core.files import LogFile
from airl_mav.flight.judge import Effect
from firmware_sim.mavlink.clients import Client
from firmware_sim.mavlink.codec import COMPONENT_ID, Encoder, WireMessage, dialect, layout, trimmed
from firmware_sim.mavlink.services import ANY, Context, sender, table

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


READING = frozenset(
    (
        "HEARTBEAT",
        "PING",
        "TIMESYNC",
        "REQUEST_EVENT",
        "REQUEST_DATA_STREAM",
        "PARAM_REQUEST_LIST",
        "PARAM_REQUEST_READ",
        "MISSION_REQUEST_LIST",
        "MISSION_REQUEST",
        "MISSION_REQUEST_INT",
        "MISSION_ACK",
        "LOG_REQUEST_LIST",
        "LOG_REQUEST_DATA",
        "LOG_REQUEST_END",
        "LOG_ERASE",
        "LOGGING_ACK",
    )
)
"""Messages that only read from the vehicle, or are always rejected. Every other handled message is
an effect, so the messages of a new service are recorded by default."""

_SET_RATE: int = dialect.MAV_CMD_SET_MESSAGE_INTERVAL

READING_COMMANDS = frozenset(
    (
        _SET_RATE,
        dialect.MAV_CMD_GET_MESSAGE_INTERVAL,
        dialect.MAV_CMD_REQUEST_MESSAGE,
        dialect.MAV_CMD_GET_HOME_POSITION,
        dialect.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES,
        dialect.MAV_CMD_REQUEST_PROTOCOL_VERSION,
        dialect.MAV_CMD_REQUEST_FLIGHT_INFORMATION,
        dialect.MAV_CMD_REQUEST_CAMERA_INFORMATION,
        dialect.MAV_CMD_RUN_PREARM_CHECKS,
        dialect.MAV_CMD_LOGGING_START,
        dialect.MAV_CMD_LOGGING_STOP,
    )
)
"""MAV_CMD of the commands that only read from the vehicle."""

READING_FILES = frozenset((0, 1, 2, 3, 4, 5, 14, 15))
"""Opcodes of MAVLink FTP that only read: none, terminate and reset sessions, list, open for
reading, read, checksum, burst."""

_FTP_OPCODE = 3
"""Index of the opcode in the payload of FILE_TRANSFER_PROTOCOL."""

MAX_EFFECTS = 2_000
"""Maximum number of recorded effects, more than the vehicle has parameters. Further effects share
one row, so that invented system ids cannot fill the memory."""

_Key = tuple["Client | None", tuple[int, int], str, "int | str"]
"""Client, system and component id, message, MAV_CMD or name of the changed value."""

_OTHERS: _Key = None, (ANY, ANY), "further messages", ""


@dataclass(slots=True)
class _Row:
    """Messages of one sender and type."""

    first_us: int
    is_companion: bool
    old: float | None
    new: float | None = None
    count: int = 0


_MAVSDK = 1, int(dialect.MAV_COMP_ID_PATHPLANNER)
"""Default system and component id of MAVSDK as a companion computer."""


class Effects:
    """Record of the messages that took effect on the vehicle, by sender and message."""

    def __init__(self) -> None:
        self._rows: dict[_Key, _Row] = {}

    def note(
        self,
        message: WireMessage,
        kind: str,
        source: tuple[int, int],
        client: Client,
        context: Context,
    ) -> None:
        """Count a message that a service has handled, unless it only reads; see `READING`."""
        detail: int | str = ""
        if kind in ("COMMAND_LONG", "COMMAND_INT"):
            detail = message.command
            if detail not in table("ACTIONS"):
                return
            # A rate set by another system on the companion's link changes the companion's input.
            if detail in READING_COMMANDS and (
                detail != _SET_RATE
                or not _is_onboard(client)
                or _is_companion(client, source, context)
            ):
                return
        elif kind == "FILE_TRANSFER_PROTOCOL" and message.payload[_FTP_OPCODE] in READING_FILES:
            return
        stores = context.port.parameters, context.port.plans
        changed = stores[0].history or stores[1].history
        row = self._rows.get((client, source, kind, detail))
        # The usual case first: the companion repeats its setpoints.
        if row is not None and not changed:
            row.count += 1
            return
        # A PARAM_SET of the present value has no effect.
        if kind != "PARAM_SET":
            self._count((client, source, kind, detail), context)
        for store in stores:
            for name, old, new in store.history:
                self._count((client, source, kind, name), context, old, new)
            store.history.clear()

    def _count(
        self, key: _Key, context: Context, old: float | None = None, new: float | None = None
    ) -> None:
        if key not in self._rows and len(self._rows) >= MAX_EFFECTS:
            key, old, new = _OTHERS, None, None
        row = self._rows.get(key)
        if row is None:
            client, source, _, _ = key
            invited = client is not None and _is_companion(client, source, context)
            row = self._rows[key] = _Row(context.now_us, invited, old)
        # The first old value and the newest value are the change in total.
        row.new = new
        row.count += 1

    def effects(self) -> tuple[Effect, ...]:
        """Return the effects since the last `forget`, in order of their first message."""
        return tuple(
            Effect(
                link="others" if client is None else client.link.name,
                peer="" if client is None or client.peer is None else "{}:{}".format(*client.peer),
                system=source[0],
                component=source[1],
                message=_title(kind, detail),
                **asdict(row),
            )
            for (client, source, kind, detail), row in self._rows.items()
        )

    def forget(self) -> None:
        """Reset the record for a new episode."""
        self._rows.clear()


def _is_onboard(client: Client) -> bool:
    """Return True for the preset remote of the onboard link, where the companion listens."""
    return client.peer is None and client.link.name == "onboard"


def _is_companion(client: Client, source: tuple[int, int], context: Context) -> bool:
    # By convention a companion has the system id of its vehicle.
    mavsdk = _MAVSDK, (context.system_id, _MAVSDK[1])
    return source in mavsdk and _is_onboard(client)


def _title(kind: str, detail: int | str) -> str:
    if isinstance(detail, int):
        detail = dialect.enums["MAV_CMD"][detail].name
    return f"{kind} {detail}".rstrip()


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
