"""MAVLink frames one behind the other, as the vehicle sends them: whole, version 2."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

_OVERHEAD = 12
"""Header and checksum of a frame that is not signed [bytes]."""


def split(frames: bytes) -> Iterator[bytes]:
    """Yield the frames of a sequence in which none is signed."""
    start = 0
    while start + _OVERHEAD <= len(frames):
        end = start + _OVERHEAD + frames[start + 1]
        yield frames[start:end]
        start = end


def newest_heartbeat(frames: bytes) -> bytes | None:
    """Return the last HEARTBEAT of a sequence in which nothing is signed, None if there is none."""
    found = None
    for frame in split(frames):
        if frame[7:10] == b"\0\0\0":
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
