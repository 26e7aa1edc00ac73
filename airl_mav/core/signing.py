"""MAVLink 2 message signing: authentication by a key, and replay protection.

Source: https://mavlink.io/en/guide/message_signing.html. A signed frame has an incompatibility flag
and ends with 13 bytes: a link id, a time stamp of 48 bits (units of 10 µs since 2015), and the
first 6 bytes of SHA-256 over key, frame, link id and time stamp.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import hmac
import ipaddress
import stat
from collections.abc import Callable, Iterator
from pathlib import Path

from airl_mav.core.clock import Clock, WallClock, utc_now
from airl_mav.core.constants import US_PER_S
from airl_mav.core.errors import FieldError
from airl_mav.core.files import replace_file

KEY_BYTES = 32
SIGNATURE_BYTES = 13
"""Length of the signature at the end of a signed frame."""

EPOCH_UNIX_US = 1_420_070_400_000_000
"""Epoch of time stamps, 2015-01-01T00:00Z [µs since 1970]."""
UNIT_US = 10
"""Unit of a time stamp [µs]."""

LATE = 60 * 1_000_000 // UNIT_US
"""Maximum lag of a new sender's time stamp behind local time: a minute, in units of 10 µs."""

MAX_STREAMS = 256
"""Maximum number of senders (link id, system, component) with stored time stamps."""

UNSIGNED_IDS = frozenset((0, 109, 246, 247))
"""HEARTBEAT, RADIO_STATUS, ADSB_VEHICLE, COLLISION: accepted by PX4 without a signature, as radios
and transponders have no key (PX4 PR 25284). Here the first signed frame ends that: a HEARTBEAT
reports modes and announces systems."""

_MARKER = 0xFD
_HEADER = 10
_CHECKSUM = 2
_SIGNED = 0x01
_LAST = (1 << 48) - 1


class Signing:
    """Signing key and newest time stamps, shared by all links of a program."""

    def __init__(
        self, calendar_us: Callable[[], int], key: bytes | None = None, timestamp: int = 0
    ) -> None:
        """Set a key of 32 bytes, or None to disable signing.

        `calendar_us` returns the calendar time [µs since 1970]; `timestamp` is the newest time
        stamp used with the key [10 µs since 2015].
        """
        self._calendar_us = calendar_us
        self.key = key
        self.timestamp = timestamp
        """Newest time stamp, local or received."""
        self.floor = 0
        """Time stamp up to which an earlier program may have accepted frames; they are rejected."""
        self.refused = 0
        """Number of unsigned, forged or outdated frames."""
        self.on_key: Callable[[], None] = lambda: None
        """Callback for a change of the key."""
        self._streams: dict[tuple[int, int, int], int] = {}
        self._own: set[bytes] = set()
        """System and component ids of signed frames: their echo is a replay."""
        self._began: Callable[[], hashlib._Hash] = hashlib.sha256
        self.change(key, timestamp)

    def change(self, key: bytes | None, timestamp: int = 0) -> None:
        """Set a new key, or None, with its newest time stamp [10 µs since 2015]."""
        if key is not None and len(key) != KEY_BYTES:
            raise ValueError(f"a key of {len(key)} bytes: must have {KEY_BYTES}")
        self.key = key
        self.timestamp = min(timestamp, _LAST)
        self.floor = 0
        self._streams.clear()
        if key is not None:
            self._began = hashlib.sha256(key).copy
        self.on_key()

    def sign(self, frame: bytes, link_id: int) -> bytes:
        """Return a MAVLink 2 frame with a signature; unchanged if it is signed or without a key."""
        if self.key is None or frame[0] != _MARKER or frame[2] & _SIGNED:
            return frame
        self._own.add(frame[5:7])
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

    def accepts(self, frame: bytes, *, unsigned: bool = True) -> bool:
        """Return True if a frame is accepted; its time stamp is then used up.

        Without a key all frames are accepted. The frame's checksum is not verified. `unsigned`
        accepts `UNSIGNED_IDS` without a signature until the first signed frame.
        """
        if self.key is None:
            return True
        accepted = self._accepts(frame, unsigned and not self._streams)
        self.refused += not accepted
        return accepted

    def _accepts(self, frame: bytes, unsigned: bool) -> bool:
        if frame[0] != _MARKER:
            return unsigned and frame[5] in UNSIGNED_IDS
        if not frame[2] & _SIGNED:
            return unsigned and int.from_bytes(frame[7:10], "little") in UNSIGNED_IDS
        stream = frame[-SIGNATURE_BYTES], frame[5], frame[6]
        timestamp = int.from_bytes(frame[-12:-6], "little")
        newest = self._streams.get(stream)
        if newest is None:
            if timestamp <= self.floor or timestamp + LATE < max(self.timestamp, self._now()):
                return False
        elif timestamp <= newest:
            return False
        if not hmac.compare_digest(self._signature(frame[:-6]), frame[-6:]):
            return False
        if frame[5:7] in self._own or (newest is None and len(self._streams) >= MAX_STREAMS):
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
    """Return the checksum's change by the signed flag, for a frame with a payload length.

    The checksum (CRC-16/MCRF4XX) is linear: the change depends on the number of bytes after the
    flag, not on their values. Signing therefore does not need the message definitions.
    """
    crc = 0
    # From the flag on: eight more bytes of the header, the payload, the message's CRC_EXTRA byte.
    for byte in (_SIGNED, *bytes(_HEADER - 3 + length + 1)):
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0x8408 if crc & 1 else 0)
    return crc


