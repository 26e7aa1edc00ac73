"""Kinds of cameras: the content of their pixels, their projection, and a fisheye's distortion.

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
from typing import Any, Final, Literal, TypeVar, get_args

import numpy as np
from numpy.typing import NDArray

from airl_mav.core.errors import FieldError

CameraKind = Literal["depth", "rgb", "grey"]
"""`depth`: uint16 (h, w), Z16 in millimetres. `rgb`: uint8 (h, w, 3), sRGB. `grey`: uint8
(h, w, 1), luma of the sRGB numbers."""

Renderer = Literal["raycast", "mitsuba"]
"""Renderer of images: the ray caster, or Mitsuba's path tracer as the reference for colour."""

SLOW: Final[frozenset[Renderer]] = frozenset({"mitsuba"})
"""Renderers that need longer than a tick for an image."""

KINDS: Final[tuple[CameraKind, ...]] = get_args(CameraKind)

CHANNELS: Final[dict[CameraKind, int]] = {"depth": 1, "rgb": 3, "grey": 1}
"""Channels of a network's image."""


def shape_of(kind: CameraKind, height: int, width: int) -> tuple[int, ...]:
    """Return the shape of a camera's image: (h, w) for depth, (h, w, channels) for colour."""
    return (height, width) if kind == "depth" else (height, width, CHANNELS[kind])


Projection = Literal["pinhole", "cylindrical", "fisheye"]
"""Projection of directions to the image; `camera.intrinsics.Intrinsics` has the formulas."""

PROJECTIONS: tuple[Projection, ...] = get_args(Projection)

PINHOLE_BELOW_DEG, CYLINDER_MOST_DEG, FISHEYE_MOST_DEG = 170.0, 360.0, 190.0
"""Limit of a pinhole's horizontal field of view, exclusive, and of the others, inclusive [deg].

A fisheye sees up to half its field of view from the optical axis, in any direction."""


def check_fov(field: str, projection: Projection, horizontal_fov_deg: float) -> None:
    """Raise FieldError, naming the field, for a field of view [deg] beyond a projection's limit."""
    beyond = {
        "pinhole": horizontal_fov_deg >= PINHOLE_BELOW_DEG,
        "cylindrical": horizontal_fov_deg > CYLINDER_MOST_DEG,
        "fisheye": horizontal_fov_deg > FISHEYE_MOST_DEG,
    }
    if beyond[projection]:
        raise FieldError(
            field,
            horizontal_fov_deg,
            f"value < {PINHOLE_BELOW_DEG:g} deg with projection 'pinhole', value <="
            f" {CYLINDER_MOST_DEG:g} deg with 'cylindrical', value <= {FISHEYE_MOST_DEG:g} deg with"
            " 'fisheye'",
        )


Distortion = tuple[float, float, float, float]
"""k1, k2, k3, k4."""

UNDISTORTED: Final[Distortion] = (0.0, 0.0, 0.0, 0.0)
"""Coefficients of an equidistant lens."""

MOST_OFF_RAD: Final = math.radians(0.5 * FISHEYE_MOST_DEG)
"""Maximum angle from the optical axis for any lens [rad]."""

_MOST_STEPS: Final = 100
"""Iteration limit, enough for bisection alone to converge."""

_ROUNDING: Final = 1e-12
"""Rounding tolerance of the rim of a lens, as a share of theta_d."""

MOST_COEFFICIENT: Final = 100.0
"""Maximum magnitude of a coefficient; real lenses are below 10."""

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


def check_distortion(
    field: str, projection: Projection, horizontal_fov_deg: float, k: Distortion
) -> None:
    """Raise FieldError, naming the field, for invalid coefficients."""
    if k == UNDISTORTED:
        return
    shown = [float(each) for each in k]
    if projection != "fisheye":
        raise FieldError(
            field, shown, f"left out with projection {projection!r}, only of a fisheye"
        )
    reached_deg, half_deg = math.degrees(sees_to(k)), 0.5 * horizontal_fov_deg
    if reached_deg < half_deg:
        raise FieldError(
            field,
            shown,
            "coefficients with which theta_d increases over the whole field of view, to"
            f" {half_deg:g} deg from the axis; with these it does to {reached_deg:.4g} deg",
        )


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
