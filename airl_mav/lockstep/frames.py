"""Concatenated MAVLink 2 frames, as sent by the vehicle."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

from firmware_sim.mavlink.codec import layout
from firmware_sim.mavlink.scheduler import ONBOARD_HZ

_OVERHEAD = 12
"""Header and checksum of an unsigned frame [bytes]."""

_MESSAGE = slice(7, 10)
"""Position of the message id in a frame."""

_SENT_BY = slice(5, 10)
"""Position of system id, component id and message id in a frame."""

_PER_INSTANCE = ("DISTANCE_SENSOR",)
"""Streams of several devices, distinguished by a field."""

STATES = frozenset(
    layout(name).id_bytes
    for name, rate_hz in ONBOARD_HZ.items()
    if rate_hz > 1.0 and name not in _PER_INSTANCE
)
"""Messages that replace older ones: state streams, and TIMESYNC, whose answer is not sent to the
vehicle (`inbound`). Answers, events, texts and slow streams such as HEARTBEAT are not included."""


UNREAD = frozenset(
    layout(name).id_bytes
    for name in (
        *("HIGHRES_IMU", "ODOMETRY", "ALTITUDE", "ATTITUDE_TARGET", "SERVO_OUTPUT_RAW", "VFR_HUD"),
        *("POSITION_TARGET_LOCAL_NED", "POSITION_TARGET_GLOBAL_INT", "ESC_INFO", "ESC_STATUS"),
    )
)
"""Messages that the companion never reads from MAVSDK."""


def newest(frames: Sequence[bytes]) -> list[bytes]:
    """Return frames without `UNREAD` messages, and only the newest of each of the `STATES`."""
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
    """Yield the frames of concatenated unsigned frames."""
    start = 0
    while start + _OVERHEAD <= len(frames):
        end = start + _OVERHEAD + frames[start + 1]
        yield frames[start:end]
        start = end


def newest_heartbeat(frames: Iterable[bytes]) -> bytes | None:
    """Return the last HEARTBEAT of some frames, or None."""
    found = None
    for frame in frames:
        if frame[_MESSAGE] == b"\0\0\0":
            found = frame
    return found


def datagrams(frames: Iterable[bytes], longest: int) -> Iterator[bytes]:
    """Pack frames into as few datagrams of at most `longest` bytes as possible."""
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
