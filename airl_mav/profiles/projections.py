"""Kinds of cameras: the content of their pixels, their projection, and a fisheye's distortion.

A projection is an object in the table `PROJECTIONS`: limits, focal length, rays, positions in the
image, optical flow and export. To add one, write a `ProjectionModel` and enter it there; cameras,
policies, frames and pictures then accept its name.

A fisheye has the model of Kannala and Brandt ("A generic camera model and calibration method for
conventional, wide-angle, and fish-eye lenses", 2006) as in OpenCV's `fisheye` and ROS's
`equidistant`: a ray at an angle theta [rad] from the optical axis is at the distance r = focal
theta_d from the axis in the image, with

    theta_d = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8).

With all coefficients 0 the lens is equidistant, r = focal theta. The maximum angle is where theta_d
stops increasing, and at most 95 degrees.
"""

from __future__ import annotations

import math
from functools import lru_cache
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Final, Literal, TypeAlias, TypeVar, get_args

import numpy as np
from numpy.typing import NDArray

from airl_mav.core import errors

if TYPE_CHECKING:
    from airl_mav.camera.intrinsics import Intrinsics

CameraKind = Literal["depth", "rgb", "grey"]
"""`depth`: uint16 (h, w), Z16 in millimetres. `rgb`: uint8 (h, w, 3), sRGB. `grey`: uint8
(h, w, 1), luma of the sRGB numbers."""

KINDS: Final[tuple[CameraKind, ...]] = get_args(CameraKind)

CHANNELS: Final[dict[CameraKind, int]] = {"depth": 1, "rgb": 3, "grey": 1}
"""Channels of a network's image."""


def shape_of(kind: CameraKind, height: int, width: int) -> tuple[int, ...]:
    """Return the shape of a camera's image: (h, w) for depth, (h, w, channels) for colour."""
    return (height, width) if kind == "depth" else (height, width, CHANNELS[kind])


Distortion = tuple[float, float, float, float]
"""k1, k2, k3, k4."""

UNDISTORTED: Final[Distortion] = (0.0, 0.0, 0.0, 0.0)
"""Coefficients of an equidistant lens."""

MOST_OFF_RAD: Final = math.radians(95.0)
"""Maximum angle from the optical axis for any lens [rad]."""

_MOST_STEPS: Final = 100
"""Iteration limit, enough for bisection alone to converge."""

_ROUNDING: Final = 1e-12
"""Rounding tolerance of the rim of a lens, as a share of theta_d."""

MOST_COEFFICIENT: Final = 100.0
"""Maximum magnitude of a coefficient; real lenses are below 10."""

CYLINDER_MOST_DEG: Final = 360.0
"""Maximum horizontal field of view of any projection [deg]."""

_TURN: Final = 1.0 + 1e-9
"""Maximum width of a cylinder's image, in turns; above 1 for rounding."""

_ON_AXIS: Final = 1e-9
"""Distance from the optical axis below which 1 / z replaces theta_d / aside [m]."""

Floats = NDArray[np.float64]
Angle = TypeVar("Angle", float, NDArray[Any])


def distorted(theta: Angle, k: Distortion) -> Angle:
    """Return theta_d [rad] of angles from the optical axis [rad]; also compiled in kernels."""
    square = theta * theta
    part = k[1] + square * (k[2] + square * k[3])
    found: Angle = theta * (1.0 + square * (k[0] + square * part))
    return found


def steepness(theta: Angle, k: Distortion) -> Angle:
    """Return the derivative of theta_d by theta at angles from the optical axis [rad]."""
    square = theta * theta
    part = 5.0 * k[1] + square * (7.0 * k[2] + square * (9.0 * k[3]))
    found: Angle = 1.0 + square * (3.0 * k[0] + square * part)
    return found


@lru_cache(maxsize=256)
def sees_to(k: Distortion) -> float:
    """Return the off-axis angle [rad] up to which theta_d increases; at most 95 degrees."""
    by_square = [1.0, 3.0 * k[0], 5.0 * k[1], 7.0 * k[2], 9.0 * k[3]]
    turns = _crossings(by_square, MOST_OFF_RAD * MOST_OFF_RAD)
    return math.sqrt(turns[0]) if turns else MOST_OFF_RAD


