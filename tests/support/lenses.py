"""Fisheyes with coefficients, and where they look by a solver of scipy's."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.profiles.distortion import Distortion

BARREL: Distortion = (-0.05, 0.008, -0.0045, 0.0004)
"""Of a lens of more than 180 degrees, denser towards its edge; to 95 degrees from its axis."""

OPENING: Distortion = (0.2, -0.06, 0.01, 0.001)
"""Of one that is wider there than in its middle."""

ENDING: Distortion = (0.34, -0.3, 0.05, -0.01)
"""Of one that ends before: theta_d has its greatest value at 66 degrees."""


def published(theta: Any, k: Distortion) -> Any:
    """Return theta_d as Kannala and Brandt, and OpenCV's documentation, write it."""
    k1, k2, k3, k4 = k
    return theta * (1 + k1 * theta**2 + k2 * theta**4 + k3 * theta**6 + k4 * theta**8)


def last_angle(k: Distortion) -> float:
    """Return to which angle [rad] theta_d increases, by looking at it closely; at most 95 deg."""
    theta = np.linspace(0.0, math.radians(95.0), 200_001)
    falls = np.flatnonzero(np.diff(published(theta, k)) <= 0.0)
    return float(theta[falls[0]]) if len(falls) else math.radians(95.0)


def angles(theta_d: NDArray[np.float64], k: Distortion) -> NDArray[np.float64]:
    """Return the angles off the axis [rad] that fall at theta_d, by Brent's method; NaN: none."""
    last = last_angle(k)
    rim = published(last, k)

    def one(wanted: float) -> float:
        if wanted > rim:
            return math.nan
        found: float = brentq(lambda at: published(at, k) - wanted, 0.0, last, xtol=1e-15)
        return found

    # A place and its mirror images are at one angle.
    places, which = np.unique(theta_d, return_inverse=True)
    solved = np.array([one(float(each)) for each in places])
    return solved[which].reshape(theta_d.shape)


def rays_of_fisheye(k: Intrinsics) -> NDArray[np.float64]:
    """Return the unit rays (h, w, 3) forward, right, down of a fisheye; NaN: it sees nothing."""
    v, u = np.mgrid[: k.height, : k.width]
    x, y = (u - k.cx) / k.focal, (v - k.cy) / k.focal
    off, plane = angles(np.hypot(x, y), k.distortion), np.arctan2(y, x)
    rays: NDArray[np.float64] = np.stack(
        [np.cos(off), np.sin(off) * np.cos(plane), np.sin(off) * np.sin(plane)], axis=-1
    )
    return rays
