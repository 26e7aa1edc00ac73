"""A stereo depth camera's own errors: what matching two images does to depth.

The image is that of the left imager. Depth is focal length times baseline over disparity: an error
of the disparity grows with the square of the depth, its steps are coarse far away, and the greatest
disparity that is searched sets the least depth. What the right imager does not see has no match and
no return: something nearer hides it, or it lies outside of its image.
(Grunnet-Jepsen, Sweetser, Woodfill, "Tuning depth cameras for best performance", Intel RealSense;
Luxonis, "Configuring Stereo Depth".)
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from airl_mav.camera.frame import MAX_MM, MM_PER_M
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.core.kernels import kernel
from airl_mav.profiles.camera import Camera


class Matching(NamedTuple):
    """A stereo camera's constants; a tuple, so that compiled loops take it."""

    disparity_px_m: float
    """Focal length of the imagers times the baseline: over a depth it is the disparity [px m]."""
    shift_px_m: float
    """The same in columns of the depth image [px m]."""
    noise_px: float
    """Standard deviation of the disparity [px]."""
    step_px: float
    """Step of the disparity [px]; 0: none."""
    most_px: float
    """Greatest disparity that is searched [px]."""
    range_m: float
    """Greatest depth that gives a return [m]."""


def matching_of(camera: Camera, share: float = 1.0) -> Matching | None:
    """Return the constants of a profile's camera; None: it is no stereo camera, or an ideal one.

    Args:
        camera: The camera.
        share: The disparity's noise times this; 0 makes an ideal camera of it.
    """
    stereo = camera.stereo
    if stereo is None or share == 0.0:
        return None
    return Matching(
        stereo.focal_px * stereo.baseline_m,
        Intrinsics.of(camera).focal * stereo.baseline_m,
        share * stereo.noise_px,
        stereo.step_px,
        stereo.most_px,
        camera.range_m,
    )


def matched_depth(
    depth_mm: NDArray[np.uint16], matching: Matching, rng: np.random.Generator
) -> NDArray[np.uint16]:
    """Return a true Z16 image (h, w) as a stereo camera measures it; 0 = no return."""
    draws = rng.standard_normal(depth_mm.shape)
    found = np.empty_like(depth_mm)
    _match(depth_mm, matching, draws, found)
    return found


@kernel
def _match(
    depth_mm: NDArray[np.uint16],
    matching: Matching,
    draws: NDArray[np.float64],
    found: NDArray[np.uint16],
) -> None:
    """Write what is measured; `draws` (h, w) are standard normal."""
    height, width = depth_mm.shape
    for row in range(height):
        # The leftmost column of the right image that anything farther right in this row covers:
        # what falls onto it or beyond it is hidden there.
        covered = math.inf
        for column in range(width - 1, -1, -1):
            found[row, column] = 0
            if depth_mm[row, column] == 0:
                continue
            true_m = depth_mm[row, column] / MM_PER_M
            there = column - matching.shift_px_m / true_m
            if -0.5 <= there < covered:
                disparity = matching.disparity_px_m / true_m
                disparity += matching.noise_px * draws[row, column]
                if matching.step_px > 0.0:
                    disparity = matching.step_px * np.rint(disparity / matching.step_px)
                if 0.0 < disparity <= matching.most_px:
                    measured_m = matching.disparity_px_m / disparity
                    if measured_m <= matching.range_m:
                        in_mm = np.rint(MM_PER_M * measured_m)
                        found[row, column] = min(max(in_mm, 1.0), MAX_MM)
            covered = min(covered, there)