def undistorted(theta_d: NDArray[Any], k: Distortion) -> NDArray[np.float64]:
    """Return the angles from the optical axis [rad] of theta_d >= 0, to rounding.

    Newton's method within shrinking bounds; infinite if theta_d is beyond the lens's rim.
    """
    aim = np.asarray(theta_d, np.float64)
    if k == UNDISTORTED:
        return np.where(aim > MOST_OFF_RAD + 1e-9, np.inf, aim)
    most = sees_to(k)
    rim = distorted(most, k)
    low, high = np.zeros(aim.shape), np.full(aim.shape, most)
    theta = np.minimum(aim, most)
    for _ in range(_MOST_STEPS):
        beyond = distorted(theta, k) - aim
        low, high = np.where(beyond <= 0.0, theta, low), np.where(beyond >= 0.0, theta, high)
        with np.errstate(divide="ignore", invalid="ignore"):
            newer = theta - beyond / steepness(theta, k)
        newer = np.where((newer >= low) & (newer <= high), newer, 0.5 * (low + high))
        moved = np.abs(newer - theta)
        theta = newer
        if (moved <= 2.0 * np.spacing(theta)).all():
            break
    return np.where(aim > rim * (1.0 + _ROUNDING), np.inf, theta)


def _crossings(polynomial: list[float], end: float) -> list[float]:
    """Return the sign changes of a polynomial, lowest power first, between 0 and an end.

    There is at most one between two sign changes of the derivative.
    """
    if len(polynomial) == 1:
        return []
    slope = [power * factor for power, factor in enumerate(polynomial)][1:]
    found = []
    for first, last in pairwise([0.0, *_crossings(slope, end), end]):
        low, high = first, last
        rises = _value(polynomial, high) > 0.0
        if (_value(polynomial, low) > 0.0) == rises:
            continue
        while low < (middle := 0.5 * (low + high)) < high:
            if (_value(polynomial, middle) > 0.0) == rises:
                high = middle
            else:
                low = middle
        found.append(low)
    return found


def _value(polynomial: list[float], x: float) -> float:
    """Return the value of a polynomial, lowest power first."""
    value = 0.0
    for factor in reversed(polynomial):
        value = value * x + factor
    return value


