"""How far a client has come with the logs that it gets piece by piece: plain data."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from firmware_sim.autopilot.port import LogEntry

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

    Afterwards it goes on with what is written from then on; what a link loses is not repeated.
    """

    def __init__(self, number: int, head_bytes: int, target: tuple[int, int]) -> None:
        """Begin.

        Args:
            number: Of the log.
            head_bytes: Size of its head.
            target: System and component that asked.
        """
        self.number, self.target = number, target
        self.waiting: Piece | None = None
        """A piece of the head that is not yet acknowledged."""
        self.sent_us = 0
        """When it was sent [µs]."""
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
        """Return the next piece, None until enough has been written to fill one.

        `read` is `LogStore.read`.
        """
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
