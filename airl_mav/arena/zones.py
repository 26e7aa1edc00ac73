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
    """Return how far [m] from the start a goal of a zone may be; None means the largest zone.

    Raises FieldError when there is no such zone.
    """
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
    """Draw a goal (2,) [m], uniform over the free floor at a distance within `ring_m`.

    Args:
        rng: Source of the draws.
        bounds: The walls.
        keep_off: Where it must not be; any clearance already added.
        ring_m: Least and greatest distance from the start [m].
        gap_m: Least gap to the walls [m].

    Returns:
        North, east from the start; None when no try was free.
    """
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
    """Write the first point within the ring, outside all boxes.

    Of those that `numbers` (n, 2), uniform in [0, 1), stand for.
    """
    for number in numbers:
        for axis in range(2):
            goal[axis] = low[axis] + span[axis] * number[axis]
        distance = math.hypot(goal[0], goal[1])
        if nearest <= distance <= farthest and outside(goal, center, half):
            return True
    return False
