"""MAVLink frames one behind the other, as the vehicle sends them: whole, unsigned, version 2."""

from __future__ import annotations

from collections.abc import Iterator

_OVERHEAD = 12
"""Header and checksum of a frame [bytes]."""


def newest_heartbeat(frames: bytes) -> bytes | None:
    """Return the last HEARTBEAT of a sequence, None if there is none."""
    found, start = None, 0
    while start + _OVERHEAD <= len(frames):
        end = start + _OVERHEAD + frames[start + 1]
        if frames[start + 7 : start + 10] == b"\0\0\0":
            found = frames[start:end]
        start = end
    return found


def datagrams(frames: bytes, longest: int) -> Iterator[bytes]:
    """Yield the frames in datagrams of at most `longest` bytes, as few as that makes."""
    start = end = 0
    while end + _OVERHEAD <= len(frames):
        length = _OVERHEAD + frames[end + 1]
        if end + length - start > longest and end > start:
            yield frames[start:end]
            start = end
        end += length
    if end > start:
        yield frames[start:end]
