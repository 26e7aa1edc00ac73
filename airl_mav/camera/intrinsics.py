"""The models of a camera: a pinhole, a cylinder that sees all round, a fisheye; and its pixels."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from airl_mav.profiles.camera_kind import CameraKind, Projection, shape_of
from airl_mav.profiles.distortion import UNDISTORTED, Distortion, distorted, sees_to, undistorted

if TYPE_CHECKING:  # A frame source needs no models of profiles.
    from airl_mav.profiles.camera import Camera


@dataclass(frozen=True)
class Intrinsics:
    """Intrinsics with square pixels. Pixel centres are at whole numbers.

    Its `kind` is part of them, so that whoever asks whether two cameras are the same asks for it.

    In the optical frame (right, down, forward) a pixel (u, v) looks along

    - pinhole, RealSense convention: ((u - cx) / focal, (v - cy) / focal, 1). Depth is measured
      along the optical axis.
    - cylindrical: (sin a, (v - cy) / focal, cos a) with a = (u - cx) / focal [rad], clockwise seen
      from above. Depth is measured in the camera's horizontal plane, perpendicular to the axis of
      the cylinder. Upright edges are upright in the image, and the column of the optical axis is
      that of a pinhole of the same focal length.
    - fisheye: (sin b cos c, sin b sin c, cos b), at the angle b [rad] from the optical axis that
      `profiles.distortion` makes r / focal of, where r is the way from (cx, cy) to the pixel and c
      its direction. Without coefficients b is r / focal, equidistant. Depth is measured along that
      unit vector. Pixels more than 95 degrees from the axis see nothing, nor do those beyond the
      angle to which the coefficients hold.

    In all of them depth is the factor of that vector which leads to the point that is seen.
    """

    width: int
    height: int
    focal: float
    """Focal length [px] of a pinhole, pixels for an angle [px/rad] of a cylinder and in the middle
    of a fisheye."""
    cx: float
    cy: float
    projection: Projection = "pinhole"
    kind: CameraKind = "depth"
    distortion: Distortion = UNDISTORTED

    @classmethod
    def from_fov(
        cls,
        width: int,
        height: int,
        horizontal_fov: float,
        projection: Projection = "pinhole",
        kind: CameraKind = "depth",
        distortion: Distortion = UNDISTORTED,
    ) -> Intrinsics:
        """Return the intrinsics of a camera with a horizontal field of view [rad].

        Up to pi for a pinhole, 2 pi for a cylinder, 190 degrees for a fisheye; half of it falls on
        the edge of the image.
        """
        if projection != "pinhole":
            focal = width / (2.0 * distorted(0.5 * horizontal_fov, distortion))
        else:
            focal = 0.5 * width / math.tan(0.5 * horizontal_fov)
        cx, cy = 0.5 * (width - 1), 0.5 * (height - 1)
        return cls(width, height, focal, cx, cy, projection, kind, distortion)

    @classmethod
    def of(cls, camera: Camera) -> Intrinsics:
        """Return the intrinsics of a vehicle profile's camera."""
        return cls.from_fov(
            camera.width_px,
            camera.height_px,
            math.radians(camera.horizontal_fov_deg),
            camera.projection,
            camera.kind,
            camera.distortion,
        )

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of its images: (h, w) of depth, (h, w, channels) of colour."""
        return shape_of(self.kind, self.height, self.width)

    @property
    def dtype(self) -> type[np.uint16] | type[np.uint8]:
        """Type of its pixels: millimetres of depth, or sRGB numbers."""
        return np.uint16 if self.kind == "depth" else np.uint8

    @property
    def cylindrical(self) -> bool:
        """Whether the image is a cylinder's."""
        return self.projection == "cylindrical"

    @property
    def horizontal_fov_rad(self) -> float:
        """Horizontal field of view [rad], from edge to edge of the image."""
        if self.distortion != UNDISTORTED:
            half = undistorted(np.array(0.5 * self.width / self.focal), self.distortion)
            return 2.0 * min(float(half), sees_to(self.distortion))
        if self.projection != "pinhole":
            return self.width / self.focal
        return 2.0 * math.atan2(0.5 * self.width, self.focal)
