"""Flight logs: listing, download, and streaming of the open log.

Protocol: LOG_REQUEST_LIST and related messages of MAVLink's common set, and MAV_CMD_LOGGING_START
with LOGGING_DATA(_ACKED), as in PX4 1.16 (mavlink_log_handler.cpp, mavlink_ulog.cpp).
"""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

from firmware_sim.autopilot.autopilot_state import OperatorText, Result, Severity
from firmware_sim.mavlink import codec, services

PACKETS_PER_TICK = 8
"""LOG_DATA messages per client and tick: 180 kB per second."""
PIECES_PER_TICK = 2
"""LOGGING_DATA messages per client and tick: 125 kB per second. The log grows by 25 kB."""

_PACKET_BYTES = 90
"""Size of LOG_DATA.data [bytes]."""
_LOG_DATA = struct.Struct(f"<IHB{_PACKET_BYTES}s")
"""Wire format: offset, number, count, data."""
_ACK_TIMEOUT_US = 50_000
_ACK_TRIES = 50
"""ACK_TIMEOUT [µs] and ACK_MAX_TRIES of ulog_stream_ack."""

PIECE_BYTES = 249
"""Size of LOGGING_DATA.data [bytes]."""

NO_MESSAGE = 255
"""Value of first_message_offset if no message starts in this piece."""

_FILE_HEAD_BYTES, _MESSAGE_HEAD_BYTES = 16, 3
"""Size of a ULog header (magic, version and time) and of a message header [bytes]."""


@dataclass(slots=True)
class LogDownload:
    """Part of a log that remains to be sent."""

    number: int
    offset: int
    end: int


class Piece(NamedTuple):
    """Piece of a log stream: the fields of LOGGING_DATA."""

    sequence: int
    length: int
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
        self._skip = _FILE_HEAD_BYTES
        """Offset of the next message in the next piece."""
        self._cut = b""
        """Start of a message header truncated by the end of a piece."""

    @property
    def in_head(self) -> bool:
        """True if pieces require acknowledgement."""
        return self._offset < self._head_bytes

    def skip_to(self, offset: int) -> None:
        """Continue from the end of a message. Valid only after the header."""
        self._offset = max(self._offset, offset)
        self._skip, self._cut = 0, b""

    def next_piece(self, read: Callable[[int, int, int], bytes]) -> Piece | None:
        """Return the next piece, read by `LogStore.read`; None until enough data is written."""
        room = PIECE_BYTES
        if self.in_head:
            # A piece does not mix header and data: only header pieces are acknowledged.
            room = min(room, self._head_bytes - self._offset)
        data = read(self.number, self._offset, room)
        if len(data) < room:
            return None
        padded = data.ljust(PIECE_BYTES, b"\0")
        piece = Piece(self._sequence, len(data), self._first_message(data), padded)
        self._offset += len(data)
        # The sequence number has 16 bits and wraps around.
        self._sequence = self._sequence + 1 & 0xFFFF
        return piece

    def _first_message(self, data: bytes) -> int:
        """Return the offset of the first message that starts in the next piece."""
        before, first, at = len(self._cut), NO_MESSAGE, self._skip
        whole, self._cut = self._cut + data, b""
        # Walk from message to message by the size in each header.
        while at < len(whole):
            if first == NO_MESSAGE and at >= before:
                first = at - before
            header = whole[at : at + _MESSAGE_HEAD_BYTES]
            if len(header) < _MESSAGE_HEAD_BYTES:
                self._cut, at = header, len(whole)
                break
            at += _MESSAGE_HEAD_BYTES + int.from_bytes(header[:2], "little")
        self._skip = at - len(whole)
        return first


@dataclass(slots=True)
class LogTransfers(services.ServiceState):
    """Log transfers of one client."""

    listing: deque[codec.WireMessage] = field(default_factory=deque)
    """LOG_ENTRY messages that remain to be sent, one per tick."""
    download: LogDownload | None = None
    stream: LogStream | None = None

    @property
    def is_running(self) -> bool:
        """True during any transfer."""
        return bool(self.listing) or self.download is not None or self.stream is not None


def send_pending(context: services.Context) -> None:
    """Send the next part of a client's log transfers; call once per tick."""
    logs = context.states.get(LogTransfers)
    if logs is None:
        return
    if logs.listing:
        context.link.send(logs.listing.popleft())
    if logs.download is not None:
        _send_data(context, logs.download)
    if logs.stream is not None:
        _stream(context, logs.stream)


# --- list and download


