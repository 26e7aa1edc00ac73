"""The equidistant fisheye, r = f theta: equal angles are equal ways in the image.

That of Kannala and Brandt ("A generic camera model and calibration method for conventional, wide-
angle, and fish-eye lenses", 2006) and of OpenCV's `fisheye` with all coefficients 0. Depth is
measured along the ray: along the optical axis it would be 0 at 90 degrees, and negative beyond.
"""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.profiles.projection import FISHEYE_MOST_DEG

MOST_OFF_RAD: Final = math.radians(0.5 * FISHEYE_MOST_DEG)
"""What is farther from the optical axis falls on no pixel [rad]."""


def fisheye_rays(camera: Intrinsics) -> NDArray[np.float64]:
    """Return the unit rays (3, h, w) of a fisheye's pixels: forward, right, down.

    They are 0 where a pixel lies outside of the lens's circle, and sees nothing.
    """
    across = (np.arange(camera.width) - camera.cx) / camera.focal
    down = ((np.arange(camera.height) - camera.cy) / camera.focal)[:, None]
    off = np.hypot(across, down)
    # sin(off) / off, which is 1 in the middle.
    share = np.sinc(off / math.pi)
    rays = np.stack([np.cos(off), across * share, down * share])
    rays[:, off > MOST_OFF_RAD + 1e-9] = 0.0
    return rays


def fisheye_places(camera: Intrinsics, points: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return the columns and rows on which points (3, ...) fall: forward, right, down.

    What is outside of the lens's circle falls on infinity.
    """
    aside = np.hypot(points[1], points[2])
    off = np.arctan2(aside, points[0])
    scale = camera.focal * off / np.maximum(aside, 1e-9)
    scale = np.where(off > MOST_OFF_RAD, np.inf, scale)
    with np.errstate(invalid="ignore"):
        return points[1] * scale + camera.cx, points[2] * scale + camera.cy
