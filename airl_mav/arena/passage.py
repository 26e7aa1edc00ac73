"""Conservative search for a passage from start to goal around static footprints and hills."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from airl_mav.arena.geometry import Bounds, Obstacles, Shape
from airl_mav.arena.ground import STEEPEST, Ground
from airl_mav.arena.placement import Boxes, Floats, bounding_boxes, inner, outside
from airl_mav.core.kernels import kernel

CELL_M = 0.25
"""Raster pitch [m]; coarser on a floor of more than CELLS_MAX cells."""

CELLS_MAX = 250_000


class Hills(NamedTuple):
    """Ground that obstructs where it rises above a height."""

    ground: Ground
    most_m: float
    """Maximum height of ground that can be overflown [m]."""


def passage_exists(
    bounds: Bounds,
    obstacles: Obstacles,
    goal: Floats,
    width_m: float,
    boxes: Boxes | None = None,
    hills: Hills | None = None,
) -> bool:
    """Return whether a disc `width_m` [m] wide can be moved from the origin to `goal` (2,) [m].

    `boxes` bound all obstacles, with one box per group; None = one per obstacle. The passage leads
    around hills.
    """
    # All hills can be overflown.
    if hills is not None and hills.ground.top_m <= hills.most_m:
        hills = None
    # The exact test of gaps is cheap and usually succeeds.
    if hills is None and gaps_suffice(bounds, obstacles, goal, width_m, boxes):
        return True
    return raster_passage(bounds, obstacles, goal, width_m, hills)


def gaps_suffice(
    bounds: Bounds, obstacles: Obstacles, goal: Floats, width_m: float, boxes: Boxes | None = None
) -> bool:
    """Return whether all gaps are wider than the vehicle, so that every free place is reachable.

    A rectangle's interior minus finitely many disjoint closed boxes is connected. The vehicle's
    centre moves in such a space when no two boxes grown by half its width touch.
    """
    boxes = bounding_boxes(obstacles) if boxes is None else boxes
    low, high = inner(bounds, 0.0)
    return bool(_gaps_suffice(boxes.center, boxes.half, low, high, goal, width_m))


@kernel
def _gaps_suffice(
    center: Floats, half: Floats, low: Floats, high: Floats, goal: Floats, width_m: float
) -> bool:
    grown = half + width_m / 2.0
    for end in (np.zeros(2), goal):
        for axis in range(2):
            if min(end[axis] - low[axis], high[axis] - end[axis]) <= width_m / 2.0:
                return False
        if not outside(end, center, grown):
            return False
    for i in range(len(center)):
        for axis in range(2):
            south, north = center[i, axis] - half[i, axis], center[i, axis] + half[i, axis]
            if min(south - low[axis], high[axis] - north) <= width_m:
                return False
        for j in range(i):
            close = True
            # Two boxes leave a gap if they are apart along one axis.
            for axis in range(2):
                apart = abs(center[i, axis] - center[j, axis])
                close &= apart - half[i, axis] - half[j, axis] <= width_m
            if close:
                return False
    return True


def least_gap_m(bounds: Bounds, width_m: float) -> float:
    """Return the minimum gap along north or east that `raster_passage` finds [m]."""
    return width_m + (1.0 + math.sqrt(2.0)) * _cell_m(bounds)


def _cell_m(bounds: Bounds) -> float:
    area = (bounds.north_max - bounds.north_min) * (bounds.east_max - bounds.east_min)
    return max(CELL_M, math.sqrt(area / CELLS_MAX))


def raster_passage(
    bounds: Bounds,
    obstacles: Obstacles,
    goal: Floats,
    width_m: float,
    hills: Hills | None = None,
) -> bool:
    """Return whether free cells join the start's cell to the goal's, stepping along the axes.

    A free cell's centre keeps half the width plus half a cell diagonal from all obstacles, so that
    steps between free cells are safe.
    """
    cell = _cell_m(bounds)
    margin = width_m / 2.0 + cell / math.sqrt(2.0)
    # The origin is a cell's centre.
    south, west = math.floor(bounds.north_min / cell), math.floor(bounds.east_min / cell)
    north = cell * np.arange(south, math.ceil(bounds.north_max / cell) + 1, dtype=np.float64)
    east = cell * np.arange(west, math.ceil(bounds.east_max / cell) + 1, dtype=np.float64)
    free_north = (north - bounds.north_min > margin) & (bounds.north_max - north > margin)
    free_east = (east - bounds.east_min > margin) & (bounds.east_max - east > margin)
    free = free_north[:, None] & free_east
    if hills is not None:
        free &= _to_hills(hills, north, east, cell) > margin
    boxes = bounding_boxes(obstacles)
    for i in range(len(obstacles)):
        reach = boxes.half[i] + margin
        rows = _window(north, boxes.center[i, 0], reach[0])
        columns = _window(east, boxes.center[i, 1], reach[1])
        free[rows, columns] &= _distance(obstacles, i, north[rows], east[columns]) > margin
    # Connected regions of free cells, with steps along the axes.
    label, _ = scipy.ndimage.label(free)
    start = label[-south, -west]
    end = label[round(float(goal[0]) / cell) - south, round(float(goal[1]) / cell) - west]
    return bool(start != 0 and start == end)


def _to_hills(hills: Hills, north: Floats, east: Floats, cell: float) -> Floats:
    """Return the distance (rows, columns) [m] of cells from obstructing ground, a lower bound.

    The ground in a cell exceeds its centre by at most the maximum slope times half the diagonal.
    """
    half_diagonal = cell / math.sqrt(2.0)
    low = hills.most_m - half_diagonal * float(hills.ground.relief.grid[STEEPEST])
    high = hills.ground.sampled(north, east) > low
    if not high.any():
        return np.full(high.shape, math.inf)
    # Between cell centres, so half a diagonal must be subtracted.
    away: Floats = scipy.ndimage.distance_transform_edt(~high, sampling=cell)
    return away - half_diagonal


def free_share(bounds: Bounds, obstacles: Obstacles, count: int) -> float:
    """Return the free share of the floor among the first `count` obstacles, on a 0.05 m raster."""
    length, width = bounds.north_max - bounds.north_min, bounds.east_max - bounds.east_min
    cell = max(0.05, math.sqrt(length * width / CELLS_MAX))
    rows, columns = math.ceil(length / cell), math.ceil(width / cell)
    north = bounds.north_min + length / rows * (np.arange(rows, dtype=np.float64) + 0.5)
    east = bounds.east_min + width / columns * (np.arange(columns, dtype=np.float64) + 0.5)
    free, boxes = np.ones((rows, columns), np.bool_), bounding_boxes(obstacles)
    for i in range(count):
        reach = boxes.half[i]
        window = (
            _window(north, boxes.center[i, 0], reach[0]),
            _window(east, boxes.center[i, 1], reach[1]),
        )
        free[window] &= _distance(obstacles, i, north[window[0]], east[window[1]]) > 0.0
    return float(free.mean())


def _window(axis: Floats, center: float, reach: float) -> slice:
    """Return the cells of an ascending axis within `reach` of `center`."""
    first, last = np.searchsorted(axis, [center - reach, center + reach])
    return slice(int(first), int(last) + 1)


def _distance(obstacles: Obstacles, i: int, north: Floats, east: Floats) -> NDArray[np.float64]:
    """Return the distance (rows, columns) [m] of cells to a footprint; 0 or less inside."""
    dn = north[:, None] - obstacles.center[i, 0]
    de = east[None, :] - obstacles.center[i, 1]
    along, across = obstacles.half_size[i, :2]
    if obstacles.shape[i] != Shape.BOX:
        radial: NDArray[np.float64] = np.hypot(dn, de) - along
        return radial
    cos, sin = math.cos(obstacles.yaw[i]), math.sin(obstacles.yaw[i])
    u = np.abs(dn * cos + de * sin) - along
    v = np.abs(de * cos - dn * sin) - across
    distance: NDArray[np.float64] = np.hypot(np.maximum(u, 0.0), np.maximum(v, 0.0))
    return distance
