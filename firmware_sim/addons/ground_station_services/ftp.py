"""MAVLink FTP: requests, replies, bursts and file operations within the vehicle's storage.

Source: https://mavlink.io/en/services/ftp.html and PX4 1.16, MavlinkFTP.
"""

from __future__ import annotations

import errno
import struct
from dataclasses import dataclass, field
from pathlib import Path

from airl_mav.core.constants import US_PER_S
from firmware_sim.addons.ground_station_services import component_metadata, files
from firmware_sim.mavlink import codec, services

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


@dataclass(slots=True)
class Burst:
    """State of a burst read in progress."""

    sequence: int
    offset: int
    receiver: tuple[int, int]


class Checksum:
    """CRC-32 of a file, computed in parts: a large file takes longer than a tick."""

    def __init__(self, request: files.FtpRequest, path: Path) -> None:
        """Open the file. Raises OSError."""
        self.request = request
        self._crc = 0
        self._file = path.open("rb", buffering=0)

    def next_part(self) -> bytes | None:
        """Read the next part; return the reply's data after the last. Raises OSError."""
        chunk = self._file.read(files.CHUNK_BYTES)
        self._crc = codec.crc32part(chunk, self._crc)
        # A full chunk means that more data may follow, possibly empty.
        return None if len(chunk) == files.CHUNK_BYTES else self._crc.to_bytes(4, "little")

    def close(self) -> None:
        """Close the file. Repeated calls have no effect."""
        self._file.close()


@dataclass(slots=True)
class FtpClient(services.ServiceState):
    """FTP state of one client."""

    session: files.Session = field(default_factory=files.Session)
    burst: Burst | None = None
    checksum: Checksum | None = None
    used_us: int = 0
    last_sequence: int | None = None
    last_answer: bytes = b""

    @property
    def is_running(self) -> bool:
        """True during a burst or a checksum."""
        return self.burst is not None or self.checksum is not None

    def close(self) -> None:
        """Close the open file and stop the checksum."""
        self.session.close()
        self.stop_checksum()

    def stop_checksum(self) -> None:
        """Cancel a checksum in progress, if any."""
        if self.checksum is not None:
            self.checksum.close()
            self.checksum = None


def handle_request(message: codec.WireMessage, context: services.Context) -> bool:
    """Execute a request and reply."""
    payload = bytes(message.payload)
    sequence, session, opcode, size, _, _, offset = _HEADER.unpack_from(payload)
    # Replies from another FTP server on the link.
    if opcode in (_ACK, _NAK):
        return False
    client = context.state(FtpClient)
    # The client repeats a request whose reply was lost: resend, do not execute twice.
    if sequence == client.last_sequence:
        _send(client.last_answer, services.sender(message), context)
        return True
    if client.checksum is not None and client.checksum.request.sequence == sequence:
        return True  # repeated while the checksum is running
    # A new request ends a running checksum, since a client has one request at a time.
    client.stop_checksum()
    # A client that crashed leaves its session open.
    if client.session.file is not None and context.now_us - client.used_us > _IDLE_US:
        client.session.close()
    client.used_us = context.now_us
    data = payload[_HEADER.size :][: min(size, files.DATA_BYTES)]
    request = files.FtpRequest(
        sequence, session, opcode, offset, size, data, services.sender(message)
    )
    try:
        if size > files.DATA_BYTES:
            raise files.RefusedError(files.Code.INVALID_DATA_SIZE)
        # A burst read has no separate reply: `send_pending` sends the data.
        if opcode == _BURST:
            client.session.opened(request)
            client.burst = Burst((sequence + 1) & 0xFFFF, offset, request.sender)
            return True
        # Checksums of large files take several ticks.
        if opcode == _CRC32:
            storage = context.vehicle_state(files.Storage)
            component_metadata.provide(storage, context.port.parameters.release.name)
            client.checksum = Checksum(request, storage.path(request.name))
            client.burst = None
            _continue_checksum(client.checksum, context)
            return True
        answer, kind = _execute(request, context), _ACK
    except (files.RefusedError, OSError) as error:
        answer, kind = _error(error), _NAK
    # Any other request ends a burst.
    client.burst = None
    _answer(request, kind, answer, context)
    return True


