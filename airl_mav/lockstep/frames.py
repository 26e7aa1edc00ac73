"""MAVLink frames one behind the other, as the vehicle sends them: whole, version 2."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

from firmware_sim.mavlink.codec import layout
from firmware_sim.mavlink.scheduler import ONBOARD_HZ

_OVERHEAD = 12
"""Header and checksum of a frame that is not signed [bytes]."""

_MESSAGE = slice(7, 10)
"""Where a frame has the number of its message."""

_SENT_BY = slice(5, 10)
"""Where it has that, and before it who sent it."""

_PER_INSTANCE = ("DISTANCE_SENSOR",)
"""Streams of several devices, told apart by a field."""

STATES = frozenset(
    layout(name).id_bytes
    for name, rate_hz in ONBOARD_HZ.items()
    if rate_hz > 1.0 and name not in _PER_INSTANCE
)
"""Messages of which only the newest counts: streams of a state, each a replacement of the one
before, and TIMESYNC, whose answer the vehicle is not sent (`inbound`). Answers, events, texts and
slow streams, as HEARTBEAT, are not among them."""


UNREAD = frozenset(
    layout(name).id_bytes
    for name in (
        *("HIGHRES_IMU", "ODOMETRY", "ALTITUDE", "ATTITUDE_TARGET", "SERVO_OUTPUT_RAW", "VFR_HUD"),
        *("POSITION_TARGET_LOCAL_NED", "POSITION_TARGET_GLOBAL_INT", "ESC_INFO", "ESC_STATUS"),
    )
)
"""Messages of which the companion never asks MAVSDK."""


def newest(frames: Sequence[bytes]) -> list[bytes]:
    """Return the frames that are read: without `UNREAD`, and of each of the `STATES` the newest."""
    kept: list[bytes] = []
    replaced: set[bytes] = set()
    for frame in reversed(frames):
        if frame[_MESSAGE] in UNREAD:
            continue
        if frame[_MESSAGE] in STATES:
            sent_by = frame[_SENT_BY]
            if sent_by in replaced:
                continue
            replaced.add(sent_by)
        kept.append(frame)
    kept.reverse()
    return kept


def split(frames: bytes) -> Iterator[bytes]:
    """Yield the frames of a sequence in which none is signed."""
    start = 0
    while start + _OVERHEAD <= len(frames):
        end = start + _OVERHEAD + frames[start + 1]
        yield frames[start:end]
        start = end


def newest_heartbeat(frames: Iterable[bytes]) -> bytes | None:
    """Return the last HEARTBEAT among frames, None if there is none."""
    found = None
    for frame in frames:
        if frame[_MESSAGE] == b"\0\0\0":
            found = frame
    return found


def datagrams(frames: Iterable[bytes], longest: int) -> Iterator[bytes]:
    """Yield the frames in datagrams of at most `longest` bytes, as few as that makes."""
    waiting: list[bytes] = []
    length = 0
    for frame in frames:
        if waiting and length + len(frame) > longest:
            yield b"".join(waiting)
            waiting, length = [], 0
        waiting.append(frame)
        length += len(frame)
    if waiting:
        yield b"".join(waiting)
