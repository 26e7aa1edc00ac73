"""File operations of MAVLink FTP: one function per request, on the vehicle's storage.

Requests, replies and error codes follow https://mavlink.io/en/services/ftp.html and a running PX4
1.16 (MavlinkFTP). As in PX4, a session has the number 0, and each client has one.
"""

from __future__ import annotations

import errno
import os
import struct
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

from firmware_sim.mavlink.services.transfers import (
    CHUNK_BYTES,
    Code,
    FtpRequest,
    RefusedError,
    Session,
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
        entries = sorted(scanned, key=lambda entry: entry.name)
    found = bytearray()
    for entry in entries[request.offset :]:
        line = _line(entry)
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
    number = os.open(path, os.O_CREAT | os.O_RDWR | os.O_NOFOLLOW | flags, 0o666)
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
    more = request.offset - path.stat().st_size
    if more > 0:
        storage.check_room(more)
    os.truncate(path, request.offset)
    return b""


def _rename(request: FtpRequest, _session: Session, storage: Storage) -> bytes:
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
