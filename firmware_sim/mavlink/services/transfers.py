"""State of clients' transfers: files (MAVLink FTP), logs, missions, calibrations, the shell."""

from __future__ import annotations

import os
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from pathlib import Path
from typing import BinaryIO, NamedTuple

from airl_mav.core.constants import US_PER_S
from firmware_sim.autopilot.autopilot_state import OperatorText
from firmware_sim.autopilot.port import LogEntry

_ALL_ONES = 0xFFFF_FFFF


def crc32part(data: bytes, crc: int = 0) -> int:
    """Return the CRC-32 of preceding data (`crc`) and `data`.

    zlib inverts before and after; PX4's crc32part() does not.
    """
    return zlib.crc32(data, crc ^ _ALL_ONES) ^ _ALL_ONES


# --- MAVLink FTP

CHUNK_BYTES = 1 << 16

SESSION = 0
"""Number of a client's only session, as in PX4."""


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
    """Error for a request that is answered with a NAK."""

    def __init__(self, code: Code) -> None:
        super().__init__(code.name)
        self.code = code


@dataclass(slots=True)
class FtpRequest:
    """Unpacked FTP request."""

    session: int
    opcode: int
    offset: int
    size: int
    """Size of the data; in a read, the requested size."""
    data: bytes

    @property
    def name(self) -> str:
        """Path of the requested file."""
        return os.fsdecode(self.data.split(b"\0", 1)[0])


@dataclass(slots=True)
class Session:
    """State of a client's open file."""

    file: BinaryIO | None = None
    size: int = 0
    """Size of the file [bytes], when opened and after writes."""

    def opened(self, request: FtpRequest) -> BinaryIO:
        """Return the open file. Raises RefusedError if no file is open."""
        if request.session != SESSION or self.file is None:
            raise RefusedError(Code.INVALID_SESSION)
        return self.file

    def close(self) -> None:
        """Close the file, if open."""
        if self.file is not None:
            self.file.close()
            self.file = None


@dataclass(slots=True)
class Burst:
    """State of a burst read in progress."""

    sequence: int
    offset: int
    asker: tuple[int, int]


class Answered(NamedTuple):
    """Fields of a reply that refer to its request."""

    sequence: int
    session: int
    opcode: int
    offset: int
    asker: tuple[int, int]


class Checksum:
    """CRC-32 of a file, computed in parts: a large file takes longer than a tick."""

    def __init__(self, path: Path) -> None:
        """Open the file. Raises OSError."""
        self._crc = 0
        self._file = path.open("rb", buffering=0)

    def go_on(self) -> bytes | None:
        """Read the next part; return the reply's data after the last. Raises OSError."""
        chunk = self._file.read(CHUNK_BYTES)
        self._crc = crc32part(chunk, self._crc)
        # A full chunk means that more data may follow, possibly empty.
        if len(chunk) == CHUNK_BYTES:
            return None
        return self._crc.to_bytes(4, "little")

    def close(self) -> None:
        """Close the file. Repeated calls have no effect."""
        self._file.close()


@dataclass(slots=True)
class Summing:
    """Checksum request in progress."""

    asked: Answered
    sum: Checksum


@dataclass(slots=True)
class FtpClient:
    """FTP state of one client."""

    session: Session = field(default_factory=Session)
    burst: Burst | None = None
    summing: Summing | None = None
    used_us: int = 0
    last_sequence: int | None = None
    last_answer: bytes = b""

    def close(self) -> None:
        """Close the open file and stop the checksum."""
        self.session.close()
        self.stop_summing()

    def stop_summing(self) -> None:
        """Cancel a checksum in progress, if any."""
        if self.summing is not None:
            self.summing.sum.close()
            self.summing = None


# --- logs

PIECE_BYTES = 249
"""Size of LOGGING_DATA.data [bytes]."""

NO_MESSAGE = 255
"""Value of first_message_offset if no message starts in this piece."""

_HEAD_BYTES = 16
"""Size of a ULog header [bytes]: magic, version and time, before the first message."""
_MESSAGE_HEAD_BYTES = 3


@dataclass(slots=True)
class LogListing:
    """Log entries that remain to be sent."""

    entries: Sequence[LogEntry]
    """Entries of all logs at the time of the request."""
    number: int
    last: int


@dataclass(slots=True)
class LogDownload:
    """Part of a log that remains to be sent."""

    number: int
    offset: int
    end: int


