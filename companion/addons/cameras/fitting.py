"""Conversion of a camera's images to the vehicle profile's camera, which policies are trained with.

The profile's camera has few pixels, in the middle of a real camera's field of view. Each pixel is
sampled in the real image at the points of a grid, and the nearest return counts, by the function
with which the built-in layouts downsample an image for the network. Thin obstacles are preserved. A
pixel is "no return" only if all its points are holes of the stereo matcher.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from airl_mav.camera import frame, intrinsics
from airl_mav.core.errors import FieldError
from airl_mav.policy.images import nearest_returns
from airl_mav.profiles.projections import Distortion, distorted, sees_to, undistorted

MOST_POINTS = 16
"""Maximum number of sample points along each side of a pixel."""

LEAST_FORWARD = 1e-3
"""Minimum forward component of a ray with a depth along the optical axis."""

LEAST_COVERAGE = 0.9
"""Minimum share of the target image that a camera must see. A D435 at its tolerance limit, 84
degrees wide instead of 87, sees 0.91 of the image of the vehicle profile `quad-d435`."""


@dataclass(frozen=True)
class Lens:
    """Pinhole lens with undistorted images, as delivered by depth cameras, or a fisheye lens.

    A pixel (u, v) of a pinhole looks along ((u - cx) / fx, (v - cy) / fy, 1) in the optical frame
    (right, down, forward). Pixel centres are at integers, as in librealsense and ROS 2's
    CameraInfo. Depth is along the optical axis for both, so it exists only within 90 degrees of the
    axis.
    """

    width: int
    height: int
    fx: float
    """Focal length in columns [px]."""
    fy: float
    """Focal length in rows [px]."""
    cx: float
    cy: float
    distortion: Distortion | None = None
    """Kannala-Brandt coefficients of a fisheye; None = a pinhole."""

    @property
    def field_of_view(self) -> str:
        """Horizontal and vertical field of view, as text."""
        sides = (0.5 * self.width / self.fx, 0.5 * self.height / self.fy)
        return _in_words(*(_half_rad(side, self.distortion) for side in sides))

    @classmethod
    def of(cls, k: intrinsics.Intrinsics) -> Lens:
        """Return the lens of a profile's camera, a pinhole or a fisheye."""
        bent = k.distortion if k.model.radial else None
        return cls(k.width, k.height, k.focal, k.focal, k.cx, k.cy, bent)


class Fitting:
    """Conversion of images between two cameras with the same orientation."""

    def __init__(self, lens: Lens, wanted: intrinsics.Intrinsics) -> None:
        """Look up each pixel of the target camera in the images of the lens."""
        self.wanted = wanted
        """Target camera of the images returned by `fit`."""
        # Enough points that no pixel of the lens falls between two of them, up to a limit.
        points = math.ceil(max(lens.fx, lens.fy) / wanted.focal)
        points = min(max(points, 1), MOST_POINTS)
        self._shape = lens.height, lens.width
        self._deeper: NDArray[np.float32] | None = None
        """Factors from depth along the axis to the target's depth; None = factor 1."""
        # Pinhole to pinhole is separable: one lookup per row and one per column.
        if lens.distortion is None and wanted.model.planar:
            columns, off_side = _places(
                *(wanted.width, wanted.focal, wanted.cx), *(lens.width, lens.fx, lens.cx), points
            )
            rows, off_end = _places(
                *(wanted.height, wanted.focal, wanted.cy), *(lens.height, lens.fy, lens.cy), points
            )
            self._rows, self._columns = rows[:, None], columns[None, :]
            # A target pixel without a counterpart reads as "no return".
            self._unseen = off_end[:, None] | off_side[None, :]
            self.coverage = 1.0 - float(self._unseen.mean())
            """Share of the target image seen by the lens, 0 to 1."""
            return
        # Otherwise every sample ray is looked up in both dimensions.
        rays = intrinsics.finer(wanted, points).rays
        row, column = _looked_up(lens, rays)
        inside = (row >= 0) & (row < lens.height) & (column >= 0) & (column < lens.width)
        # Indices outside are replaced by 0 and masked by `_unseen`.
        self._rows = np.where(inside, row, 0).astype(np.intp)
        self._columns = np.where(inside, column, 0).astype(np.intp)
        self._unseen = ~inside
        # Rays of a fisheye target outside its image circle are zero and do not count.
        self.coverage = float(inside[rays.any(axis=0)].mean())
        # Targets other than pinholes measure along the ray, the lens along its axis.
        if not wanted.model.planar:
            deeper = np.divide(1.0, rays[0], out=np.ones_like(rays[0]), where=inside)
            self._deeper = deeper.astype(np.float32)

    def fit(self, depth_mm: NDArray[np.uint16]) -> NDArray[np.uint16]:
        """Return the target image (height, width) [mm] of a lens's Z16 image; 0 = no return."""
        if depth_mm.shape != self._shape or depth_mm.dtype != np.uint16:
            raise ValueError(
                f"an image of {depth_mm.dtype} {depth_mm.shape}; accepted: uint16 {self._shape}"
            )
        seen = depth_mm[self._rows, self._columns]
        seen[self._unseen] = 0
        if self._deeper is not None:
            seen = np.minimum(np.rint(seen * self._deeper), frame.MAX_MM).astype(np.uint16)
        # Values of nearest_returns are one less; "no return" wraps around to 0.
        nearest = nearest_returns(seen[None], self.wanted.height, self.wanted.width)
        fitted: NDArray[np.uint16] = nearest[0] + np.uint16(1)
        return fitted


