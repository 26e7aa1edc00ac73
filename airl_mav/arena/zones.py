"""Curriculum zones: discs around the start, each holding the smaller ones, that bound the goal."""

from __future__ import annotations

import math

import numpy as np

from airl_mav.arena.footprints import Boxes, Floats, inner, outside
from airl_mav.arena.geometry import Bounds
from airl_mav.arena.placement import BATCH, BATCHES
from airl_mav.core.errors import FieldError
from airl_mav.core.kernels import kernel
from airl_mav.profiles.arena import ArenaSpec


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