@dataclass(slots=True)
class Piece:
    """Piece of a log stream."""

    sequence: int
    first_message: int
    data: bytes


class LogStream:
    """Stream of an open log: the header in acknowledged pieces, then the data as written.

    After the header, lost data is not retransmitted.
    """

    def __init__(self, number: int, head_bytes: int, target: tuple[int, int]) -> None:
        """Start sending log `number` to the system and component `target`."""
        self.number, self.target = number, target
        self.waiting: Piece | None = None
        """Piece of the header awaiting acknowledgement."""
        self.sent_us = 0
        self.tries = 0
        self._head_bytes = head_bytes
        self._offset = 0
        self._sequence = 0
        self._boundaries = MessageBoundaries()

    @property
    def in_head(self) -> bool:
        """True if pieces require acknowledgement."""
        return self._offset < self._head_bytes

    def skip_to(self, offset: int) -> None:
        """Continue from the end of a message. Valid only after the header."""
        self._offset = max(self._offset, offset)
        self._boundaries = MessageBoundaries(skip=0)

    def next_piece(self, read: Callable[[int, int, int], bytes]) -> Piece | None:
        """Return the next piece, read by `LogStore.read`; None until enough data is written."""
        room = PIECE_BYTES
        if self.in_head:
            # A piece does not mix header and data: only header pieces are acknowledged.
            room = min(room, self._head_bytes - self._offset)
        data = read(self.number, self._offset, room)
        if len(data) < room:
            return None
        piece = Piece(self._sequence, self._boundaries.first_in(data), data)
        self._offset += len(data)
        # The sequence number has 16 bits and wraps around.
        self._sequence = self._sequence + 1 & 0xFFFF
        return piece


class MessageBoundaries:
    """Finder of message boundaries in a ULog file that arrives in pieces."""

    def __init__(self, skip: int = _HEAD_BYTES) -> None:
        """Start `skip` bytes before the first message."""
        self._skip = skip
        self._head = b""
        """Start of a message header truncated by the end of a piece."""

    def first_in(self, data: bytes) -> int:
        """Return the offset of the first message that starts in a piece; `NO_MESSAGE` if absent."""
        first, at = NO_MESSAGE, self._skip
        if self._head:
            # `_head` holds a message header that was split between two pieces.
            # The rest of the header is at the start of this piece.
            lacking = _MESSAGE_HEAD_BYTES - len(self._head)
            head = self._head + data[:lacking]
            if len(head) < _MESSAGE_HEAD_BYTES:
                self._head = head
                return first
            at = lacking + int.from_bytes(head[:2], "little")
            self._head = b""
        # Walk from message to message by the size in each header.
        while at < len(data):
            first = at if first == NO_MESSAGE else first
            head = data[at : at + _MESSAGE_HEAD_BYTES]
            if len(head) < _MESSAGE_HEAD_BYTES:
                self._head = head
                self._skip = 0
                return first
            at += _MESSAGE_HEAD_BYTES + int.from_bytes(head[:2], "little")
        # The next message starts this many bytes into the next piece.
        self._skip = at - len(data)
        return first


# --- missions


# --- calibrations


class CalibrationText(NamedTuple):
    """Text of a calibration."""

    after_s: float
    """Time after the previous text [s]."""
    message: OperatorText


class RunningCalibration:
    """Calibration in progress of one vehicle, common to all its clients."""

    def __init__(self) -> None:
        self.sensor = ""
        self.radio = False
        """True while a ground station calibrates a radio; a cancellation ends it."""
        self._steps: Iterator[CalibrationText] = iter(())
        self._next: CalibrationText | None = None
        self._due_us = 0

    @property
    def forbids_arming(self) -> bool:
        """True if PX4 rejects arming because of the calibration."""
        return self.active or self.radio

    @property
    def active(self) -> bool:
        """True if steps remain."""
        return self._next is not None

    def start(self, sensor: str, steps: Iterator[CalibrationText], now_us: int) -> None:
        """Start calibrating a sensor. Replaces a running calibration."""
        self.sensor, self._steps, self._due_us = sensor, steps, now_us
        self._plan()

    def due(self, now_us: int) -> list[OperatorText]:
        """Return the messages due at `now_us` [µs], in order."""
        messages: list[OperatorText] = []
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
    """Shell state of one client."""

    line: bytearray = field(default_factory=bytearray)
    output: bytearray = field(default_factory=bytearray)