def _answer(request: files.FtpRequest, kind: int, answer: bytes, context: services.Context) -> None:
    client = context.state(FtpClient)
    sequence = (request.sequence + 1) & 0xFFFF
    # As in PX4: the client's session number, except after opening a session.
    opened = kind == _ACK and request.opcode in _OPENS
    session = files.SESSION if opened else request.session
    body = _packed(sequence, session, kind, request.opcode, request.offset, answer)
    small = len(answer) <= _SMALL_BYTES
    # Large replies are not kept: the client reads again by offset.
    client.last_sequence, client.last_answer = (request.sequence, body) if small else (None, b"")
    _send(body, request.sender, context)


def _continue_checksum(checksum: Checksum, context: services.Context) -> None:
    """Continue a checksum, and reply when it is complete."""
    kind = _ACK
    try:
        answer = checksum.next_part()
    except OSError as error:
        answer, kind = _error(error), _NAK
    if answer is not None:
        context.state(FtpClient).stop_checksum()
        _answer(checksum.request, kind, answer, context)


def send_pending(context: services.Context) -> None:
    """Send the next messages of a burst, or continue a checksum; call once per tick."""
    client = context.states.get(FtpClient)
    if client is None:
        return
    if client.checksum is not None:
        _continue_checksum(client.checksum, context)
    if client.burst is None:
        return
    # The file can end, or the session close, within this loop.
    for _ in range(BURST_MESSAGES):
        burst = client.burst
        if burst is None:
            return
        kind, offset, file = _ACK, burst.offset, client.session.file
        try:
            if file is None:
                raise files.RefusedError(files.Code.INVALID_SESSION)
            data = files.read_at(file, offset, files.DATA_BYTES)
            burst.offset += len(data)
        # END_OF_FILE as a NAK ends the burst, as the protocol requires.
        except (files.RefusedError, OSError) as error:
            data, kind, client.burst = _error(error), _NAK, None
        body = _packed(burst.sequence, files.SESSION, kind, _BURST, offset, data)
        burst.sequence = (burst.sequence + 1) & 0xFFFF
        client.used_us = context.now_us
        _send(body, burst.receiver, context)


def _execute(request: files.FtpRequest, context: services.Context) -> bytes:
    operation = files.OPERATIONS.get(request.opcode)
    if operation is None:
        raise files.RefusedError(files.Code.UNKNOWN_COMMAND)
    storage = context.vehicle_state(files.Storage)
    component_metadata.provide(storage, context.port.parameters.release.name)
    return operation(request, context.state(FtpClient).session, storage)


def _error(error: files.RefusedError | OSError) -> bytes:
    """Return the data of a NAK."""
    if isinstance(error, files.RefusedError):
        return bytes([error.code])
    # Codes with a name come first; other errors carry their errno.
    number = error.errno or 0
    code = {
        errno.EEXIST: files.Code.FILE_EXISTS,
        errno.ENOENT: files.Code.FILE_NOT_FOUND,
        errno.EACCES: files.Code.FILE_PROTECTED,
        errno.ELOOP: files.Code.FILE_PROTECTED,
    }.get(number)
    return bytes([files.Code.FAIL_ERRNO, number & 0xFF]) if code is None else bytes([code])


def _packed(sequence: int, session: int, kind: int, opcode: int, offset: int, data: bytes) -> bytes:
    complete = 0
    header = _HEADER.pack(sequence, session, kind, len(data), opcode, complete, offset)
    return (header + data).ljust(_PAYLOAD_BYTES, b"\0")


def _send(body: bytes, receiver: tuple[int, int], context: services.Context) -> None:
    network = 0
    context.link.send_payload("FILE_TRANSFER_PROTOCOL", bytes((network, *receiver)) + body)


# --- MAVLink FTP


HANDLERS: services.Handlers = {
    "FILE_TRANSFER_PROTOCOL": (services.for_vehicle_or_all, handle_request)
}
