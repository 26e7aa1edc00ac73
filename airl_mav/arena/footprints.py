"""What obstacles cover of the floor, from above: bounding boxes along north and east, areas."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from airl_mav.arena.geometry import Bounds, Obstacles, Shape
from airl_mav.core.kernels import kernel

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Boxes:
    """n rectangles, sides along north and east."""

    center: Floats  # (n, 2) north, east [m]
    half: Floats  # (n, 2) half extents [m]

    def __len__(self) -> int:
        """Return n."""
        return len(self.center)

    def grown(self, margin: float | Floats) -> Boxes:
        """Return them with `margin` [m] (a number, or (2,)) added on every side."""
        return Boxes(self.center, self.half + margin)


def join(*parts: Boxes) -> Boxes:
    """Return the boxes of all parts, in order."""
    return Boxes(
        np.concatenate([part.center for part in parts]),
        np.concatenate([part.half for part in parts]),
    )


def bounding_half(shape: NDArray[np.int8], half_size: Floats, yaw: Floats) -> Floats:
    """Return half extents (n, 2) [m] north and east of the footprints of n primitives.

    Arguments are as the fields of `Obstacles`.
    """
    cos, sin = np.abs(np.cos(yaw)), np.abs(np.sin(yaw))
    along, across = half_size[:, 0], half_size[:, 1]
    turned = np.stack([cos * along + sin * across, sin * along + cos * across], axis=1)
    is_box = (shape == Shape.BOX)[:, None]
    return np.where(is_box, turned, half_size[:, :2])


def bounding_boxes(obstacles: Obstacles) -> Boxes:
    """Return the bounding boxes of all obstacles; of moving ones at time 0."""
    half = bounding_half(obstacles.shape, obstacles.half_size, obstacles.yaw)
    return Boxes(obstacles.center[:, :2], half)


def outside_all(points: Floats, boxes: Boxes) -> NDArray[np.bool_]:
    """Return (q,) whether each point (q, 2) [m] is outside, or on the edge, of every box."""
    free = np.empty(len(points), np.bool_)
    _outside_all(points, boxes.center, boxes.half, free)
    return free


@kernel
def _outside_all(points: Floats, center: Floats, half: Floats, free: NDArray[np.bool_]) -> None:
    for i in range(len(points)):
        free[i] = True
        for j in range(len(center)):
            north = abs(points[i, 0] - center[j, 0]) - half[j, 0]
            east = abs(points[i, 1] - center[j, 1]) - half[j, 1]
            if north < 0.0 and east < 0.0:
                free[i] = False
                break


def segments_clear(start: Floats, ends: Floats, boxes: Boxes) -> NDArray[np.bool_]:
    """Return (q,) whether the straight ways from `start` (2,) to `ends` (q, 2) touch no box.

    Slab method: a segment meets a box when its stays between the box's two pairs of lines overlap.
    """
    clear = np.empty(len(ends), np.bool_)
    _segments_clear(start, ends, boxes.center, boxes.half, clear)
    return clear


@kernel
def _segments_clear(
    start: Floats, ends: Floats, center: Floats, half: Floats, clear: NDArray[np.bool_]
) -> None:
    for i in range(len(ends)):
        clear[i] = True
        for j in range(len(center)):
            enter, leave = -math.inf, math.inf
            for axis in range(2):
                step = ends[i, axis] - start[axis]
                if abs(step) < 1e-12:
                    # It never leaves, or never reaches, the slab.
                    step = 1e-12
                low = (center[j, axis] - half[j, axis] - start[axis]) / step
                high = (center[j, axis] + half[j, axis] - start[axis]) / step
                enter, leave = max(enter, min(low, high)), min(leave, max(low, high))
            if enter <= leave and leave >= 0.0 and enter <= 1.0:
                clear[i] = False
                break


def inner(bounds: Bounds, margin: float | Floats) -> tuple[Floats, Floats]:
    """Return the corners (2,), (2,) of the floor shrunk by `margin` [m] (a number, or (2,)).

    The first exceeds the second when nothing is left.
    """
    low = np.array([bounds.north_min, bounds.east_min]) + margin
    high = np.array([bounds.north_max, bounds.east_max]) - margin
    return low, high


def footprint_areas(obstacles: Obstacles) -> Floats:
    """Return the floor area (n,) [m²] that each obstacle covers, seen from above."""
    along, across = obstacles.half_size[:, 0], obstacles.half_size[:, 1]
    factor = np.where(obstacles.shape == Shape.BOX, 4.0, math.pi)
    areas: Floats = factor * along * across
    return areas
