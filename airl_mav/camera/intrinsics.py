"""Camera models (pinhole, cylinder, fisheye): pixel formats and rays."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from airl_mav.profiles.projections import (
    UNDISTORTED,
    CameraKind,
    Distortion,
    Projection,
    distorted,
    sees_to,
    shape_of,
    undistorted,
)

if TYPE_CHECKING:
    from airl_mav.profiles.camera import Camera


@dataclass(frozen=True)
class Intrinsics:
    """Intrinsics with square pixels. Pixel centres have integer coordinates.

    Equality of two cameras includes `kind`.

    In the optical frame (right, down, forward) a pixel (u, v) looks along

    - pinhole, RealSense convention: ((u - cx) / focal, (v - cy) / focal, 1). Depth is measured
      along the optical axis.
    - cylindrical: (sin a, (v - cy) / focal, cos a) with a = (u - cx) / focal [rad], clockwise seen
      from above. Depth is measured in the camera's horizontal plane, perpendicular to the axis of
      the cylinder. Upright edges are upright in the image. The column of the optical axis
      equals a pinhole's with the same focal length.
    - fisheye: (sin b cos c, sin b sin c, cos b), at the angle b [rad] from the optical axis given
      by r / focal and `profiles.distortion`, with r the distance from (cx, cy) to the pixel and c
      its direction. Without coefficients b = r / focal (equidistant). Depth is measured along that
      unit vector. Pixels more than 95 degrees from the axis are empty, as are pixels beyond the
      valid angle of the coefficients.

    In all models the visible point is this vector times depth.
    """

    width: int
    height: int
    focal: float
    """Focal length [px] of a pinhole; pixels per angle [px/rad] of a cylinder, and of a fisheye in
    the middle of its image."""
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

        The maximum is pi for a pinhole, 2 pi for a cylinder and 190 degrees for a fisheye. The
        field of view spans the image from edge to edge.
        """
        if projection != "pinhole":
            focal = width / (2.0 * distorted(0.5 * horizontal_fov, distortion))
        else:
            focal = 0.5 * width / math.tan(0.5 * horizontal_fov)
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
        return shape_of(self.kind, self.height, self.width)

    @property
    def dtype(self) -> type[np.uint16] | type[np.uint8]:
        """Type of its pixels: millimetres of depth, or sRGB numbers."""
        return np.uint16 if self.kind == "depth" else np.uint8

    @property
    def cylindrical(self) -> bool:
        """True if the image is cylindrical."""
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


def rays_of(camera: Intrinsics) -> NDArray[np.float64]:
    """Return rays (3, h, w) forward, right, down at a depth of 1; 0 outside a fisheye's circle."""
    if camera.projection == "fisheye":
        return fisheye_rays(camera)
    rays = np.ones((3, camera.height, camera.width))
    across = (np.arange(camera.width) - camera.cx) / camera.focal
    if camera.cylindrical:
        rays[0], rays[1] = np.cos(across), np.sin(across)
    else:
        rays[1] = across
    rays[2] = ((np.arange(camera.height) - camera.cy) / camera.focal)[:, None]
    return rays


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


def fisheye_rays(camera: Intrinsics) -> NDArray[np.float64]:
    """Return unit rays (3, h, w) forward, right, down of a fisheye; 0 outside the circle."""
    across = (np.arange(camera.width) - camera.cx) / camera.focal
    down = ((np.arange(camera.height) - camera.cy) / camera.focal)[:, None]
    out = np.hypot(across, down)
    off = undistorted(out, camera.distortion)
    # `undistorted` returns infinity beyond the valid angle.
    outside = np.isinf(off)
    off[outside] = 0.0
    # sin(off) / out, which is 1 in the middle.
    share = np.sinc(off / math.pi) * np.divide(off, out, out=np.ones_like(out), where=out > 0.0)
    rays = np.stack([np.cos(off), across * share, down * share])
    rays[:, outside] = 0.0
    return rays


def fisheye_places(camera: Intrinsics, points: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return columns and rows of points (3, ...); infinity outside the circle."""
    aside = np.hypot(points[1], points[2])
    off = np.arctan2(aside, points[0])
    scale = camera.focal * distorted(off, camera.distortion) / np.maximum(aside, 1e-9)
    scale = np.where(off > sees_to(camera.distortion), np.inf, scale)
    with np.errstate(invalid="ignore"):
        return points[1] * scale + camera.cx, points[2] * scale + camera.cy
