"""State of clients' transfers: files (MAVLink FTP), logs, missions, calibrations, the shell."""

from __future__ import annotations

import os
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from enum import Enum, IntEnum, auto
from pathlib import Path
from typing import BinaryIO, NamedTuple

from airl_mav.core.constants import US_PER_S
from firmware_sim.autopilot.autopilot_state import Message
from firmware_sim.autopilot.navigation.plan import PlanItem
from firmware_sim.autopilot.port import LogEntry

_ALL_ONES = 0xFFFF_FFFF


def crc32part(data: bytes, crc: int = 0) -> int:
    """Return the CRC-32 of what came before (`crc`) and of `data`.

    zlib inverts before and after; PX4's crc32part() does not.
    """
    return zlib.crc32(data, crc ^ _ALL_ONES) ^ _ALL_ONES


# --- MAVLink FTP

CHUNK_BYTES = 1 << 16

SESSION = 0
"""Number of a client's only session, as of PX4's."""


class Code(IntEnum):
    """Error codes in the first byte of a NAK."""

    FAIL = 1
    FAIL_ERRNO = 2
    INVALID_DATA_SIZE = 3
    INVALID_SESSION = 4
    NO_SESSIONS = 5
    END_OF_FILE = 6
    UNKNOWN_COMMAND = 7
    FILE_EXISTS = 8
    FILE_PROTECTED = 9
    FILE_NOT_FOUND = 10


class RefusedError(Exception):
    """A request that is answered with a NAK."""

    def __init__(self, code: Code) -> None:
        super().__init__(code.name)
        self.code = code


@dataclass(slots=True)
class Request:
    """One request, unpacked."""

    session: int
    opcode: int
    offset: int
    size: int
    """Size of the data; in a read, the requested size."""
    data: bytes

    @property
    def name(self) -> str:
        """The path that is meant."""
        return os.fsdecode(self.data.split(b"\0", 1)[0])


@dataclass(slots=True)
class Session:
    """The file that a client has open."""

    file: BinaryIO | None = None
    size: int = 0
    """Size of the file when it was opened [bytes]."""

    def opened(self, request: Request) -> BinaryIO:
        """Return the open file. Raises RefusedError when there is none."""
        if request.session != SESSION or self.file is None:
            raise RefusedError(Code.INVALID_SESSION)
        return self.file

    def close(self) -> None:
        """Close the file, if there is one."""
        if self.file is not None:
            self.file.close()
            self.file = None


@dataclass(slots=True)
class Burst:
    """A burst read that is going on."""

    sequence: int
    offset: int
    asker: tuple[int, int]


class Answered(NamedTuple):
    """Fields of an answer about its request."""

    sequence: int
    session: int
    opcode: int
    offset: int
    asker: tuple[int, int]


class Checksum:
    """The CRC-32 of a file, piece by piece: a large file takes longer than a tick."""

    def __init__(self, path: Path) -> None:
        """Open the file. Raises OSError."""
        self._crc = 0
        self._file = path.open("rb", buffering=0)

    def go_on(self) -> bytes | None:
        """Read the next piece; return the data of the answer after the last. Raises OSError."""
        chunk = self._file.read(CHUNK_BYTES)
        self._crc = crc32part(chunk, self._crc)
        if len(chunk) == CHUNK_BYTES:
            return None
        return self._crc.to_bytes(4, "little")

    def close(self) -> None:
        """Close the file; harmless when called again."""
        self._file.close()


@dataclass(slots=True)
class Summing:
    """A request for a checksum that is not yet answered."""

    asked: Answered
    sum: Checksum


@dataclass(slots=True)
class FtpClient:
    """One client's part in MAVLink FTP."""

    session: Session = field(default_factory=Session)
    burst: Burst | None = None
    summing: Summing | None = None
    used_us: int = 0
    last_sequence: int | None = None
    last_answer: bytes = b""

    def close(self) -> None:
        """Close what is open."""
        self.session.close()
        self.stop_summing()

    def stop_summing(self) -> None:
        """Forget a checksum that is being worked out, if there is one."""
        if self.summing is not None:
            self.summing.sum.close()
            self.summing = None


# --- logs

PIECE_BYTES = 249
"""LOGGING_DATA.data."""

NO_MESSAGE = 255
"""first_message_offset: no message begins in this piece."""

_HEAD_BYTES = 16
"""The magic, version and time with which a ULog file begins: no message."""
_MESSAGE_HEAD_BYTES = 3


@dataclass(slots=True)
class LogListing:
    """Entries of logs: what is still to be sent of them."""

    entries: Sequence[LogEntry]
    """Of all logs, as they were when the client asked."""
    number: int
    last: int


@dataclass(slots=True)
class LogDownload:
    """A part of a log: what is still to be sent of it."""

    number: int
    offset: int
    end: int


@dataclass(slots=True)
class Piece:
    """A piece of a stream."""

    sequence: int
    first_message: int
    data: bytes


