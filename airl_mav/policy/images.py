"""Network images from camera images: smaller, and depth as bytes.

This is the numpy version of the companion; `envs.encoding` has the same as compiled loops.
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
    """Conversion of depths to the network's bytes."""

    table: NDArray[np.uint8]
    """(65536,) byte of each value of `nearest_returns`."""
    far_mm: float = 0.0
    """Scale of a linear conversion; 0 = use the table. A byte is 255 (value + 1) / far_mm in single
    precision, rounded to nearest and at most 255. Compilers vectorize this, unlike a table."""


class Shrink(NamedTuple):
    """Conversions from camera images to network images."""

    depth: Callable[[NDArray[np.uint16], int, int, Bytes], NDArray[np.uint8]]
    """Conversion of Z16 images (n, h, w), with rows, columns and `Bytes`, to byte images
    (n, rows, columns)."""
    colour: Callable[[NDArray[np.uint8], int, int], NDArray[np.uint8]]
    """Conversion of sRGB or grey images (n, h, w, channels), with rows and columns, to block means
    (n, channels, rows, columns)."""
    scanning: Scanning
    """Conversion of depth images to level scans."""


def shrink_depth(
    depth_mm: NDArray[np.uint16], rows: int, columns: int, bytes_of: Bytes
) -> NDArray[np.uint8]:
    """Return network images of depth images with numpy; see `Shrink.depth`."""
    return bytes_of.table[nearest_returns(depth_mm, rows, columns)]


def shrink_colour(image: NDArray[np.uint8], rows: int, columns: int) -> NDArray[np.uint8]:
    """Return network images of colour images with numpy; see `Shrink.colour`.

    A pixel is the mean of its block's sRGB numbers, halves rounded up: area resampling as in OpenCV
    (INTER_AREA) and Pillow (BOX).
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
"""Numpy versions, for the companion without numba."""


def nearest_returns(depth_mm: NDArray[np.uint16], rows: int, columns: int) -> NDArray[np.uint16]:
    """Shrink Z16 images (n, h, w) to (n, rows, columns). The nearest return of each block wins.

    Values are one less than in the images, so that "no return" (0) wraps around to the maximum.
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
    """Return bytes proportional to depth: 0 is at the lens, 255 at the range and beyond."""
    share = np.minimum(_depths_m(range_m) / range_m, 1.0)
    table = np.rint(255.0 * share).astype(np.uint8)
    far_mm = range_m * MM_PER_M
    values = np.arange(1, MAX_MM + 2).astype(np.float32)
    ratios = np.float32(255.0) * values / np.float32(far_mm)
    in_single = np.rint(np.minimum(ratios, np.float32(255.0))).astype(np.uint8)
    return Bytes(table, far_mm if np.array_equal(in_single, table) else 0.0)


@cache
def paper_bytes(range_m: float) -> Bytes:
    """Return Air Learning's mapping (airlearning-rl, getScreenDepthVis).

    255 / max(1 m, depth) truncated to a byte, inverted, to the tenth power of the byte's range.
    """
    byte = (255.0 / np.maximum(1.0, _depths_m(range_m))).astype(np.uint8)
    return Bytes((255.0 * ((255.0 - byte) / 255.0) ** 10).astype(np.uint8))
