"""Placement of obstacles by bounded rejection sampling, and their footprints."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from airl_mav.arena.geometry import Bounds, Obstacles, Shape
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
