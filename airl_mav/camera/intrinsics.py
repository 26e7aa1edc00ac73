"""The pinhole model of the depth camera."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # A frame source needs no profiles.
    from airl_mav.profiles.vehicle import Camera


@dataclass(frozen=True)
class Intrinsics:
    """Pinhole intrinsics with square pixels, RealSense convention.

    A pixel (u, v) looks along ((u - cx) / focal, (v - cy) / focal, 1) in the optical frame
    (right, down, forward). Pixel centres are at whole numbers.
    """

    width: int
    height: int
    focal: float
    """Focal length [px]."""
    cx: float
    cy: float

    @classmethod
    def from_fov(cls, width: int, height: int, horizontal_fov: float) -> Intrinsics:
        """Return the intrinsics of a camera with a horizontal field of view [rad] in (0, pi)."""
        focal = 0.5 * width / math.tan(0.5 * horizontal_fov)
        return cls(width, height, focal, 0.5 * (width - 1), 0.5 * (height - 1))

    @classmethod
    def of(cls, camera: Camera) -> Intrinsics:
        """Return the intrinsics of a vehicle profile's camera."""
        return cls.from_fov(
            camera.width_px, camera.height_px, math.radians(camera.horizontal_fov_deg)
        )