def handle_list(message: codec.WireMessage, context: services.Context) -> bool:
    """Start sending the entries from `start` to `end`."""
    entries = context.port.logs.entries()
    total = len(entries)
    # An empty list is one entry with count 0.
    if total == 0:
        context.link.send(codec.dialect.MAVLink_log_entry_message(0, 0, 0, 0, 0))
        return True
    # Clients request up to 65535: the range ends at the last log.
    first, last = (min(number, total - 1) for number in (message.start, message.end))
    context.state(LogTransfers).listing = deque(
        codec.dialect.MAVLink_log_entry_message(number, total, total - 1, *entries[number])
        for number in range(first, last + 1)
    )
    return True


def handle_data(message: codec.WireMessage, context: services.Context) -> bool:
    """Start sending a part of a log."""
    end = message.ofs + message.count
    context.state(LogTransfers).download = LogDownload(message.id, message.ofs, end)
    return True


def handle_end(_message: codec.WireMessage, context: services.Context) -> bool:
    """Stop sending."""
    logs = context.state(LogTransfers)
    logs.listing.clear()
    logs.download = None
    return True


def handle_erase(_message: codec.WireMessage, context: services.Context) -> bool:
    """Reject the request: a flight's log is its record, and clients may not delete it."""
    context.announce(OperatorText(Severity.WARNING, "Logs are not erased: they belong to the run"))
    return True


def _send_data(context: services.Context, download: LogDownload) -> None:
    requested = min(PACKETS_PER_TICK * _PACKET_BYTES, download.end - download.offset)
    data = context.port.logs.read(download.number, download.offset, requested)
    # A packet that is not full signals the end of the log to the client.
    for at in range(0, max(len(data), 1), _PACKET_BYTES):
        part = data[at : at + _PACKET_BYTES]
        context.link.send_payload(
            "LOG_DATA", _LOG_DATA.pack(download.offset + at, download.number, len(part), part)
        )
    download.offset += len(data)
    # A short read is the end of the file.
    if len(data) < requested or download.offset >= download.end:
        context.state(LogTransfers).download = None


# --- streaming of the open log


def _start(command: services.VehicleCommand, context: services.Context) -> Result:
    log = context.port.logs.open_log()
    if log is None:
        return Result.FAILED
    context.state(LogTransfers).stream = LogStream(log.number, log.head_bytes, command.sender)
    return Result.ACCEPTED


def _stop(_command: services.VehicleCommand, context: services.Context) -> None:
    """Stop the stream. PX4 does not acknowledge this command."""
    context.state(LogTransfers).stream = None


def handle_ack(message: codec.WireMessage, context: services.Context) -> bool:
    """Continue after an acknowledged piece of the log header."""
    stream = context.state(LogTransfers).stream
    if stream is None or stream.waiting is None or stream.waiting.sequence != message.sequence:
        return False
    stream.waiting = None
    return True


def _stream(context: services.Context, stream: LogStream) -> None:
    if stream.waiting is not None:
        # No retry before the timeout: the acknowledgement may be on its way.
        if context.now_us - stream.sent_us < _ACK_TIMEOUT_US:
            return
        # PX4 also stops the stream after this number of tries.
        if stream.tries >= _ACK_TRIES:
            context.state(LogTransfers).stream = None
            return
        _send_acked(context, stream, stream.waiting)
        return
    logs = context.port.logs
    for _ in range(PIECES_PER_TICK):
        in_head = stream.in_head
        piece = stream.next_piece(logs.read)
        # The header is sent reliably, one piece at a time; the data is not.
        if in_head:
            if piece is not None:
                stream.waiting, stream.tries = piece, 0
                _send_acked(context, stream, piece)
            log = logs.open_log()
            if not stream.in_head and log is not None:
                # The client can download data from before its request.
                stream.skip_to(log.size_bytes)
        if in_head or piece is None:
            return
        context.link.send(codec.dialect.MAVLink_logging_data_message(*stream.target, *piece))


def _send_acked(context: services.Context, stream: LogStream, piece: Piece) -> None:
    stream.sent_us, stream.tries = context.now_us, stream.tries + 1
    context.link.send(codec.dialect.MAVLink_logging_data_acked_message(*stream.target, *piece))


ACTIONS: dict[int, services.Action] = {
    codec.dialect.MAV_CMD_LOGGING_START: _start,
    codec.dialect.MAV_CMD_LOGGING_STOP: _stop,
}

HANDLERS: services.Handlers = {
    "LOG_REQUEST_LIST": (services.for_vehicle_or_all, handle_list),
    "LOG_REQUEST_DATA": (services.for_vehicle_or_all, handle_data),
    "LOG_REQUEST_END": (services.for_vehicle_or_all, handle_end),
    "LOG_ERASE": (services.for_vehicle_or_all, handle_erase),
    "LOGGING_ACK": (services.for_vehicle_or_all, handle_ack),
}
