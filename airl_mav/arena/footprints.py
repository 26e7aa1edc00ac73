"""What obstacles cover of the floor, from above: bounding boxes along north and east, areas."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from airl_mav.arena.geometry import Bounds, Obstacles, Shape

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
    gap: Floats = np.abs(points[:, None, :] - boxes.center) - boxes.half
    free: NDArray[np.bool_] = np.all(np.any(gap >= 0.0, axis=2), axis=1)
    return free


def segments_clear(start: Floats, ends: Floats, boxes: Boxes) -> NDArray[np.bool_]:
    """Return (q,) whether the straight ways from `start` (2,) to `ends` (q, 2) touch no box.

    Slab method: a segment meets a box when its stays between the box's two pairs of lines overlap.
    """
    # A step of zero along an axis becomes a tiny one: it never leaves, or never reaches, the slab.
    step = ends - start
    step = np.where(np.abs(step) < 1e-12, 1e-12, step)[:, None, :]
    low = (boxes.center - boxes.half - start) / step
    high = (boxes.center + boxes.half - start) / step
    enter = np.minimum(low, high).max(axis=2)
    leave = np.maximum(low, high).min(axis=2)
    hit = (enter <= leave) & (leave >= 0.0) & (enter <= 1.0)
    clear: NDArray[np.bool_] = ~np.any(hit, axis=1)
    return clear


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
