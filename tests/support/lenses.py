"""Fisheyes with coefficients, and where they look by bisection."""

from __future__ import annotations

import math
from functools import cache
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.profiles.projections import Distortion

AT_NIGHT_THE_FISHEYE: list[Any] = [
    "pinhole",
    "cylindrical",
    pytest.param("fisheye", marks=pytest.mark.nightly),
]
"""Projections; the fisheye's separate renderer compiles for half a minute."""

BARREL: Distortion = (-0.05, 0.008, -0.0045, 0.0004)
"""Lens of more than 180 degrees, denser towards its edge; valid to 95 degrees off axis."""

OPENING: Distortion = (0.2, -0.06, 0.01, 0.001)
"""Lens with higher magnification at the edge than in the middle."""

ENDING: Distortion = (0.34, -0.3, 0.05, -0.01)
"""Lens with a limited field of view: theta_d has its maximum at 66 degrees."""


def published(theta: Any, k: Distortion) -> Any:
    """Return theta_d as Kannala and Brandt, and OpenCV's documentation, write it."""
    k1, k2, k3, k4 = k
    return theta * (1 + k1 * theta**2 + k2 * theta**4 + k3 * theta**6 + k4 * theta**8)


@cache
def rising(k: Distortion) -> NDArray[np.float64]:
    """Return angles [rad], close to each other, as long as theta_d increases; to 95 degrees."""
    theta = np.linspace(0.0, math.radians(95.0), 200_001)
    falls = np.flatnonzero(np.diff(published(theta, k)) <= 0.0)
    return theta[: falls[0] + 1] if len(falls) else theta


def last_angle(k: Distortion) -> float:
    """Return to which angle [rad] theta_d increases, by looking at it closely; at most 95 deg."""
    return float(rising(k)[-1])


def angles(theta_d: NDArray[np.float64], k: Distortion) -> NDArray[np.float64]:
    """Return the angles off the axis [rad] that fall at theta_d, by bisection; NaN: none."""
    # A place and its mirror images are at one angle.
    places, which = np.unique(theta_d, return_inverse=True)
    theta = rising(k)
    after = published(theta, k).searchsorted(places).clip(1, len(theta) - 1)
    low, high = theta[after - 1], theta[after]
    for _ in range(40):  # to the last digit of a float64
        middle = 0.5 * (low + high)
        beyond = published(middle, k) > places
        low, high = np.where(beyond, low, middle), np.where(beyond, middle, high)
    solved = np.where(places > published(theta[-1], k), math.nan, 0.5 * (low + high))
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
