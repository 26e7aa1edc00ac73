"""Noise of a stereo depth camera on its images."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from airl_mav.camera.frame import MAX_MM, MM_PER_M
from airl_mav.core.streams import Stream, stream
from airl_mav.profiles.conditions import SensorNoise

NOISE_AT_M = 10.0
"""Depth at which the noise is as declared; stereo noise grows with the square of the depth."""


def is_noisy(asked: SensorNoise) -> bool:
    """Return whether images change at all."""
    return bool(asked.depth_noise or asked.depth_dropout)


def noisy_frame(
    depth_mm: NDArray[np.uint16], asked: SensorNoise, seed: int, frame: int
) -> NDArray[np.uint16]:
    """Return a frame of an episode as its noise leaves it.

    Args:
        depth_mm: Z16 image (h, w).
        asked: How noisy.
        seed: Of the episode.
        frame: Its number in the episode, by the camera's rate: frames that nobody takes count, so
            that the same moment has the same noise wherever it is flown.
    """
    return noisy_depth(depth_mm, asked, stream(seed, Stream.DEPTH, frame))


def noisy_depth(
    depth_mm: NDArray[np.uint16], asked: SensorNoise, rng: np.random.Generator
) -> NDArray[np.uint16]:
    """Return Z16 images (..., h, w) with a stereo camera's noise and missing pixels."""
    depth = depth_mm / MM_PER_M
    sd = asked.depth_noise * depth * depth / NOISE_AT_M
    noisy = np.rint(MM_PER_M * (depth + sd * rng.standard_normal(depth.shape)))
    kept = (depth_mm > 0) & (rng.random(depth.shape) >= asked.depth_dropout)
    result: NDArray[np.uint16] = np.where(kept, np.clip(noisy, 1, MAX_MM), 0).astype(np.uint16)
    return result
