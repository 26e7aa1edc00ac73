"""Tours of moving obstacles: random way-point walks that close, free of everything that stands.

The paper's movers walk to a random reachable point within 30 m, wait 0.2 s and go on, at a speed
drawn once (Air Learning's BP_AISpawner). Theirs do not repeat with the seed; these do.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np

from airl_mav.arena.footprints import Boxes, Floats, segments_clear
from airl_mav.arena.geometry import Arena, Tour
from airl_mav.profiles.arena import MovingObstacles

LEG_MIN_M = 1.0
"""Shorter legs would only twitch."""

BATCH = 32
BATCHES = 8
HOMING_LEGS = 16
"""Legs tried for a free way home before the walk goes back the way it came."""


ROUNDING_S = 1e-9
"""Way-points that are passed closer to each other are one."""


def draw_tour(
    rng: np.random.Generator,
    start: Floats,
    keep_off: Boxes,
    corners: tuple[Floats, Floats],
    kind: MovingObstacles,
) -> Tour | None:
    """Draw the tour of one obstacle.

    Args:
        rng: Source of the draws.
        start: (2,) where it is at time 0 [m].
        keep_off: What its centre must never enter: grown by its extent and clearance.
        corners: South-west and north-east corner of where its centre may be [m].
        kind: Speed range, leg length, dwell and least duration.

    Returns:
        The closed tour; None when there is no way to leave `start`.
    """
    speed = rng.uniform(*kind.speed_m_s)
    points = [start]
    elapsed = 0.0
    homing = 0
    while homing < HOMING_LEGS:
        here = points[-1]
        home = math.dist(here, start)
        if len(points) > 1 and elapsed + home / speed + kind.dwell_s >= kind.tour_min_s:
            homing += 1
            reachable = LEG_MIN_M <= home <= kind.leg_max_m
            if reachable and segments_clear(here, start[None], keep_off)[0]:
                return _timed([*points, start], speed, kind.dwell_s)
        target = _draw_waypoint(rng, here, keep_off, corners, kind.leg_max_m)
        if target is None:
            return None
        elapsed += math.dist(here, target) / speed + kind.dwell_s
        points.append(target)
    return _timed([*points, *points[-2::-1]], speed, kind.dwell_s)


def set_out_later(arena: Arena, later_s: float) -> Arena:
    """Return the arena whose moving obstacles are so much later [s] where they are in this one.

    At `later_s` they stand where this one has them at time 0, and walk on as they do there; before
    that they walk the ends of their tours, which are closed.
    """
    if not arena.tours or later_s == 0.0:
        return arena
    tours = tuple(_begun_at(tour, -later_s % float(tour.times_s[-1])) for tour in arena.tours)
    center = arena.obstacles.center.copy()
    center[arena.n_static :, :2] = [tour.points[0] for tour in tours]
    return replace(arena, obstacles=replace(arena.obstacles, center=center), tours=tours)


def _begun_at(tour: Tour, at_s: float) -> Tour:
    """Return the same closed way, begun where it is at `at_s` [s] of 0 to its period."""
    period = float(tour.times_s[-1])
    here = [[np.interp(at_s, tour.times_s, axis) for axis in tour.points.T]]
    # The first point is the last one again.
    times, points = (tour.times_s[1:] - at_s) % period, tour.points[1:]
    order = np.argsort(times, kind="stable")
    order = order[(times[order] > ROUNDING_S) & (times[order] < period - ROUNDING_S)]
    return Tour(
        np.concatenate([[0.0], times[order], [period]]),
        np.concatenate([here, points[order], here]),
    )


def _draw_waypoint(
    rng: np.random.Generator,
    here: Floats,
    keep_off: Boxes,
    corners: tuple[Floats, Floats],
    leg_max_m: float,
) -> Floats | None:
    """Draw a point that a straight free leg from `here` ends at; None when no try was free."""
    low = np.maximum(corners[0], here - leg_max_m)
    high = np.minimum(corners[1], here + leg_max_m)
    for _ in range(BATCHES):
        ends = rng.uniform(low, high, size=(BATCH, 2))
        length = np.hypot(ends[:, 0] - here[0], ends[:, 1] - here[1])
        free = (length >= LEG_MIN_M) & (length <= leg_max_m)
        free &= segments_clear(here, ends, keep_off)
        if free.any():
            target: Floats = ends[int(free.argmax())]
            return target
    return None


def _timed(points: list[Floats], speed: float, dwell_s: float) -> Tour:
    """Return the tour through `points` at constant speed, with a stop at each but the first."""
    times = [0.0]
    places = [points[0]]
    for here, there in itertools.pairwise(points):
        times.append(times[-1] + math.dist(here, there) / speed)
        places.append(there)
        if dwell_s > 0.0:
            times.append(times[-1] + dwell_s)
            places.append(there)
    return Tour(np.array(times), np.array(places))
