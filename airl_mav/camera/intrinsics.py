"""Camera models (pinhole, cylinder, fisheye): pixel formats and rays."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from airl_mav.profiles import projections

if TYPE_CHECKING:
    from airl_mav.profiles.camera import Camera


@dataclass(frozen=True)
class Intrinsics:
    """Intrinsics with square pixels. Pixel centres have integer coordinates.

    Equality of two cameras includes `kind`.

    The classes of `profiles.projections.PROJECTIONS` describe the ray and the depth of a pixel.
    """

    width: int
    height: int
    focal: float
    """Focal length [px] of a pinhole; pixels per angle [px/rad] of a cylinder, and of a fisheye in
    the middle of its image."""
    cx: float
    cy: float
    projection: projections.Projection = "pinhole"
    kind: projections.CameraKind = "depth"
    distortion: projections.Distortion = projections.UNDISTORTED

    @classmethod
    def from_fov(
        cls,
        width: int,
        height: int,
        horizontal_fov: float,
        projection: projections.Projection = "pinhole",
        kind: projections.CameraKind = "depth",
        distortion: projections.Distortion = projections.UNDISTORTED,
    ) -> Intrinsics:
        """Return the intrinsics of a camera with a horizontal field of view [rad].

        The maximum is pi for a pinhole, 2 pi for a cylinder and 190 degrees for a fisheye. The
        field of view spans the image from edge to edge.
        """
        focal = projections.PROJECTIONS[projection].focal(width, horizontal_fov, distortion)
        # Pixel centres are integers, so the middle of the image is (n - 1) / 2.
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
        return projections.shape_of(self.kind, self.height, self.width)

    @property
    def dtype(self) -> type[np.uint16] | type[np.uint8]:
        """Type of its pixels: millimetres of depth, or sRGB numbers."""
        return np.uint16 if self.kind == "depth" else np.uint8

    @property
    def model(self) -> projections.ProjectionModel:
        """Projection of directions to the image."""
        return projections.PROJECTIONS[self.projection]

    @property
    def horizontal_fov_rad(self) -> float:
        """Horizontal field of view [rad], from edge to edge of the image."""
        return self.model.fov(self)

    @property
    def rays(self) -> NDArray[np.float64]:
        """Rays (3, h, w) forward, right, down at a depth of 1; 0 in pixels without a direction."""
        return self.model.rays(self)


def finer(camera: Intrinsics, side: int) -> Intrinsics:
    """Return a camera with the same field of view and side x side pixels in place of each."""
    k = camera
    return replace(
        k,
        width=side * k.width,
        height=side * k.height,
        focal=side * k.focal,
        # Pixel centres are integers, so the edge of the image is half a pixel off.
        cx=side * (k.cx + 0.5) - 0.5,
        cy=side * (k.cy + 0.5) - 0.5,
    )