class LogStream:
    """A log that is sent while it is written: first its head, each piece acknowledged, then on.

    Afterwards it goes on with what is written from then on. What a link loses is not repeated.
    """

    def __init__(self, number: int, head_bytes: int, target: tuple[int, int]) -> None:
        """Begin to send log `number` to the system and component `target`."""
        self.number, self.target = number, target
        self.waiting: Piece | None = None
        """A piece of the head that is not yet acknowledged."""
        self.sent_us = 0
        self.tries = 0
        self._head_bytes = head_bytes
        self._offset = 0
        self._sequence = 0
        self._boundaries = MessageBoundaries()

    @property
    def in_head(self) -> bool:
        """Whether pieces are to be acknowledged."""
        return self._offset < self._head_bytes

    def skip_to(self, offset: int) -> None:
        """Go on from the end of a message; only behind the head."""
        self._offset = max(self._offset, offset)
        self._boundaries = MessageBoundaries(skip=0)

    def next_piece(self, read: Callable[[int, int, int], bytes]) -> Piece | None:
        """Return the next piece by `LogStore.read`, None until enough has been written."""
        room = PIECE_BYTES
        if self.in_head:
            room = min(room, self._head_bytes - self._offset)
        data = read(self.number, self._offset, room)
        if len(data) < room:
            return None
        piece = Piece(self._sequence, self._boundaries.first_in(data), data)
        self._offset += len(data)
        self._sequence = self._sequence + 1 & 0xFFFF
        return piece


class MessageBoundaries:
    """Finds where messages begin in a ULog file that comes in pieces."""

    def __init__(self, skip: int = _HEAD_BYTES) -> None:
        """Begin `skip` bytes before the first message."""
        self._skip = skip
        self._head = b""
        """The beginning of a message's head that was cut by the end of a piece."""

    def first_in(self, data: bytes) -> int:
        """Return the place of the first message that begins in a piece; `NO_MESSAGE`: none."""
        first, at = NO_MESSAGE, self._skip
        if self._head:
            # The rest of the head is at the beginning of this piece.
            lacking = _MESSAGE_HEAD_BYTES - len(self._head)
            head = self._head + data[:lacking]
            if len(head) < _MESSAGE_HEAD_BYTES:
                self._head = head
                return first
            at = lacking + int.from_bytes(head[:2], "little")
            self._head = b""
        while at < len(data):
            first = at if first == NO_MESSAGE else first
            head = data[at : at + _MESSAGE_HEAD_BYTES]
            if len(head) < _MESSAGE_HEAD_BYTES:
                self._head = head
                self._skip = 0
                return first
            at += _MESSAGE_HEAD_BYTES + int.from_bytes(head[:2], "little")
        self._skip = at - len(data)
        return first


# --- missions

RETRY_US = 250_000
"""After this time without an item it is asked for again [µs] (PX4)."""

TIMEOUT_US = 5_000_000
"""After this time without a message a transfer is given up [µs] (PX4)."""

NOBODY = (-1, -1)


class Activity(Enum):
    """State of a link's mission protocol."""

    IDLE = auto()
    SENDING = auto()
    """A client downloads."""
    RECEIVING = auto()
    """A client uploads."""


REPEATS = 10
"""How often MISSION_ITEM_REACHED is sent again, each after REPEAT_US."""
REPEAT_US = 1_000_000


@dataclass(slots=True)
class MissionTransfer:
    """The state of one link's transfers."""

    activity: Activity = Activity.IDLE
    kind: int = 0
    """MAV_MISSION_TYPE of the newest transfer."""
    index: int = 0
    count: int = 0
    current: int = -1
    """The item that the upload marks as current; -1 = none."""
    checksum: int = 0
    items: list[PlanItem] = field(default_factory=list)
    partner: tuple[int, int] = NOBODY
    """System and component id of the client."""
    integer: bool = False
    """Items travel as MISSION_ITEM_INT; PX4 begins with MISSION_REQUEST and learns."""
    sent_us: int = 0
    """Time of the newest request to the client."""
    heard_us: int = 0
    """Time of the client's newest message."""

    # What this link has told its clients of the mission.
    told_current: int = 0
    told_reached: int = -1
    repeats: int = 0
    """Repetitions of the newest MISSION_ITEM_REACHED."""
    repeated_us: int = 0
    told_jumped: tuple[int, int] = (-1, 0)

    @property
    def is_running(self) -> bool:
        """Whether messages are due by time: requests to the client, or repetitions."""
        repeats = self.told_reached >= 0 and self.repeats < REPEATS
        return self.activity is not Activity.IDLE or repeats


# --- calibrations


class Step(NamedTuple):
    """A text of a calibration."""

    after_s: float
    """Time after the text before [s]."""
    message: Message


class RunningCalibration:
    """One vehicle's calibration, for all of its clients."""

    def __init__(self) -> None:
        self.sensor = ""
        self.radio = False
        """A ground station calibrates a radio: it ends that with a cancellation."""
        self._steps: Iterator[Step] = iter(())
        self._next: Step | None = None
        self._due_us = 0

    @property
    def forbids_arming(self) -> bool:
        """Whether PX4 refuses to arm meanwhile."""
        return self.active or self.radio

    @property
    def active(self) -> bool:
        """Whether there is more to come."""
        return self._next is not None

    def start(self, sensor: str, steps: Iterator[Step], now_us: int) -> None:
        """Begin to calibrate a sensor, in the place of what may be running."""
        self.sensor, self._steps, self._due_us = sensor, steps, now_us
        self._plan()

    def due(self, now_us: int) -> list[Message]:
        """Return what is due at `now_us` [µs], in order."""
        messages: list[Message] = []
        while self._next is not None and self._due_us <= now_us:
            messages.append(self._next.message)
            self._plan()
        return messages

    def _plan(self) -> None:
        self._next = next(self._steps, None)
        if self._next is not None:
            self._due_us += round(self._next.after_s * US_PER_S)


# --- the shell


@dataclass(slots=True)
class Shell:
    """One client's shell."""

    line: bytearray = field(default_factory=bytearray)
    output: bytearray = field(default_factory=bytearray)
