"""A depth frame and its wire format: one ZeroMQ message, header then Z16 pixels."""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.profiles.projection import Projection

MAGICS: dict[Projection, bytes] = {"pinhole": b"ADF1", "cylindrical": b"ADC1"}
"""How a frame begins: air-learning depth frame, or cylinder, version 1."""

_PROJECTION_OF = {magic: projection for projection, magic in MAGICS.items()}

# magic, sequence, capture time [µs], width, height, focal, cx, cy; little endian
_HEADER = struct.Struct("<4sQqHHddd")

MOST_PIXELS = 4096 * 4096
MOST_BYTES = _HEADER.size + 2 * MOST_PIXELS
"""Size of the largest frame, 34 MB: whoever receives them need not take in more."""

MM_PER_M = 1000.0
MAX_MM = 65_535

LEAST_PX, MOST_PX = 1e-3, 1e6
"""Bounds of a focal length, and of how far the optical axis is from the image's corner [px]."""

_TURN = 1.0 + 1e-9
"""A cylinder's image is at most one turn wide, but for rounding."""


class FrameError(ValueError):
    """Bytes that are no frame of this version."""


@dataclass(frozen=True)
class Frame:
    """One depth image, RealSense Z16 convention."""

    sequence: int
    """Counts up by one per captured frame."""
    capture_time_us: int
    """Simulated time of the exposure [µs]."""
    depth_mm: NDArray[np.uint16]
    """(height, width) [mm]; 0 = no return. Along the optical axis of a pinhole, in the camera's
    horizontal plane of a cylinder."""
    intrinsics: Intrinsics

    def depth_m(self) -> NDArray[np.float32]:
        """Return depth (height, width) [m]; 0 = no return."""
        return self.depth_mm.astype(np.float32) / np.float32(MM_PER_M)

    def to_bytes(self) -> bytes:
        """Return the wire form."""
        k = self.intrinsics
        header = _HEADER.pack(
            MAGICS[k.projection],
            *(self.sequence, self.capture_time_us),
            *(k.width, k.height, k.focal, k.cx, k.cy),
        )
        return header + self.depth_mm.astype("<u2", copy=False).tobytes()

    @classmethod
    def from_bytes(cls, data: bytes) -> Frame:
        """Read the wire form.

        Raises FrameError for anything else, also for what no camera takes: an image without pixels
        or with too many, a focal length or a centre out of bounds, or not a number, a cylinder of
        more than a turn.
        """
        if len(data) < _HEADER.size:
            raise FrameError(f"{len(data)} bytes are too short for a frame header")
        magic, sequence, time_us, width, height, focal, cx, cy = _HEADER.unpack_from(data)
        projection = _PROJECTION_OF.get(magic)
        if projection is None:
            known = " or ".join(repr(each) for each in _PROJECTION_OF)
            raise FrameError(f"magic {magic!r}, expected {known}")
        if len(data) != _HEADER.size + 2 * width * height:
            raise FrameError(f"{len(data)} bytes do not hold {width}x{height} pixels")
        if not 0 < width * height <= MOST_PIXELS:
            raise FrameError(f"{width}x{height} pixels: accepted: 1..{MOST_PIXELS}")
        # Written so that NaN fails.
        if not (LEAST_PX <= focal <= MOST_PX and abs(cx) <= MOST_PX and abs(cy) <= MOST_PX):
            raise FrameError(f"focal {focal}, centre {cx}, {cy}: no {projection} camera")
        if projection == "cylindrical" and width > _TURN * 2.0 * math.pi * focal:
            raise FrameError(f"focal {focal}, {width} px wide: a cylinder of more than one turn")
        pixels = np.frombuffer(data, "<u2", offset=_HEADER.size).reshape(height, width)
        return cls(sequence, time_us, pixels, Intrinsics(width, height, focal, cx, cy, projection))


def depth_to_z16(depth_m: NDArray[np.floating]) -> NDArray[np.uint16]:
    """Turn metres (0 = no return) into Z16 millimetres, rounded, clipped to 65,535 mm."""
    z16: NDArray[np.uint16] = np.clip(np.rint(depth_m * MM_PER_M), 0, MAX_MM).astype(np.uint16)
    return z16
