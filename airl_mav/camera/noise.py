"""Measurement errors of depth cameras: stereo matching, lidar ranging, and requested noise.

The image belongs to the left imager. Depth is focal length times baseline over disparity. A
disparity error grows with the square of the depth, disparity steps are coarse at long range, and
the maximum search disparity sets the minimum depth. Points hidden in the right image, or outside of
it, have no return.
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
from airl_mav.core.streams import Stream, stream, words_of
from airl_mav.profiles.camera import Camera, Ranging
from airl_mav.profiles.vehicle import SensorNoise


class Matching(NamedTuple):
    """Constants of a stereo camera; a tuple, because compiled loops require one."""

    disparity_px_m: float
    """Focal length of the imagers times the baseline [px m]; disparity = this / depth."""
    shift_px_m: float
    """Product of baseline and focal length of the depth image, in its columns [px m]."""
    noise_px: float
    """Standard deviation of the disparity [px]."""
    step_px: float
    """Step of the disparity [px]; 0 = continuous."""
    most_px: float
    """Maximum search disparity [px]."""
    range_m: float
    """Maximum depth of a return [m]."""


def matching_of(camera: Camera, share: float = 1.0) -> Matching | None:
    """Return a stereo camera's constants, its disparity noise times `share`; None for others."""
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
    """Return the stereo measurement of a true Z16 image (h, w); 0 = no return."""
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
    """Write the measured depth; `draws` (h, w) are standard normal."""
    height, width = depth_mm.shape
    for row in range(height):
        # Leftmost column of the right image occupied by points farther right in this row. Points at
        # or beyond this column are occluded.
        covered = math.inf
        for column in range(width - 1, -1, -1):
            found[row, column] = 0
            if depth_mm[row, column] == 0:
                continue
            true_m = depth_mm[row, column] / MM_PER_M
            # Column of the point in the right image.
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
                        # 0 means no return, so the minimum is 1 mm.
                        found[row, column] = min(max(in_mm, 1.0), MAX_MM)
            covered = min(covered, there)


NOISE_AT_M = 10.0
"""Depth of the declared noise; stereo noise grows with the square of the depth."""


class DepthNoise(NamedTuple):
    """Noise stages of a depth image, in this order."""

    matching: Matching | None
    """Stereo camera's constants; None for other cameras."""
    asked: SensorNoise
    ranging: Ranging | None = None
    """Lidar's constants; None for other cameras."""
    range_m: float = 0.0
    """Maximum depth of a lidar's return [m]."""
    own: tuple[int, ...] = ()
    """`streams.words_of` the camera's name."""


def noise_of(camera: Camera, asked: SensorNoise, name: str = "") -> DepthNoise | None:
    """Return the noise of a depth camera or None; `name` seeds an additional camera's."""
    if camera.kind != "depth":
        return None
    matching = matching_of(camera, asked.stereo_noise)
    ranging = camera.ranging
    changed = matching is not None or ranging is not None
    if not (changed or asked.depth_noise or asked.depth_dropout):
        return None
    return DepthNoise(matching, asked, ranging, camera.range_m, words_of(name))


def noisy_frame(
    depth_mm: NDArray[np.uint16], noise: DepthNoise, seed: int, frame: int
) -> NDArray[np.uint16]:
    """Return a Z16 image (h, w) of an episode with noise.

    `frame` is its number by the camera's rate, skipped frames included. Images at the same time
    therefore have the same noise at every level.
    """
    if noise.matching is not None:
        rng = stream(seed, Stream.STEREO, frame, *noise.own)
        depth_mm = matched_depth(depth_mm, noise.matching, rng)
    if noise.ranging is not None:
        rng = stream(seed, Stream.RANGING, frame, *noise.own)
        depth_mm = ranged_depth(depth_mm, noise.ranging, noise.range_m, rng)
    if noise.asked.depth_noise or noise.asked.depth_dropout:
        rng = stream(seed, Stream.DEPTH, frame, *noise.own)
        depth_mm = noisy_depth(depth_mm, noise.asked, rng)
    return depth_mm


def ranged_depth(
    depth_mm: NDArray[np.uint16], ranging: Ranging, range_m: float, rng: np.random.Generator
) -> NDArray[np.uint16]:
    """Return a lidar's image (h, w) of true Z16 depth up to `range_m` [m]; 0 = no return."""
    depth = depth_mm / MM_PER_M
    sd = np.hypot(ranging.noise_m, ranging.noise_share * depth)
    measured = depth + sd * rng.standard_normal(depth.shape)
    kept = (depth_mm > 0) & (rng.random(depth.shape) >= ranging.lost_share)
    kept &= (measured >= ranging.least_m) & (measured <= range_m)
    # 0 means no return, so the minimum is 1 mm.
    in_mm = np.clip(np.rint(MM_PER_M * measured), 1, MAX_MM)
    result: NDArray[np.uint16] = np.where(kept, in_mm, 0).astype(np.uint16)
    return result


def noisy_depth(
    depth_mm: NDArray[np.uint16], asked: SensorNoise, rng: np.random.Generator
) -> NDArray[np.uint16]:
    """Return Z16 images (..., h, w) with a stereo camera's noise and missing pixels."""
    depth = depth_mm / MM_PER_M
    # At NOISE_AT_M the standard deviation is `depth_noise` times the depth.
    sd = asked.depth_noise * depth * depth / NOISE_AT_M
    noisy = np.rint(MM_PER_M * (depth + sd * rng.standard_normal(depth.shape)))
    kept = (depth_mm > 0) & (rng.random(depth.shape) >= asked.depth_dropout)
    result: NDArray[np.uint16] = np.where(kept, np.clip(noisy, 1, MAX_MM), 0).astype(np.uint16)
    return result
