"""MAVLink FTP: requests, replies, bursts and file operations within the vehicle's storage.

Source: https://mavlink.io/en/services/ftp.html and PX4 1.16, MavlinkFTP.
"""

from __future__ import annotations

import errno
import os
import struct
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

from airl_mav.core.constants import US_PER_S
from firmware_sim.mavlink.codec import WireMessage
from firmware_sim.mavlink.services import component_metadata
from firmware_sim.mavlink.services.context import Context, sender
from firmware_sim.mavlink.services.transfers import (
    CHUNK_BYTES,
    SESSION,
    Answered,
    Burst,
    Checksum,
    Code,
    FtpRequest,
    RefusedError,
    Session,
    Summing,
)
from firmware_sim.storage import Storage

DATA_BYTES = 239
"""Maximum data in one message [bytes]."""

READ_ONLY = "etc"
"""Folder of the vehicle's files, read-only for clients."""

_SIZE = struct.Struct("<I")


Operation = Callable[[FtpRequest, Session, Storage], bytes]
"""Executes a request and returns the data of the reply.

Raises RefusedError or OSError for a NAK."""


def _list(request: FtpRequest, _session: Session, storage: Storage) -> bytes:
    """List a folder from entry number `offset`: D and name, or F, name, tab and size."""
    folder = storage.path(request.name)
    if not folder.is_dir():
        raise RefusedError(Code.FILE_NOT_FOUND)
    with os.scandir(folder) as scanned:
        # Sorted: offsets must stay valid between the requests of one listing.
        entries = sorted(scanned, key=lambda entry: entry.name)
    found = bytearray()
    for entry in entries[request.offset :]:
        line = _line(entry)
        # An entry never spans two messages; the client continues at the next offset.
        if len(found) + len(line) > DATA_BYTES:
            break
        found += line
    if not found:
        raise RefusedError(Code.END_OF_FILE)
    return bytes(found)


def _line(entry: os.DirEntry[str]) -> bytes:
    name = os.fsencode(entry.name)
    if entry.is_dir(follow_symlinks=False):
        return b"D" + name + b"\0"
    if entry.is_file(follow_symlinks=False):
        return b"F" + name + b"\t%d" % entry.stat().st_size + b"\0"
    return b"S\0"  # for example a link: skipped, as in PX4


def _open_to_read(request: FtpRequest, session: Session, storage: Storage) -> bytes:
    path = storage.path(request.name)
    # One session per client, as in PX4.
    _check_free(session)
    if path.is_dir():
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
    session.file = path.open("rb")
    session.size = path.stat().st_size
    return _SIZE.pack(session.size)


def _create(request: FtpRequest, session: Session, storage: Storage) -> bytes:
    return _open_to_write(request, session, storage, os.O_TRUNC)


def _open_existing(request: FtpRequest, session: Session, storage: Storage) -> bytes:
    return _open_to_write(request, session, storage, 0)


def _open_to_write(request: FtpRequest, session: Session, storage: Storage, flags: int) -> bytes:
    path = _writable(request.name, storage)
    _check_free(session)
    storage.check_room(0)
    # O_NOFOLLOW: a link could point outside the vehicle's storage.
    number = os.open(path, os.O_CREAT | os.O_RDWR | os.O_NOFOLLOW | flags, 0o666)
    # Unbuffered: other clients read the data at once.
    session.file = os.fdopen(number, "r+b", buffering=0)
    session.size = path.stat().st_size
    return _SIZE.pack(session.size)


def read_at(file: BinaryIO, offset: int, size: int) -> bytes:
    """Return data of a file from an offset. Raises RefusedError at the end of the file."""
    file.seek(offset)
    data = file.read(min(size, DATA_BYTES))
    if not data:
        raise RefusedError(Code.END_OF_FILE)
    return data


def _read(request: FtpRequest, session: Session, _storage: Storage) -> bytes:
    return read_at(session.opened(request), request.offset, request.size)


def _write(request: FtpRequest, session: Session, storage: Storage) -> bytes:
    file = session.opened(request)
    end = request.offset + len(request.data)
    if end > session.size:
        # The room is checked once per chunk of growth, because the check scans the storage.
        if end // CHUNK_BYTES != session.size // CHUNK_BYTES:
            storage.check_room(end - session.size)
        session.size = end
    file.seek(request.offset)
    return _SIZE.pack(file.write(request.data))


