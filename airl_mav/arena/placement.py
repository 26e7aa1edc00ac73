"""Find free places for obstacles by bounded rejection sampling."""

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
"""Places tried for one obstacle before its layout is given up."""


class NoRoomError(Exception):
    """A draw that did not fit. Internal: `generate` tries again, then tells the user."""

    def __init__(self, message: str, progress: int) -> None:
        """Keep what failed and how far it got (greater is farther)."""
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
    """Draw a free place for a bounding box, uniform over all; return whether TRIES sufficed.

    It must not overlap the boxes `center`, `taken` (k, 2), any clearance already added. It keeps
    `gap_m` to the walls of the floor `low`..`high`. All are north, east [m]. `half` and `taken` are
    half extents. `place` (2,) is written.
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
    """Write the first point of a rectangle that is in no box. Return whether there is one.

    The rectangle has the south-west corner `lowest` and the sides `span` (2,) [m], in which
    `numbers` (k, 2) in [0, 1) are the points. The boxes have `center` and half extents `grown` (m,
    2) [m].
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

    `keep_off` are other boxes, any clearance already added. Raises NoRoomError: one found no place
    in TRIES tries; `progress` is the number of placed boxes.
    """
    n, boxes = len(halves), with_room(keep_off, halves + gap_m)
    low, high = inner(bounds, 0.0)
    placed, tried = 0, 0
    while placed < n and tried < BATCHES:
        # Drawn here: numba needs longer to take a generator than numpy to draw all of them. Each
        # that has no place yet needs a batch at least.
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
    """Place boxes one by one, into the last rows of `center`, while there are numbers.

    `batches` (k, BATCH, 2) in [0, 1) are for one try of a box each. `center` and `half` are the
    boxes to avoid, any clearance added, and the placed ones [m]. `placed` boxes have a place, the
    next one has tried `tried` batches; the rest as of `place_all` and `draw_place`.

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
    """Let a generator draw its last `count` uniform numbers once more."""
    bits: Any = rng.bit_generator  # One that can go back: that of `default_rng`.
    # Half of a number may wait to be drawn as a whole number; `advance` forgets it.
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
    """Return the smallest zone that holds a goal (2,) [m from the start]; None: beyond them all."""
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
        # Drawn here: numba needs longer to take a generator than numpy to draw all of them.
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
    """Write the first of the points `numbers` (n, 2), scaled, in the ring and outside all boxes."""
    for number in numbers:
        for axis in range(2):
            goal[axis] = low[axis] + span[axis] * number[axis]
        distance = math.hypot(goal[0], goal[1])
        if nearest <= distance <= farthest and outside(goal, center, half):
            return True
    return False