class ProjectionModel:
    """Projection of directions to the image of a camera `k`; base class of `PROJECTIONS`.

    Points and rays are arrays (3, ...) forward, right and down in the camera's axes. The visible
    point of a pixel is its ray times its depth. Pixel centres are at whole numbers.
    """

    magic = ""
    """Letter of the magic numbers of its frames."""
    distorted_magic = ""
    """Letter of frames with distortion coefficients; "" = it has none."""
    accepted_fov = ""
    """Accepted horizontal field of view, as text."""
    least_rows = 6
    """Minimum rows of an image."""
    planar = False
    """True if depth is along the optical axis and rays are affine along rows."""
    cylindrical = False
    """True if depth is in the horizontal plane and rays are affine along columns."""
    radial = False
    """True if the distance from the optical axis in the image follows `distorted`."""
    calibration: str | None = None
    """Distortion model of an exported camera calibration; None = it has no calibration."""

    @property
    def tabled(self) -> bool:
        """True if each pixel has a separate unit ray, and depth is along it."""
        return not (self.planar or self.cylindrical)

    def accepts(self, fov_deg: float) -> bool:
        """Return whether a horizontal field of view [deg] is within the limit."""
        raise NotImplementedError

    def focal(self, width: int, fov: float, distortion: Distortion) -> float:
        """Return the focal length [px] for a horizontal field of view [rad] of the whole width."""
        return float(width / (2.0 * distorted(0.5 * fov, distortion)))

    def fov(self, k: Intrinsics) -> float:
        """Return the horizontal field of view [rad], from edge to edge of the image."""
        return k.width / k.focal

    def problem(self, width: int, focal: float) -> str | None:  # noqa: ARG002 (of a cylinder)
        """Return why no image has this width and focal length [px], or None."""
        return None

    def rays(self, k: Intrinsics) -> Floats:
        """Return the rays (3, h, w) at a depth of 1; 0 in pixels without a direction."""
        raise NotImplementedError

    def places(self, k: Intrinsics, points: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
        """Return columns and rows of points; infinity beyond the field of view. Only if tabled."""
        raise NotImplementedError

    def flow(self, k: Intrinsics, points: Floats, moves: Floats) -> tuple[Floats, Floats]:
        """Return the image velocity [px/s] of points (3, ...) with velocities `moves` [m/s]."""
        raise NotImplementedError

    def angle_at(self, k: Intrinsics, side: float) -> float:
        """Return the angle from the optical axis [rad] at a distance from it in the image [px]."""
        return math.atan2(side, k.focal)


class Pinhole(ProjectionModel):
    """RealSense convention: a pixel (u, v) has the ray (1, (u - cx) / focal, (v - cy) / focal)."""

    magic, accepted_fov, planar, calibration = "F", "value < 170 deg", True, ""

    def accepts(self, fov_deg: float) -> bool:
        """Return whether a horizontal field of view [deg] is within the limit."""
        return fov_deg < 170.0

    def focal(self, width: int, fov: float, distortion: Distortion) -> float:  # noqa: ARG002
        """Return the focal length [px] for a horizontal field of view [rad] of the whole width."""
        return 0.5 * width / math.tan(0.5 * fov)

    def fov(self, k: Intrinsics) -> float:
        """Return the horizontal field of view [rad], from edge to edge of the image."""
        return 2.0 * math.atan2(0.5 * k.width, k.focal)

    def rays(self, k: Intrinsics) -> Floats:
        """Return the rays (3, h, w) at a depth of 1."""
        rays = np.ones((3, k.height, k.width))
        rays[1], rays[2] = _scaled_grid(k)
        return rays

    def flow(self, k: Intrinsics, points: Floats, moves: Floats) -> tuple[Floats, Floats]:
        """Return the image velocity [px/s] of points (3, ...) with velocities `moves` [m/s]."""
        (z, x, y), (dz, dx, dy), f = points, moves, k.focal
        with np.errstate(invalid="ignore", divide="ignore"):
            return f * (dx - x / z * dz) / z, f * (dy - y / z * dz) / z


class Cylinder(ProjectionModel):
    """Panorama: the ray of (u, v) is (cos a, sin a, (v - cy) / focal) with a = (u - cx) / focal.

    The angle a is clockwise seen from above. Depth is perpendicular to the axis of the cylinder.
    Upright edges are upright in the image. The column of the optical axis equals a pinhole's with
    the same focal length.
    """

    magic, accepted_fov, least_rows, cylindrical = "C", "value <= 360 deg", 1, True

    def accepts(self, fov_deg: float) -> bool:
        """Return whether a horizontal field of view [deg] is within the limit."""
        return fov_deg <= CYLINDER_MOST_DEG

    def problem(self, width: int, focal: float) -> str | None:
        """Return why no image has this width and focal length [px], or None."""
        if width > _TURN * 2.0 * math.pi * focal:
            return f"focal {focal}, {width} px wide: a cylinder of more than one turn"
        return None

    def rays(self, k: Intrinsics) -> Floats:
        """Return the rays (3, h, w) at a depth of 1."""
        rays = np.empty((3, k.height, k.width))
        angle, rays[2] = _scaled_grid(k)
        rays[0], rays[1] = np.cos(angle), np.sin(angle)
        return rays

    def flow(self, k: Intrinsics, points: Floats, moves: Floats) -> tuple[Floats, Floats]:
        """Return the image velocity [px/s] of points (3, ...) with velocities `moves` [m/s]."""
        (z, x, y), (dz, dx, dy), f = points, moves, k.focal
        # Derivatives of focal * atan2(x, z) and focal * y / hypot(x, z).
        with np.errstate(invalid="ignore", divide="ignore"):
            square = x * x + z * z
            away = np.sqrt(square)
            receding = (x * dx + z * dz) / square
            return f * (z * dx - x * dz) / square, f * (dy - y * receding) / away


class Fisheye(ProjectionModel):
    """The ray of a pixel is (cos b, sin b cos c, sin b sin c), at the angle b from the axis.

    The angle is given by r / focal and `undistorted`, with r the distance from (cx, cy) to the
    pixel and c its direction. Without coefficients b = r / focal (equidistant). Pixels more than 95
    degrees from the axis are empty, as are pixels beyond the valid angle of the coefficients.
    """

    magic, distorted_magic, accepted_fov = "E", "K", "value <= 190 deg"
    radial, calibration = True, "kannala_brandt"

    def accepts(self, fov_deg: float) -> bool:
        """Return whether a horizontal field of view [deg] is within the limit."""
        return fov_deg <= math.degrees(2.0 * MOST_OFF_RAD)

    def fov(self, k: Intrinsics) -> float:
        """Return the horizontal field of view [rad], from edge to edge of the image."""
        if k.distortion == UNDISTORTED:
            return k.width / k.focal
        return 2.0 * self.angle_at(k, 0.5 * k.width)

    def rays(self, k: Intrinsics) -> Floats:
        """Return unit rays (3, h, w); 0 outside the circle."""
        across, down = _scaled_grid(k)
        out = np.hypot(across, down)
        off = undistorted(out, k.distortion)
        # `undistorted` returns infinity beyond the valid angle.
        outside = np.isinf(off)
        off[outside] = 0.0
        # sin(off) / out, which is 1 in the middle.
        share = np.sinc(off / math.pi) * np.divide(off, out, out=np.ones_like(out), where=out > 0.0)
        rays = np.stack([np.cos(off), across * share, down * share])
        rays[:, outside] = 0.0
        return rays

    def places(self, k: Intrinsics, points: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
        """Return columns and rows of points (3, ...); infinity outside the circle."""
        aside = np.hypot(points[1], points[2])
        off = np.arctan2(aside, points[0])
        scale = k.focal * distorted(off, k.distortion) / np.maximum(aside, 1e-9)
        scale = np.where(off > sees_to(k.distortion), np.inf, scale)
        with np.errstate(invalid="ignore"):
            return points[1] * scale + k.cx, points[2] * scale + k.cy

    def flow(self, k: Intrinsics, points: Floats, moves: Floats) -> tuple[Floats, Floats]:
        """Return the image velocity [px/s] of points (3, ...) with velocities `moves` [m/s]."""
        (z, x, y), (dz, dx, dy), f = points, moves, k.focal
        # On the optical axis `aside` is 0; `np.where` selects the limit there.
        with np.errstate(invalid="ignore", divide="ignore"):
            aside = np.hypot(x, y)
            off = np.arctan2(aside, z)
            growing = (x * dx + y * dy) / aside
            # Columns and rows are f c x and f c y, with c = theta_d / aside: 1 / z on the axis.
            share = np.where(aside > _ON_AXIS, distorted(off, k.distortion) / aside, 1.0 / z)
            opening = (z * growing - aside * dz) / (aside * aside + z * z)
            opening = steepness(off, k.distortion) * opening
            on_axis = -dz / (z * z)
            changing = np.where(aside > _ON_AXIS, (opening - share * growing) / aside, on_axis)
            return f * (changing * x + share * dx), f * (changing * y + share * dy)

    def angle_at(self, k: Intrinsics, side: float) -> float:
        """Return the angle from the optical axis [rad] at a distance from it in the image [px]."""
        # `undistorted` is infinite if the image is larger than the lens's circle.
        off = undistorted(np.array(max(side, 0.0) / k.focal), k.distortion)
        return min(float(off), sees_to(k.distortion))


def _scaled_grid(k: Intrinsics) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return columns (w,) and rows (h, 1) from the optical axis, in focal lengths."""
    across = (np.arange(k.width) - k.cx) / k.focal
    down = (np.arange(k.height) - k.cy) / k.focal
    return across, down[:, None]


PROJECTIONS: Final[dict[str, ProjectionModel]] = {
    "pinhole": Pinhole(),
    "cylindrical": Cylinder(),
    "fisheye": Fisheye(),
}
"""Projections by the name in profiles, cards and options."""

if TYPE_CHECKING:
    Projection: TypeAlias = str
else:
    Projection = Literal[tuple(PROJECTIONS)]
"""Projection of directions to the image, a name in `PROJECTIONS`."""


def check_lens(
    fov_field: str, projection: Projection, horizontal_fov_deg: float, k: Distortion
) -> None:
    """Raise FieldError for a field of view [deg] beyond a projection's limit, or invalid `k`.

    `k` is the field `distortion` beside the named field of view.
    """
    if not PROJECTIONS[projection].accepts(horizontal_fov_deg):
        limits = [f"{model.accepted_fov} with {name!r}" for name, model in PROJECTIONS.items()]
        accepted = ", ".join(limits).replace(" with ", " with projection ", 1)
        raise errors.FieldError(fov_field, horizontal_fov_deg, accepted)
    if k == UNDISTORTED:
        return
    field, shown = ".".join([*fov_field.split(".")[:-1], "distortion"]), [float(each) for each in k]
    if not PROJECTIONS[projection].distorted_magic:
        raise errors.FieldError(
            field, shown, f"left out with projection {projection!r}, only of a fisheye"
        )
    reached_deg, half_deg = math.degrees(sees_to(k)), 0.5 * horizontal_fov_deg
    if reached_deg < half_deg:
        raise errors.FieldError(
            field,
            shown,
            "coefficients with which theta_d increases over the whole field of view, to"
            f" {half_deg:g} deg from the axis; with these it does to {reached_deg:.4g} deg",
        )
