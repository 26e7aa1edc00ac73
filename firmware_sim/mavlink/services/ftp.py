"""MAVLink FTP: requests, replies and bursts.

Source: https://mavlink.io/en/services/ftp.html and PX4 1.16, MavlinkFTP. File operations are in
`ftp_files`; access is limited to the vehicle's storage.
"""

from __future__ import annotations

import errno
import struct

from airl_mav.core.constants import US_PER_S
from firmware_sim.mavlink.codec import WireMessage
from firmware_sim.mavlink.services import component_metadata
from firmware_sim.mavlink.services.context import Context, sender
from firmware_sim.mavlink.services.ftp_files import DATA_BYTES, OPERATIONS, read_at
from firmware_sim.mavlink.services.transfers import (
    SESSION,
    Answered,
    Burst,
    Checksum,
    Code,
    FtpRequest,
    RefusedError,
    Summing,
)

_HEADER = struct.Struct("<HBBBBBxI")
"""Header: sequence, session, opcode, size, requested opcode, burst complete, padding, offset."""

_PAYLOAD_BYTES = 251
_CRC32, _BURST = 14, 15
_ACK, _NAK = 128, 129
_OPENS = (4, 6, 11)
"""Opcodes that open a file: for reading, new, for writing."""

BURST_MESSAGES = 8
"""Maximum messages of a burst per tick: half a megabyte per second."""

_IDLE_US = 10 * US_PER_S
"""Idle time after which the next request closes an open session [µs]."""

_SMALL_BYTES = 4
"""Maximum data of a reply that is kept for retransmission [bytes] (as PX4)."""


def handle_request(message: WireMessage, context: Context) -> bool:
    """Execute a request and reply."""
    payload = bytes(message.payload)
    sequence, session, opcode, size, _, _, offset = _HEADER.unpack_from(payload)
    if opcode in (_ACK, _NAK):
        return False
    client, asker = context.ftp, sender(message)
    if sequence == client.last_sequence:
        _send(client.last_answer, asker, context)
        return True
    if client.summing is not None and client.summing.asked.sequence == sequence:
        return True  # repeated while the checksum is running
    client.stop_summing()
    if client.session.file is not None and context.now_us - client.used_us > _IDLE_US:
        client.session.close()
    client.used_us = context.now_us
    data = payload[_HEADER.size :][: min(size, DATA_BYTES)]
    request = FtpRequest(session, opcode, offset, size, data)
    asked = Answered(sequence, session, opcode, offset, asker)
    try:
        if size > DATA_BYTES:
            raise RefusedError(Code.INVALID_DATA_SIZE)
        if opcode == _BURST:
            client.session.opened(request)
            client.burst = Burst((sequence + 1) & 0xFFFF, offset, asker)
            return True
        if opcode == _CRC32:
            component_metadata.provide(context.storage)
            checksum = Checksum(context.storage.path(request.name))
            client.burst = None
            client.summing = Summing(asked, checksum)
            _sum(client.summing, context)
            return True
        answer = _carried_out(request, context)
        kind = _ACK
    except (RefusedError, OSError) as error:
        answer, kind = _error(error), _NAK
    client.burst = None
    _answer(asked, kind, answer, context)
    return True


def _answer(request: Answered, kind: int, answer: bytes, context: Context) -> None:
    client = context.ftp
    sequence = (request.sequence + 1) & 0xFFFF
    # As in PX4: the client's session number, except after opening a session.
    opened = kind == _ACK and request.opcode in _OPENS
    session = SESSION if opened else request.session
    body = _packed(sequence, session, kind, request.opcode, request.offset, answer)
    small = len(answer) <= _SMALL_BYTES
    client.last_sequence, client.last_answer = (request.sequence, body) if small else (None, b"")
    _send(body, request.asker, context)


def _sum(summing: Summing, context: Context) -> None:
    """Continue a checksum, and reply when it is complete."""
    kind = _ACK
    try:
        answer = summing.sum.go_on()
    except OSError as error:
        answer, kind = _error(error), _NAK
    if answer is not None:
        context.ftp.stop_summing()
        _answer(summing.asked, kind, answer, context)


def send_pending(context: Context) -> None:
    """Send the next messages of a burst, or continue a checksum; call once per tick."""
    client = context.ftp
    if client.summing is not None:
        _sum(client.summing, context)
    if client.burst is None:
        return
    for _ in range(BURST_MESSAGES):
        burst = client.burst
        if burst is None:
            return
        kind, offset, file = _ACK, burst.offset, client.session.file
        try:
            if file is None:
                raise RefusedError(Code.INVALID_SESSION)
            data = read_at(file, offset, DATA_BYTES)
            burst.offset += len(data)
        except (RefusedError, OSError) as error:
            data, kind, client.burst = _error(error), _NAK, None
        body = _packed(burst.sequence, SESSION, kind, _BURST, offset, data)
        burst.sequence = (burst.sequence + 1) & 0xFFFF
        client.used_us = context.now_us
        _send(body, burst.asker, context)


def _carried_out(request: FtpRequest, context: Context) -> bytes:
    operation = OPERATIONS.get(request.opcode)
    if operation is None:
        raise RefusedError(Code.UNKNOWN_COMMAND)
    component_metadata.provide(context.storage)
    return operation(request, context.ftp.session, context.storage)


def _error(error: RefusedError | OSError) -> bytes:
    """Return the data of a NAK."""
    if isinstance(error, RefusedError):
        return bytes([error.code])
    number = error.errno or 0
    code = {
        errno.EEXIST: Code.FILE_EXISTS,
        errno.ENOENT: Code.FILE_NOT_FOUND,
        errno.EACCES: Code.FILE_PROTECTED,
        errno.ELOOP: Code.FILE_PROTECTED,
    }.get(number)
    return bytes([Code.FAIL_ERRNO, number & 0xFF]) if code is None else bytes([code])


def _packed(sequence: int, session: int, kind: int, opcode: int, offset: int, data: bytes) -> bytes:
    complete = 0
    header = _HEADER.pack(sequence, session, kind, len(data), opcode, complete, offset)
    return (header + data).ljust(_PAYLOAD_BYTES, b"\0")


def _send(body: bytes, asker: tuple[int, int], context: Context) -> None:
    network = 0
    context.link.send_payload("FILE_TRANSFER_PROTOCOL", bytes((network, *asker)) + body)
