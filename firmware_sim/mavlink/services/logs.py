"""Flight logs: listing, download, and streaming of the open log.

Protocol: LOG_REQUEST_LIST and related messages of MAVLink's common set, and MAV_CMD_LOGGING_START
with LOGGING_DATA(_ACKED), as in PX4 1.16 (mavlink_log_handler.cpp, mavlink_ulog.cpp).
"""

from __future__ import annotations

import struct

from firmware_sim.autopilot.autopilot_state import OperatorText, Result, Severity
from firmware_sim.mavlink.codec import WireMessage, dialect
from firmware_sim.mavlink.services.context import Action, Context, VehicleCommand
from firmware_sim.mavlink.services.transfers import (
    PIECE_BYTES,
    LogDownload,
    LogListing,
    LogStream,
    Piece,
)

ENTRIES_PER_TICK = 1
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


def send_pending(context: Context) -> None:
    """Send the next part of a client's log transfers; call once per tick."""
    if context.log_listing is not None:
        _send_entries(context, context.log_listing)
    if context.log_download is not None:
        _send_data(context, context.log_download)
    if context.log_stream is not None:
        _stream(context, context.log_stream)


# --- list and download


def handle_list(message: WireMessage, context: Context) -> bool:
    """Start sending the entries from `start` to `end`."""
    entries = context.port.logs.entries()
    total = len(entries)
    # An empty list is one entry with count 0.
    if total == 0:
        number, size, utc_s, last = 0, 0, 0, 0
        context.link.send(dialect.MAVLink_log_entry_message(number, 0, last, utc_s, size))
        return True
    # Clients request up to 65535: the range ends at the last log.
    first, last = (min(number, total - 1) for number in (message.start, message.end))
    context.log_listing = LogListing(entries, first, last)
    return True


def handle_data(message: WireMessage, context: Context) -> bool:
    """Start sending a part of a log."""
    end = message.ofs + message.count
    context.log_download = LogDownload(message.id, message.ofs, end)
    return True


def handle_end(_message: WireMessage, context: Context) -> bool:
    """Stop sending."""
    context.log_listing = context.log_download = None
    return True


def handle_erase(_message: WireMessage, context: Context) -> bool:
    """Reject the request: a flight's log is its record, and clients may not delete it."""
    context.announce(OperatorText(Severity.WARNING, "Logs are not erased: they belong to the run"))
    return True


def _send_entries(context: Context, listing: LogListing) -> None:
    entries, total = listing.entries, len(listing.entries)
    for number in range(listing.number, min(listing.number + ENTRIES_PER_TICK, listing.last + 1)):
        entry = entries[number]
        context.link.send(
            dialect.MAVLink_log_entry_message(
                number, total, total - 1, entry.utc_s, entry.size_bytes
            )
        )
    listing.number += ENTRIES_PER_TICK
    if listing.number > listing.last:
        context.log_listing = None


def _send_data(context: Context, download: LogDownload) -> None:
    wanted = min(PACKETS_PER_TICK * _PACKET_BYTES, download.end - download.offset)
    data = context.port.logs.read(download.number, download.offset, wanted)
    # A packet that is not full signals the end of the log to the client.
    for at in range(0, max(len(data), 1), _PACKET_BYTES):
        part = data[at : at + _PACKET_BYTES]
        context.link.send_payload(
            "LOG_DATA", _LOG_DATA.pack(download.offset + at, download.number, len(part), part)
        )
    download.offset += len(data)
    # A short read is the end of the file.
    if len(data) < wanted or download.offset >= download.end:
        context.log_download = None


# --- streaming of the open log


def _start(command: VehicleCommand, context: Context) -> Result:
    log = context.port.logs.open_log()
    if log is None:
        return Result.FAILED
    context.log_stream = LogStream(log.number, log.head_bytes, command.sender)
    return Result.ACCEPTED


def _stop(_command: VehicleCommand, context: Context) -> None:
    """Stop the stream. PX4 does not acknowledge this command."""
    context.log_stream = None


ACTIONS: dict[int, Action] = {
    dialect.MAV_CMD_LOGGING_START: _start,
    dialect.MAV_CMD_LOGGING_STOP: _stop,
}


def handle_ack(message: WireMessage, context: Context) -> bool:
    """Continue after an acknowledged piece of the log header."""
    stream = context.log_stream
    if stream is None or stream.waiting is None or stream.waiting.sequence != message.sequence:
        return False
    stream.waiting = None
    return True


def _stream(context: Context, stream: LogStream) -> None:
    if stream.waiting is not None:
        # No retry before the timeout: the acknowledgement may be on its way.
        if context.now_us - stream.sent_us < _ACK_TIMEOUT_US:
            return
        # PX4 also stops the stream after this number of tries.
        if stream.tries >= _ACK_TRIES:
            context.log_stream = None
            return
        _send_acked(context, stream, stream.waiting)
        return
    logs = context.port.logs
    for _ in range(PIECES_PER_TICK):
        # The header is sent reliably, one piece at a time; the data is not.
        if stream.in_head:
            piece = stream.next_piece(logs.read)
            if piece is not None:
                stream.waiting, stream.tries = piece, 0
                _send_acked(context, stream, piece)
            log = logs.open_log()
            if not stream.in_head and log is not None:
                # The client can download data from before its request.
                stream.skip_to(log.size_bytes)
            return
        piece = stream.next_piece(logs.read)
        if piece is None:
            return
        context.link.send(dialect.MAVLink_logging_data_message(*stream.target, *_fields(piece)))


def _send_acked(context: Context, stream: LogStream, piece: Piece) -> None:
    stream.sent_us, stream.tries = context.now_us, stream.tries + 1
    context.link.send(dialect.MAVLink_logging_data_acked_message(*stream.target, *_fields(piece)))


def _fields(piece: Piece) -> tuple[int, int, int, bytes]:
    return (
        piece.sequence,
        len(piece.data),
        piece.first_message,
        piece.data.ljust(PIECE_BYTES, b"\0"),
    )
