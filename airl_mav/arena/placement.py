"""Find free places for obstacles by bounded rejection sampling."""

from __future__ import annotations

import numpy as np

from airl_mav.arena.footprints import Boxes, Floats, draw_points, inner, outside, with_room
from airl_mav.arena.geometry import Bounds
from airl_mav.core.kernels import kernel

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
    """Draw a free place for one bounding box, uniform over all free ones.

    Args:
        rng: Source of the draws.
        half: (2,) half extents of the box [m].
        center: (k, 2) centres of the boxes that it must not overlap [m].
        taken: (k, 2) their half extents, any clearance already added [m].
        low: (2,) south-west corner of the floor [m].
        high: (2,) north-east corner of it [m].
        gap_m: Least gap to the walls [m].
        place: (2,) north, east [m]; written.

    Returns:
        Whether there was one within TRIES tries.
    """
    lowest, highest = low + (half + gap_m), high - (half + gap_m)
    if lowest[0] > highest[0] or lowest[1] > highest[1]:
        return False
    points, span, grown = np.empty((BATCH, 2)), highest - lowest, taken + half
    for _ in range(BATCHES):
        draw_points(rng, lowest, span, points)
        for point in points:
            if outside(point, center, grown):
                place[:] = point
                return True
    return False


def place_all(
    rng: np.random.Generator, halves: Floats, keep_off: Boxes, bounds: Bounds, gap_m: float
) -> Floats:
    """Draw places (n, 2) [m] for bounding boxes that keep `gap_m` from each other and the walls.

    Args:
        rng: Source of the draws.
        halves: (n, 2) half extents [m].
        keep_off: What else none may overlap; any clearance already added.
        bounds: The walls.
        gap_m: Least gap between two boxes, along north or along east, and to the walls [m].

    Raises:
        NoRoomError: One found no place in TRIES tries; `progress` is how many had.
    """
    n, boxes = len(halves), with_room(keep_off, halves + gap_m)
    low, high = inner(bounds, 0.0)
    placed = _place_all(rng, halves, boxes.center, boxes.half, low, high, gap_m)
    if placed < n:
        raise NoRoomError(f"{placed} of {n} placed", placed)
    return boxes.center[len(keep_off) :]


@kernel
def _place_all(
    rng: np.random.Generator,
    halves: Floats,
    center: Floats,
    half: Floats,
    low: Floats,
    high: Floats,
    gap_m: float,
) -> int:
    """Place boxes one by one, into the last rows of `center`; return how many found room."""
    n = len(halves)
    for i in range(n):
        at = len(center) - n + i
        if not draw_place(rng, halves[i], center[:at], half[:at], low, high, gap_m, center[at]):
            return i
    return n