def _looked_up(
    lens: Lens, rays: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return rounded rows and columns (h, w) of a lens for rays (3, h, w); -1 outside."""
    # A pinhole sees only ahead of the lens; a fisheye up to the end of its polynomial.
    forward, right, down = rays
    ahead = forward > LEAST_FORWARD
    if lens.distortion is None:
        scale = 1.0 / np.where(ahead, forward, 1.0)
    else:
        aside = np.hypot(right, down)
        off = np.arctan2(aside, forward)
        ahead &= off <= sees_to(lens.distortion)
        scale = distorted(off, lens.distortion) / np.maximum(aside, 1e-9)
    row, column = (
        # `scale` turns the sideways part of a ray into focal lengths.
        np.rint(lens.cy + lens.fy * down * scale),
        np.rint(lens.cx + lens.fx * right * scale),
    )
    return np.where(ahead, row, -1.0), np.where(ahead, column, -1.0)


def _half_rad(side: float, distortion: Distortion | None) -> float:
    """Return the angle from the axis to an edge at a distance in focal lengths [rad]."""
    if distortion is None:
        return math.atan(side)
    return min(float(undistorted(np.array(side), distortion)), sees_to(distortion))


def _in_words(half_wide_rad: float, half_high_rad: float) -> str:
    wide, high = 2.0 * math.degrees(half_wide_rad), 2.0 * math.degrees(half_high_rad)
    return f"{wide:.0f} x {high:.0f} deg"


def _seen_by(k: intrinsics.Intrinsics) -> str:
    """Return the field of view of a profile's camera, as text."""
    bent = k.distortion if k.model.radial else None
    return _in_words(0.5 * k.horizontal_fov_rad, _half_rad(0.5 * k.height / k.focal, bent))


def _places(
    size: int,
    focal: float,
    centre: float,
    lens_size: int,
    lens_focal: float,
    lens_centre: float,
    points: int,
) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """Return the nearest lens pixels along a pinhole's axis (size x points,) and a miss mask."""
    at = (np.arange(size * points) + 0.5) / points - 0.5
    place = np.rint(lens_centre + lens_focal * (at - centre) / focal).astype(np.intp)
    return np.clip(place, 0, lens_size - 1), (place < 0) | (place >= lens_size)


def check_coverage(name: str, lens: Lens, fitting: Fitting, whose: str) -> None:
    """Raise FieldError for a camera that does not cover the policy's field of view."""
    if fitting.coverage >= LEAST_COVERAGE:
        return
    raise FieldError(
        "camera",
        name,
        problem=f"it sees {lens.field_of_view}: {100.0 * fitting.coverage:.0f} % of what the camera"
        f" of {whose} sees ({_seen_by(fitting.wanted)}); accepted: at least"
        f" {100.0 * LEAST_COVERAGE:.0f} %. Name a vehicle profile whose [camera] is yours, and a"
        " policy trained with it",
    )
