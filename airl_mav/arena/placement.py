"""Placement of obstacles by bounded rejection sampling, their footprints, and a way between them.

The search for a passage from start to goal around static footprints and hills is conservative.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from airl_mav.arena.geometry import STEEPEST, Bounds, Ground, Obstacles, Shape
from airl_mav.core.errors import FieldError
from airl_mav.core.kernels import kernel
from airl_mav.profiles.arena import ArenaSpec

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
        # The bounding box of a turned rectangle.
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
        # The segment is inside both slabs within its length.
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


BATCH = 64
BATCHES = 32
TRIES = BATCH * BATCHES
"""Positions tried for one obstacle before its layout is discarded."""


class NoRoomError(Exception):
    """Failed draw. Internal: `generate` retries, then reports an error to the user."""

    def __init__(self, message: str, progress: int) -> None:
        """Store the failure and its progress (higher is better)."""
        super().__init__(message)
        self.progress = progress


@kernel
def draw_place(
    rng: np.random.Generator,
    half: Floats,
    center: Floats,
    taken: Floats,
    low: Floats,
    high: Floats,
    gap_m: float,
    place: Floats,
) -> bool:
    """Draw a free position for a bounding box, uniform over all; return whether TRIES sufficed.

    The box must not overlap the boxes `center`, `taken` (k, 2), which include any clearance. It
    keeps `gap_m` to the walls of the floor `low`..`high`. All are north, east [m]. `half` and
    `taken` are half extents. `place` (2,) is written.
    """
    # Shrink the floor by the box, and grow the other boxes by it: then test a point.
    lowest = low + (half + gap_m)
    span, grown = high - (half + gap_m) - lowest, taken + half
    if span.min() < 0.0:
        return False
    numbers = np.empty((BATCH, 2))
    for _ in range(BATCHES):
        draw_numbers(rng, numbers)
        if _first_free(numbers, lowest, span, center, grown, place):
            return True
    return False


@kernel
def _first_free(
    numbers: Floats, lowest: Floats, span: Floats, center: Floats, grown: Floats, place: Floats
) -> bool:
    """Write the first point outside all boxes. Return whether there is one.

    The rectangle has the south-west corner `lowest` and the sides `span` (2,) [m]. `numbers` (k, 2)
    in [0, 1) are points in the rectangle. The boxes have `center` and half extents `grown` (m, 2)
    [m].
    """
    for number in numbers:
        for axis in range(2):
            place[axis] = lowest[axis] + span[axis] * number[axis]
        if outside(place, center, grown):
            return True
    return False


def place_all(
    rng: np.random.Generator, halves: Floats, keep_off: Boxes, bounds: Bounds, gap_m: float
) -> Floats:
    """Draw places (n, 2) [m] of bounding boxes (n, 2) `gap_m` apart from each other and the walls.

    `keep_off` are other boxes, including any clearance. Raises NoRoomError if a box found no place
    in TRIES tries; `progress` is the number of placed boxes.
    """
    n, boxes = len(halves), with_room(keep_off, halves + gap_m)
    low, high = inner(bounds, 0.0)
    placed, tried = 0, 0
    while placed < n and tried < BATCHES:
        # One numpy call is faster than passing a generator to numba. Each unplaced box needs at
        # least one batch.
        batches = rng.random((n - placed, BATCH, 2))
        placed, tried, used = _place_all(
            batches, halves, boxes.center, boxes.half, low, high, gap_m, placed, tried
        )
        if used < len(batches):
            # Unused numbers return, so that later draws do not depend on the batch size.
            _give_back(rng, batches[used:].size)
    if placed < n:
        raise NoRoomError(f"{placed} of {n} placed", placed)
    return boxes.center[len(keep_off) :]


@kernel
def _place_all(
    batches: Floats,
    halves: Floats,
    center: Floats,
    half: Floats,
    low: Floats,
    high: Floats,
    gap_m: float,
    placed: int,
    tried: int,
) -> tuple[int, int, int]:
    """Place boxes one by one, into the last rows of `center`, until the numbers are used up.

    `batches` (k, BATCH, 2) in [0, 1) each serve one try of a box. `center` and `half` are the boxes
    to avoid, including clearance, and the placed ones [m]. `placed` boxes have a position, the next
    one has tried `tried` batches; the rest as in `place_all` and `draw_place`.

    Returns:
        New `placed` and `tried`, at most BATCHES, and the number of used batches.
    """
    n, used = len(halves), 0
    while placed < n and tried < BATCHES and used < len(batches):
        i, at = placed, len(center) - n + placed
        lowest = low + (halves[i] + gap_m)
        span, grown = high - (halves[i] + gap_m) - lowest, half[:at] + halves[i]
        # The floor is too small for the box: no number of tries helps.
        if span.min() < 0.0:
            return placed, BATCHES, used
        used += 1
        if _first_free(batches[used - 1], lowest, span, center[:at], grown, center[at]):
            placed, tried = placed + 1, 0
        else:
            tried += 1
    return placed, tried, used


def _give_back(rng: np.random.Generator, count: int) -> None:
    """Rewind a generator by `count` uniform numbers."""
    bits: Any = rng.bit_generator  # PCG64 of `default_rng` can advance backwards.
    # A buffered 32-bit half must survive; `advance` discards it.
    waiting = bits.state
    bits.advance(-count)
    bits.state = {**waiting, "state": bits.state["state"]}


def zone_radius_m(spec: ArenaSpec, zone: int | None) -> float:
    """Return the maximum goal distance [m] of a zone, None = the largest; FieldError if missing."""
    if zone is None:
        return spec.zones_m[-1]
    if not 0 <= zone < len(spec.zones_m):
        radii = ", ".join(f"{radius:g}" for radius in spec.zones_m)
        raise FieldError(
            "zone", zone, f"0 <= value <= {len(spec.zones_m) - 1} (zones_m [{radii}] m)"
        )
    return spec.zones_m[zone]


def zone_of(spec: ArenaSpec, goal: Floats) -> int | None:
    """Return the smallest zone that contains a goal (2,) [m from the start]; None = beyond all."""
    distance = math.hypot(goal[0], goal[1])
    return next((k for k, radius in enumerate(spec.zones_m) if distance <= radius), None)


def draw_goal(
    rng: np.random.Generator,
    bounds: Bounds,
    keep_off: Boxes,
    ring_m: tuple[float, float],
    gap_m: float,
) -> Floats | None:
    """Draw a goal (2,) [m] on the free floor at a distance `ring_m`; None if none is found."""
    nearest, farthest = ring_m
    low, high = inner(bounds, gap_m)
    # Sample only the square around the ring.
    low, high = np.maximum(low, -farthest), np.minimum(high, farthest)
    if (low > high).any():
        return None
    goal, span = np.empty(2), high - low
    for _ in range(BATCHES):
        # One numpy call is faster than passing a generator to numba.
        numbers = rng.random((BATCH, 2))
        if _find_goal(numbers, low, span, nearest, farthest, keep_off.center, keep_off.half, goal):
            return goal
    return None


@kernel
def _find_goal(
    numbers: Floats,
    low: Floats,
    span: Floats,
    nearest: float,
    farthest: float,
    center: Floats,
    half: Floats,
    goal: Floats,
) -> bool:
    """Write the first of the scaled points `numbers` (n, 2) in the ring and outside all boxes."""
    for number in numbers:
        for axis in range(2):
            goal[axis] = low[axis] + span[axis] * number[axis]
        distance = math.hypot(goal[0], goal[1])
        if nearest <= distance <= farthest and outside(goal, center, half):
            return True
    return False


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
