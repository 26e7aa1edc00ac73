"""MAVLink 2 message signing: who has the key may speak, and nothing is taken twice.

Source: https://mavlink.io/en/guide/message_signing.html. A signed frame has an incompatibility flag
and ends with 13 bytes: a link id, a time stamp of 48 bits (units of 10 µs since 2015), and the
first 6 bytes of SHA-256 over key, frame, link id and time stamp.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import hmac
import os
import stat
from collections.abc import Callable, Iterator
from pathlib import Path

from airl_mav.core.clock import Clock, WallClock, utc_now
from airl_mav.core.constants import US_PER_S
from airl_mav.core.errors import FieldError
from airl_mav.core.files import replace_file

KEY_BYTES = 32
SIGNATURE_BYTES = 13
"""What a signed frame has more than an unsigned one."""

EPOCH_UNIX_US = 1_420_070_400_000_000
"""2015-01-01T00:00Z, when time stamps begin [µs since 1970]."""
UNIT_US = 10
"""What a time stamp counts [µs]."""

LATE = 60 * 1_000_000 // UNIT_US
"""A sender that was never heard may lag our time by this much: a minute, in units of 10 µs."""

MAX_STREAMS = 256
"""Senders (link id, system, component) whose newest time stamps are kept."""

UNSIGNED_IDS = frozenset((0, 109, 246, 247))
"""HEARTBEAT, RADIO_STATUS, ADSB_VEHICLE, COLLISION: what PX4 takes without a signature, as radios
and transponders have no key (PX4 PR 25284)."""

_MARKER = 0xFD
_HEADER = 10
_CHECKSUM = 2
_SIGNED = 0x01
_LAST = (1 << 48) - 1


class Signing:
    """A key, the newest time stamps, and what they decide. Shared by all links of a program."""

    def __init__(
        self, calendar_us: Callable[[], int], key: bytes | None = None, timestamp: int = 0
    ) -> None:
        """Begin with a key of 32 bytes, or None: nothing is signed or required.

        `calendar_us` returns the calendar time [µs since 1970], `timestamp` is the newest one that
        was used with the key [10 µs since 2015].
        """
        self._calendar_us = calendar_us
        self.key = key
        self.timestamp = timestamp
        """The newest, ours or another's."""
        self.refused = 0
        """Frames that were unsigned, forged or old."""
        self.on_key: Callable[[], None] = lambda: None
        """Called when the key changes."""
        self._streams: dict[tuple[int, int, int], int] = {}
        self._began: Callable[[], hashlib._Hash] = hashlib.sha256
        self.change(key, timestamp)

    def change(self, key: bytes | None, timestamp: int = 0) -> None:
        """Take another key, or None, with its newest time stamp [10 µs since 2015]."""
        if key is not None and len(key) != KEY_BYTES:
            raise ValueError(f"a key of {len(key)} bytes: must have {KEY_BYTES}")
        self.key = key
        self.timestamp = min(timestamp, _LAST)
        self._streams.clear()
        if key is not None:
            self._began = hashlib.sha256(key).copy
        self.on_key()

    def sign(self, frame: bytes, link_id: int) -> bytes:
        """Return an unsigned MAVLink 2 frame with a signature; as it is where there is no key."""
        if self.key is None or frame[0] != _MARKER or frame[2] & _SIGNED:
            return frame
        self.timestamp = min(max(self.timestamp + 1, self._now()), _LAST)
        length = frame[1]
        crc = int.from_bytes(frame[-_CHECKSUM:], "little") ^ _flag_in_checksum(length)
        covered = b"".join(
            (
                frame[:2],
                bytes((frame[2] | _SIGNED,)),
                frame[3 : _HEADER + length],
                crc.to_bytes(2, "little"),
                bytes((link_id,)),
                self.timestamp.to_bytes(6, "little"),
            )
        )
        return covered + self._signature(covered)

    def accepts(self, frame: bytes) -> bool:
        """Return whether a frame may be taken. One that may is too old the next time.

        Without a key everything may. The frame's checksum is not looked at.
        """
        if self.key is None:
            return True
        accepted = self._accepts(frame)
        self.refused += not accepted
        return accepted

    def _accepts(self, frame: bytes) -> bool:
        if frame[0] != _MARKER:
            return frame[5] in UNSIGNED_IDS
        if not frame[2] & _SIGNED:
            return int.from_bytes(frame[7:10], "little") in UNSIGNED_IDS
        stream = frame[-SIGNATURE_BYTES], frame[5], frame[6]
        timestamp = int.from_bytes(frame[-12:-6], "little")
        newest = self._streams.get(stream)
        if newest is None:
            if timestamp + LATE < max(self.timestamp, self._now()):
                return False
        elif timestamp <= newest:
            return False
        if not hmac.compare_digest(self._signature(frame[:-6]), frame[-6:]):
            return False
        if newest is None and len(self._streams) >= MAX_STREAMS:
            return False
        self._streams[stream] = timestamp
        self.timestamp = max(self.timestamp, timestamp)
        return True

    def _signature(self, covered: bytes) -> bytes:
        digest = self._began()
        digest.update(covered)
        return digest.digest()[:6]

    def _now(self) -> int:
        return min(max(0, (self._calendar_us() - EPOCH_UNIX_US) // UNIT_US), _LAST)


@functools.cache
def _flag_in_checksum(length: int) -> int:
    """Return what the signed flag changes in the checksum of a frame with so long a payload.

    The checksum (CRC-16/MCRF4XX) is linear: the change depends on how many bytes follow the flag,
    and not on what they are. So nobody needs to know the messages to sign them.
    """
    crc = 0
    # From the flag on: eight more bytes of the header, the payload, the message's own CRC byte.
    for byte in (_SIGNED, *bytes(_HEADER - 3 + length + 1)):
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0x8408 if crc & 1 else 0)
    return crc


def frames_of(datagram: bytes) -> Iterator[bytes]:
    """Yield the MAVLink 2 frames of a datagram, by their lengths; what is none is left out."""
    start = 0
    while start + _HEADER + _CHECKSUM <= len(datagram):
        if datagram[start] != _MARKER:
            start += 1
            continue
        signature = SIGNATURE_BYTES if datagram[start + 2] & _SIGNED else 0
        end = start + _HEADER + datagram[start + 1] + _CHECKSUM + signature
        if end > len(datagram):
            return
        yield datagram[start:end]
        start = end


# --- the file of a key, for its owner alone, and that of the newest time stamp beside it

OPTION = "signing_key"
"""The field of a scenario that names the file."""

SAVE_EVERY_US = 60 * US_PER_S
"""The newest time stamp is written so often [µs of wall time]."""


def read_key(path: Path) -> bytes:
    """Return the 32 bytes of a file of hexadecimal digits, or raise FieldError."""
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
        """Read both, or raise FieldError; without a path there is no key, and nothing is stored."""
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
