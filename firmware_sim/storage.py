"""Memory card of the vehicle: one folder that confines all paths."""

from __future__ import annotations

import errno
import os
import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

GREATEST_BYTES = 64 * 1024 * 1024
"""Maximum total size of clients' files [bytes], so that no client can fill the disk."""

GREATEST_FILES = 1_000
"""Maximum number of files and folders: they are counted and listed within a tick."""


class Storage:
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


class LogEntry(NamedTuple):
    """Flight log on board."""

    utc_s: int
    """Start or completion time of the log [s since 1970]."""
    size_bytes: int


class OpenLog(NamedTuple):
    """Log currently being written."""

    number: int
    """Index in `LogStore.entries`."""
    head_bytes: int
    """Size of the log header: format, parameters."""
    size_bytes: int
    """Current size, at a message boundary."""


class LogStore:
    """Flight logs on board; a log's number is its index in `entries`. This one is empty."""

    def entries(self) -> Sequence[LogEntry]:
        """Return the logs, oldest first."""
        return ()

    def read(self, number: int, offset: int, count: int) -> bytes:
        """Return up to `count` bytes of a log, fewer at its end; none if the log does not exist."""
        del number, offset, count
        return b""

    def open_log(self) -> OpenLog | None:
        """Return the log currently being written; None = no open log."""
        return None
