"""Files of the vehicle for MAVLink FTP: a folder that confines all paths, and its operations."""

from __future__ import annotations

import errno
import os
import shutil
import struct
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from functools import partial
from pathlib import Path
from typing import BinaryIO

from firmware_sim.mavlink.services import ServiceState

GREATEST_BYTES = 64 * 1024 * 1024
"""Maximum total size of clients' files [bytes], so that no client can fill the disk."""

GREATEST_FILES = 1_000
"""Maximum number of files and folders: they are counted and listed within a tick."""


class Storage(ServiceState):
    """Files of one vehicle, in a given folder or in a temporary folder removed on close."""

    def __init__(self, folder: Path | None = None) -> None:
        """Use an existing folder; None = a temporary folder, created on first use."""
        self._folder = folder
        self._temporary = folder is None

    @property
    def folder(self) -> Path:
        """Path of the folder."""
        if self._folder is None:
            self._folder = Path(tempfile.mkdtemp(prefix="airl-storage-"))
        return self._folder

    def path(self, name: str) -> Path:
        """Return the path of a client's file name: "/log/a.ulg", "log/a.ulg", ".", "/".

        Raises:
            PermissionError: The path is outside the folder, or contains a symbolic link.
        """
        path = self.folder
        for part in name.split("/"):
            if part in ("", "."):
                continue
            if part == "..":
                raise PermissionError(errno.EACCES, "outside of the storage", name)
            path = path / part
            if path.is_symlink():
                raise PermissionError(errno.EACCES, "a link", name)
        return path

    def check_room(self, more_bytes: int) -> None:
        """Raise OSError (ENOSPC) if `more_bytes` more would exceed the limits."""
        used = count = 0
        folders = [os.fspath(self.folder)]
        while folders:
            with os.scandir(folders.pop()) as entries:
                for entry in entries:
                    count += 1
                    if entry.is_dir(follow_symlinks=False):
                        folders.append(entry.path)
                    else:
                        used += entry.stat(follow_symlinks=False).st_size
        if used + more_bytes > GREATEST_BYTES or count >= GREATEST_FILES:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def close(self) -> None:
        """Remove a temporary folder."""
        if self._temporary and self._folder is not None:
            shutil.rmtree(self._folder, ignore_errors=True)
            self._folder = None


CHUNK_BYTES = 1 << 16

SESSION = 0
"""Number of a client's only session, as in PX4."""


Code = IntEnum(
    "Code",
    "FAIL FAIL_ERRNO INVALID_DATA_SIZE INVALID_SESSION NO_SESSIONS END_OF_FILE UNKNOWN_COMMAND "
    "FILE_EXISTS FILE_PROTECTED FILE_NOT_FOUND",
)
"""Error codes in the first byte of a NAK."""


class RefusedError(Exception):
    """Error for a request that is answered with a NAK."""

    def __init__(self, code: Code) -> None:
        super().__init__(code.name)
        self.code = code


@dataclass(slots=True)
class FtpRequest:
    """Unpacked FTP request."""

    sequence: int
    session: int
    opcode: int
    offset: int
    size: int
    """Size of the data; in a read, the requested size."""
    data: bytes
    sender: tuple[int, int]

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
    session.file = path.open("rb")
    session.size = path.stat().st_size
    return _SIZE.pack(session.size)


def _open_to_write(
    request: FtpRequest, session: Session, storage: Storage, flags: int = 0
) -> bytes:
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
    0: lambda _request, _session, _storage: b"",
    1: _terminate,
    2: _reset,
    3: _list,
    4: _open_to_read,
    5: _read,
    6: partial(_open_to_write, flags=os.O_TRUNC),
    7: _write,
    8: _on_path(Path.unlink),
    9: _on_path(Path.mkdir, more=True),
    10: _on_path(Path.rmdir),
    11: _open_to_write,
    12: _truncate,
    13: _rename,
}
"""Operations by opcode. `ftp` handles checksums and burst reads, which take several ticks."""
