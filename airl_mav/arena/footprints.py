"""Footprints of obstacles on the floor: bounding boxes along north and east, areas."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from airl_mav.arena.geometry import Bounds, Obstacles, Shape
from airl_mav.core.kernels import kernel

Floats = NDArray[np.float64]

_BOX = int(Shape.BOX)


@dataclass(frozen=True)
class Boxes:
    """n rectangles, sides along north and east."""

    center: Floats  # (n, 2) north, east [m]
    half: Floats  # (n, 2) half extents [m]

    def __len__(self) -> int:
        """Return n."""
        return len(self.center)

    def grown(self, margin: float | Floats) -> Boxes:
        """Return the boxes with `margin` [m] (a number, or (2,)) added on every side."""
        return Boxes(self.center, self.half + margin)


def join(*parts: Boxes) -> Boxes:
    """Return the boxes of all parts, in order."""
    return Boxes(
        np.concatenate([part.center for part in parts]),
        np.concatenate([part.half for part in parts]),
    )


def with_room(boxes: Boxes, halves: Floats) -> Boxes:
    """Return the boxes, followed by unplaced boxes of half extents (n, 2) [m]."""
    center = np.empty((len(boxes) + len(halves), 2))
    center[: len(boxes)] = boxes.center
    return Boxes(center, np.concatenate([boxes.half, halves]))


def bounding_half(shape: NDArray[np.int8], half_size: Floats, yaw: Floats) -> Floats:
    """Return half extents (n, 2) [m] north and east of primitives; arguments as in `Obstacles`."""
    half = np.empty((len(shape), 2))
    _bounding_half(shape, half_size, np.cos(yaw), np.sin(yaw), half)
    return half


@kernel
def _bounding_half(
    shape: NDArray[np.int8], half_size: Floats, cos: Floats, sin: Floats, half: Floats
) -> None:
    for i in range(len(shape)):
        along, across = half_size[i, 0], half_size[i, 1]
        half[i, 0], half[i, 1] = along, across
        if shape[i] == _BOX:
            c, s = abs(cos[i]), abs(sin[i])
            half[i, 0], half[i, 1] = c * along + s * across, s * along + c * across


def bounding_boxes(obstacles: Obstacles) -> Boxes:
    """Return the bounding boxes of all obstacles, of moving obstacles at time 0."""
    half = bounding_half(obstacles.shape, obstacles.half_size, obstacles.yaw)
    return Boxes(obstacles.center[:, :2], half)


@kernel
def outside(point: Floats, center: Floats, half: Floats) -> bool:
    """Return whether a point (2,) [m] is outside, or on the edge, of every box."""
    for j in range(len(center)):
        north = abs(point[0] - center[j, 0]) - half[j, 0]
        east = abs(point[1] - center[j, 1]) - half[j, 1]
        if north < 0.0 and east < 0.0:
            return False
    return True


def segments_clear(start: Floats, ends: Floats, boxes: Boxes) -> NDArray[np.bool_]:
    """Return (q,) True where the segment from `start` (2,) to `ends` (q, 2) touches no box."""
    clear = np.empty(len(ends), np.bool_)
    _segments_clear(start, ends, boxes.center, boxes.half, clear)
    return clear


@kernel
def _segments_clear(
    start: Floats, ends: Floats, center: Floats, half: Floats, clear: NDArray[np.bool_]
) -> None:
    for i in range(len(ends)):
        clear[i] = segment_clear(start, ends[i], center, half)


@kernel
def segment_clear(start: Floats, end: Floats, center: Floats, half: Floats) -> bool:
    """Return whether the segment from `start` (2,) to `end` (2,) touches no box (slab method)."""
    for j in range(len(center)):
        enter, leave = -math.inf, math.inf
        for axis in range(2):
            step = end[axis] - start[axis]
            if abs(step) < 1e-12:
                # A segment along the slab is either always inside or always outside.
                step = 1e-12
            low = (center[j, axis] - half[j, axis] - start[axis]) / step
            high = (center[j, axis] + half[j, axis] - start[axis]) / step
            enter, leave = max(enter, min(low, high)), min(leave, max(low, high))
        if enter <= leave and leave >= 0.0 and enter <= 1.0:
            return False
    return True


@kernel
def draw_numbers(rng: np.random.Generator, numbers: Floats) -> None:
    """Draw numbers (n, 2), uniform in [0, 1), equal to `rng.random((n, 2))`."""
    for i in range(len(numbers)):
        for axis in range(2):
            numbers[i, axis] = rng.random()


def inner(bounds: Bounds, margin: float | Floats) -> tuple[Floats, Floats]:
    """Return the corners of the floor shrunk by `margin` [m]; reversed if the area is empty."""
    low = np.array([bounds.north_min, bounds.east_min]) + margin
    high = np.array([bounds.north_max, bounds.east_max]) - margin
    return low, high


def footprint_areas(obstacles: Obstacles) -> Floats:
    """Return the floor area (n,) [m²] that each obstacle covers, seen from above."""
    along, across = obstacles.half_size[:, 0], obstacles.half_size[:, 1]
    factor = np.where(obstacles.shape == Shape.BOX, 4.0, math.pi)
    areas: Floats = factor * along * across
    return areas
