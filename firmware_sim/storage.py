"""The vehicle's memory card: one folder, which nothing reaches out of."""

from __future__ import annotations

import errno
import os
import shutil
import tempfile
from pathlib import Path

GREATEST_BYTES = 64 * 1024 * 1024
"""What clients may store altogether: a stranger cannot fill the disk [bytes]."""

GREATEST_FILES = 1_000
"""How many files and folders clients may store: they are counted and listed within a tick."""


class Storage:
    """Files of one vehicle, in a given folder, or in a temporary one that ends with it."""

    def __init__(self, folder: Path | None = None) -> None:
        """Use a folder that exists; None: a temporary one, made when it is first used."""
        self._folder = folder
        self._temporary = folder is None

    @property
    def folder(self) -> Path:
        """The folder itself."""
        if self._folder is None:
            self._folder = Path(tempfile.mkdtemp(prefix="airl-storage-"))
        return self._folder

    def path(self, name: str) -> Path:
        """Return where a file of clients lies: "/log/a.ulg", "log/a.ulg", ".", "/".

        Raises:
            PermissionError: It would lie outside, or a part of it is a link.
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
        """Raise OSError (ENOSPC) when clients have stored too much to store this many bytes."""
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