def frames_of(datagram: bytes) -> Iterator[bytes]:
    """Yield the MAVLink 2 frames of a datagram, by their lengths; skips all other bytes."""
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


# --- the key file, private to its owner, and the time stamp file beside it

OPTION = "signing_key"
"""Field of a scenario with the path of the key file."""

LOCAL_TRANSPORTS = ("ipc", "inproc")
"""ZeroMQ transports within a machine."""

SAVE_EVERY_US = 60 * US_PER_S
"""Interval at which the newest time stamp is saved [µs of wall time]."""


def camera_key(
    path: Path | None, endpoint: str, field: str, *, insecure: bool = False
) -> bytes | None:
    """Return the key of a camera's ZeroMQ socket, the secret key of CURVE; None = unencrypted.

    Publisher and subscribers share the file, so its public key is known to them alone.

    Args:
        path: Key file; None = no key.
        endpoint: ZeroMQ address, such as "tcp://192.168.1.2:5600", or the name of a driver.
        field: Field of the address, for messages.
        insecure: Allow unencrypted images of other machines.

    Raises:
        FieldError: The key is invalid or of no use, or other machines need one.
    """
    transport, found, address = endpoint.partition("://")
    if path is not None:
        if not found:
            raise FieldError("camera_key", path, "with the ZeroMQ address of a camera")
        return read_key(path, "camera_key")
    host = (address.rpartition(":")[0] or address).strip("[]")
    if found and transport not in LOCAL_TRANSPORTS and not (insecure or _is_loopback(host)):
        problem = "other machines are on this network and images are unencrypted: give a"
        problem += " --camera-key, or --insecure on a trusted network"
        raise FieldError(field, endpoint, problem=problem)
    return None


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def read_key(path: Path, option: str = OPTION) -> bytes:
    """Return the 32 bytes of a file of hexadecimal digits, or raise FieldError."""
    try:
        mode = path.stat().st_mode
        text = path.read_text(encoding="ascii", errors="replace")
    except OSError as error:
        raise FieldError(option, path, problem=f"cannot be read: {error.strerror}") from None
    if stat.S_IMODE(mode) & 0o077:
        shown = f"{stat.S_IMODE(mode):04o}"
        raise FieldError(option, path, problem=f"mode {shown}: others may read it; chmod 600 it")
    try:
        key = bytes.fromhex(text)
    except ValueError:
        key = b""
    if len(key) != KEY_BYTES or not any(key):
        raise FieldError(option, path, problem="no key: must be 64 hexadecimal digits, not all 0")
    return key


def write_key(path: Path, key: bytes) -> None:
    """Write a key atomically to a file that only its owner can read. Raises OSError."""
    replace_file(path, f"{key.hex()}\n".encode(), 0o600)


class StoredSigning:
    """Signing with a key and a newest time stamp stored in files."""

    def __init__(self, path: Path | None, clock: Clock | None = None) -> None:
        """Read both, or raise FieldError; without a path, signing is off and nothing is stored."""
        self._path = path
        self._clock = clock or WallClock()
        self.signing = Signing(calendar_us)
        if path is not None:
            self.signing.change(read_key(path), _read_stamp(_stamp_path(path)))
            self.signing.floor = self.signing.timestamp
            self.signing.on_key = self._store_key
        self._next_us = self._clock.time_us() + SAVE_EVERY_US

    def save_due(self) -> None:
        """Save the newest time stamp at intervals; call often."""
        if self._path is not None and self._clock.time_us() >= self._next_us:
            self.save()

    def save(self) -> None:
        """Save the newest time stamp; errors are ignored, as they must not end a flight.

        Without the file, a program starts with the calendar time. Messages of the last minute
        before the start could then be replayed.
        """
        self._next_us = self._clock.time_us() + SAVE_EVERY_US
        if self._path is not None and self.signing.key is not None:
            with contextlib.suppress(OSError):
                replace_file(_stamp_path(self._path), f"{self.signing.timestamp}\n".encode())

    def _store_key(self) -> None:
        """Store a key received over a link, or delete it."""
        if self._path is None:
            return
        if self.signing.key is None:
            self._path.unlink(missing_ok=True)
        else:
            write_key(self._path, self.signing.key)
            self.save()


def calendar_us() -> int:
    """Return the calendar time [µs since 1970] for time stamps of signatures."""
    return int(utc_now().timestamp() * US_PER_S)


def _stamp_path(path: Path) -> Path:
    return path.with_name(path.name + ".timestamp")


def _read_stamp(path: Path) -> int:
    try:
        return max(0, int(path.read_text(encoding="ascii")))
    except (OSError, ValueError):
        return 0  # defaults to the calendar time
