"""The image that a network sees, made of the camera's: smaller, and of depth as bytes.

With numpy, as the companion does it; `envs.encoding` has the same as compiled loops.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from airl_mav.camera.frame import MAX_MM, MM_PER_M
from airl_mav.policy.scans import NUMPY_SCANNING, Scanning


class Bytes(NamedTuple):
    """How depths become the network's bytes."""

    table: NDArray[np.uint8]
    """(65536,) a byte for each value of `nearest_returns`."""
    far_mm: float = 0.0
    """Not 0: each of them is 255 (value + 1) / far_mm in single precision, rounded to the nearest
    and 255 at most, which a compiler turns into vector instructions as it cannot a table."""


class Shrink(NamedTuple):
    """What makes the network's images of the camera's."""

    depth: Callable[[NDArray[np.uint16], int, int, Bytes], NDArray[np.uint8]]
    """From Z16 images (n, h, w), rows, columns and the bytes of depths to the images
    (n, rows, columns) of those bytes."""
    colour: Callable[[NDArray[np.uint8], int, int], NDArray[np.uint8]]
    """From sRGB or grey images (n, h, w, channels), rows and columns to (n, channels, rows,
    columns): means of blocks."""
    scanning: Scanning
    """From depth images to level scans."""


def shrink_depth(
    depth_mm: NDArray[np.uint16], rows: int, columns: int, bytes_of: Bytes
) -> NDArray[np.uint8]:
    """Return what numpy makes of depth images; see `Shrink.depth`."""
    return bytes_of.table[nearest_returns(depth_mm, rows, columns)]


def shrink_colour(image: NDArray[np.uint8], rows: int, columns: int) -> NDArray[np.uint8]:
    """Return what numpy makes of colour images; see `Shrink.colour`.

    A pixel is the mean of its block's sRGB numbers, halves rounded up: resampling by area as OpenCV
    (INTER_AREA) and Pillow (BOX) do it.
    """
    n, height, width, channels = image.shape
    tall, wide = height // rows, width // columns
    planes = image.transpose(0, 3, 1, 2)
    if tall == wide == 1:
        return np.ascontiguousarray(planes)
    blocks = planes.reshape(n, channels, rows, tall, columns, wide).astype(np.uint32)
    count = tall * wide
    mean: NDArray[np.uint8] = ((blocks.sum(axis=(3, 5)) + count // 2) // count).astype(np.uint8)
    return mean


NUMPY = Shrink(shrink_depth, shrink_colour, NUMPY_SCANNING)
"""As the companion does it, which has no numba."""


def nearest_returns(depth_mm: NDArray[np.uint16], rows: int, columns: int) -> NDArray[np.uint16]:
    """Shrink Z16 images (n, h, w) to (n, rows, columns). The nearest return of each block wins.

    Values are one less than in the images, so that "no return" (0) wraps round to the farthest.
    """
    image = depth_mm - np.uint16(1)
    vertical, horizontal = depth_mm.shape[1] // rows, depth_mm.shape[2] // columns
    nearest = image[:, ::vertical]
    for k in range(1, vertical):
        nearest = np.minimum(nearest, image[:, k::vertical])
    image, nearest = nearest, nearest[:, :, ::horizontal]
    for k in range(1, horizontal):
        nearest = np.minimum(nearest, image[:, :, k::horizontal])
    return nearest


def _depths_m(range_m: float) -> NDArray[np.float64]:
    """Return the depth [m] of every value of `nearest_returns`; infinite beyond the range."""
    depth = (np.arange(MAX_MM + 1) + 1) / MM_PER_M
    depth[(depth > range_m) | (np.arange(MAX_MM + 1) == MAX_MM)] = np.inf
    return depth


@cache
def body_bytes(range_m: float) -> Bytes:
    """Depth in proportion to the range: 0 is at the lens, 255 the range and beyond."""
    share = np.minimum(_depths_m(range_m) / range_m, 1.0)
    table = np.rint(255.0 * share).astype(np.uint8)
    far_mm = range_m * MM_PER_M
    values = np.arange(1, MAX_MM + 2).astype(np.float32)
    ratios = np.float32(255.0) * values / np.float32(far_mm)
    in_single = np.rint(np.minimum(ratios, np.float32(255.0))).astype(np.uint8)
    return Bytes(table, far_mm if np.array_equal(in_single, table) else 0.0)


@cache
def paper_bytes(range_m: float) -> Bytes:
    """Air Learning's mapping (airlearning-rl, getScreenDepthVis).

    255 / max(1 m, depth) cut to a byte, inverted, to the tenth power of the byte's range.
    """
    byte = (255.0 / np.maximum(1.0, _depths_m(range_m))).astype(np.uint8)
    return Bytes((255.0 * ((255.0 - byte) / 255.0) ** 10).astype(np.uint8))
