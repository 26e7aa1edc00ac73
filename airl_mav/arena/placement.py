"""Placement of obstacles by bounded rejection sampling."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from airl_mav.arena.footprints import Boxes, Floats, draw_numbers, inner, outside, with_room
from airl_mav.arena.geometry import Bounds
from airl_mav.core.errors import FieldError
from airl_mav.core.kernels import kernel
from airl_mav.profiles.arena import ArenaSpec

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
