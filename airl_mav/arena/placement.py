"""Find free places for obstacles by bounded rejection sampling."""

from __future__ import annotations

import numpy as np

from airl_mav.arena.footprints import Boxes, Floats, inner, join, outside_all
from airl_mav.arena.geometry import Bounds

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


def draw_place(
    rng: np.random.Generator, half: Floats, keep_off: Boxes, bounds: Bounds, gap_m: float
) -> Floats | None:
    """Draw a free place (2,) [m] for one bounding box, uniform over all free ones.

    Args:
        rng: Source of the draws.
        half: (2,) half extents of the box [m].
        keep_off: What it must not overlap; any clearance already added.
        bounds: The walls.
        gap_m: Least gap to the walls [m].

    Returns:
        North, east; None when TRIES places were all taken.
    """
    low, high = inner(bounds, half + gap_m)
    if (low > high).any():
        return None
    grown = keep_off.grown(half)
    for _ in range(BATCHES):
        points = rng.uniform(low, high, size=(BATCH, 2))
        free = np.flatnonzero(outside_all(points, grown))
        if len(free):
            place: Floats = points[free[0]]
            return place
    return None


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
    places = np.empty((len(halves), 2))
    for i, half in enumerate(halves):
        placed = Boxes(places[:i], halves[:i]).grown(gap_m)
        place = draw_place(rng, half, join(keep_off, placed), bounds, gap_m)
        if place is None:
            raise NoRoomError(f"{i} of {len(halves)} placed", i)
        places[i] = place
    return places