def _terminate(request: FtpRequest, session: Session, _storage: Storage) -> bytes:
    session.opened(request)
    session.close()
    return b""


def _reset(_request: FtpRequest, session: Session, _storage: Storage) -> bytes:
    session.close()
    return b""


def _on_path(change: Callable[[Path], object], *, more: bool = False) -> Operation:
    """Return an operation on the requested path; `more`: the operation creates an entry."""

    def operation(request: FtpRequest, _session: Session, storage: Storage) -> bytes:
        path = _writable(request.name, storage)
        if more:
            storage.check_room(0)
        change(path)
        return b""

    return operation


def _truncate(request: FtpRequest, _session: Session, storage: Storage) -> bytes:
    path = _writable(request.name, storage)
    # Only growth needs room.
    more = request.offset - path.stat().st_size
    if more > 0:
        storage.check_room(more)
    os.truncate(path, request.offset)
    return b""


def _rename(request: FtpRequest, _session: Session, storage: Storage) -> bytes:
    # RENAME has two names, each terminated by NUL.
    old, separator, rest = request.data.partition(b"\0")
    new = rest.split(b"\0", 1)[0]
    if not separator or not new:
        raise OSError(errno.EINVAL, os.strerror(errno.EINVAL))
    source = _writable(os.fsdecode(old), storage)
    source.rename(_writable(os.fsdecode(new), storage))
    return b""


def _nothing(_request: FtpRequest, _session: Session, _storage: Storage) -> bytes:
    return b""


def _check_free(session: Session) -> None:
    if session.file is not None:
        raise RefusedError(Code.NO_SESSIONS)


def _writable(name: str, storage: Storage) -> Path:
    """Return the path of a file that clients may change. Raises RefusedError otherwise."""
    path = storage.path(name)
    # The root and the vehicle's own files are protected.
    parts = path.relative_to(storage.folder).parts
    if not parts or parts[0] == READ_ONLY:
        raise RefusedError(Code.FILE_PROTECTED)
    return path


OPERATIONS: dict[int, Operation] = {
    0: _nothing,
    1: _terminate,
    2: _reset,
    3: _list,
    4: _open_to_read,
    5: _read,
    6: _create,
    7: _write,
    8: _on_path(Path.unlink),
    9: _on_path(Path.mkdir, more=True),
    10: _on_path(Path.rmdir),
    11: _open_existing,
    12: _truncate,
    13: _rename,
}
"""Operations by opcode. `ftp` handles checksums and burst reads, which take several ticks."""


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
    # Replies from another FTP server on the link.
    if opcode in (_ACK, _NAK):
        return False
    client, asker = context.ftp, sender(message)
    # The client repeats a request whose reply was lost: resend, do not execute twice.
    if sequence == client.last_sequence:
        _send(client.last_answer, asker, context)
        return True
    if client.summing is not None and client.summing.asked.sequence == sequence:
        return True  # repeated while the checksum is running
    # A new request ends a running checksum, since a client has one request at a time.
    client.stop_summing()
    # A client that crashed leaves its session open.
    if client.session.file is not None and context.now_us - client.used_us > _IDLE_US:
        client.session.close()
    client.used_us = context.now_us
    data = payload[_HEADER.size :][: min(size, DATA_BYTES)]
    request = FtpRequest(session, opcode, offset, size, data)
    asked = Answered(sequence, session, opcode, offset, asker)
    try:
        if size > DATA_BYTES:
            raise RefusedError(Code.INVALID_DATA_SIZE)
        # A burst read has no separate reply: `send_pending` sends the data.
        if opcode == _BURST:
            client.session.opened(request)
            client.burst = Burst((sequence + 1) & 0xFFFF, offset, asker)
            return True
        # Checksums of large files take several ticks.
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
    # Any other request ends a burst.
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
    # Large replies are not kept: the client reads again by offset.
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
    # The file can end, or the session close, within this loop.
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
        # END_OF_FILE as a NAK ends the burst, as the protocol requires.
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
    # Codes with a name come first; other errors carry their errno.
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
