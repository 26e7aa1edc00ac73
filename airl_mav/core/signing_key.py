"""The file of a signing key, for its owner alone, and that of the newest time stamp beside it."""

from __future__ import annotations

import contextlib
import os
import stat
from pathlib import Path

from airl_mav.core.clock import Clock, WallClock, utc_now
from airl_mav.core.constants import US_PER_S
from airl_mav.core.errors import FieldError
from airl_mav.core.files import replace_file
from airl_mav.core.signing import KEY_BYTES, Signing

OPTION = "signing_key"
"""The field of a scenario that names the file."""

SAVE_EVERY_US = 60 * US_PER_S
"""The newest time stamp is written so often [µs of wall time]."""


def read_key(path: Path) -> bytes:
    """Return the 32 bytes that a file holds as 64 hexadecimal digits.

    Raises:
        FieldError: The file is missing, others may read it, or it holds no key.
    """
    try:
        mode = path.stat().st_mode
        text = path.read_text(encoding="ascii", errors="replace")
    except OSError as error:
        raise FieldError(OPTION, path, problem=f"cannot be read: {error.strerror}") from None
    if stat.S_IMODE(mode) & 0o077:
        shown = f"{stat.S_IMODE(mode):04o}"
        raise FieldError(OPTION, path, problem=f"mode {shown}: others may read it; chmod 600 it")
    try:
        key = bytes.fromhex(text)
    except ValueError:
        key = b""
    if len(key) != KEY_BYTES or not any(key):
        raise FieldError(OPTION, path, problem="no key: must be 64 hexadecimal digits, not all 0")
    return key


def write_key(path: Path, key: bytes) -> None:
    """Write a key to a file that only its owner can read, whole. Raises OSError."""
    partial = path.with_name(path.name + ".partial")
    partial.unlink(missing_ok=True)
    descriptor = os.open(partial, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    with os.fdopen(descriptor, "w", encoding="ascii") as file:
        file.write(key.hex() + "\n")
        file.flush()
        os.fsync(file.fileno())
    partial.replace(path)


class StoredSigning:
    """A `Signing` whose key and newest time stamp outlive the program."""

    def __init__(self, path: Path | None, clock: Clock | None = None) -> None:
        """Read both; without a path there is no key at first, and nothing is stored.

        `clock` is wall time, for how often the time stamp is written. Raises FieldError as
        `read_key`.
        """
        self._path = path
        self._clock = clock or WallClock()
        self.signing = Signing(calendar_us)
        if path is not None:
            self.signing.change(read_key(path), _read_stamp(_stamp_path(path)))
            self.signing.on_key = self._store_key
        self._next_us = self._clock.time_us() + SAVE_EVERY_US

    def save_due(self) -> None:
        """Write the newest time stamp now and then; to be called often."""
        if self._path is not None and self._clock.time_us() >= self._next_us:
            self.save()

    def save(self) -> None:
        """Write the newest time stamp, where it can be written: no flight ends over it.

        A program that begins without it takes the calendar's time, and what was sent in the last
        minute before could be replayed to it.
        """
        self._next_us = self._clock.time_us() + SAVE_EVERY_US
        if self._path is not None and self.signing.key is not None:
            with contextlib.suppress(OSError):
                replace_file(_stamp_path(self._path), f"{self.signing.timestamp}\n".encode())

    def _store_key(self) -> None:
        """Keep a key that came over a link, or forget it."""
        if self._path is None:
            return
        if self.signing.key is None:
            self._path.unlink(missing_ok=True)
        else:
            write_key(self._path, self.signing.key)
            self.save()


def calendar_us() -> int:
    """Return the calendar time [µs since 1970], which time stamps of signatures are made of."""
    return int(utc_now().timestamp() * US_PER_S)


def _stamp_path(path: Path) -> Path:
    return path.with_name(path.name + ".timestamp")


def _read_stamp(path: Path) -> int:
    try:
        return max(0, int(path.read_text(encoding="ascii")))
    except (OSError, ValueError):
        return 0  # the calendar is what else there is
