"""Closed tours of moving obstacles: random way-point walks clear of static obstacles.

The paper's movers walk to a random reachable point within 30 m, wait 0.2 s and continue, at a speed
drawn once (Air Learning's BP_AISpawner). Unlike those, these tours repeat with the seed.
"""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from airl_mav.arena.geometry import Arena, Bounds, Tour
from airl_mav.arena.placement import (
    Boxes,
    Floats,
    draw_numbers,
    draw_place,
    inner,
    segment_clear,
    with_room,
)
from airl_mav.core.kernels import kernel, large_kernel
from airl_mav.profiles.arena import MovingObstacles

LEG_MIN_M = 1.0
"""Minimum leg [m]; shorter legs would only twitch."""

BATCH = 32
BATCHES = 8
STARTS_PER_TOUR = 16
"""Start positions tried for an obstacle that cannot move."""

HOMING_LEGS = 16
"""Legs tried for a free return to the start before the walk is retraced."""

ROUNDING_S = 1e-9
"""Minimum time between way-points [s]; closer ones are merged."""


def draw_tours(
    rng: np.random.Generator,
    halves: Floats,
    keep_off: Boxes,
    walls: Boxes,
    bounds: Bounds,
    gap_m: float,
    kind: MovingObstacles,
) -> list[Tour]:
    """Draw closed tours, clear of each other at time 0; fewer if one finds no place.

    `halves` (n, 2) are half extents [m]. `keep_off` are boxes to avoid at time 0, `walls` during
    the tour, including any clearance, `gap_m` is the minimum gap at time 0 [m].
    """
    boxes = with_room(keep_off, halves + gap_m)
    low, high = inner(bounds, 0.0)
    slowest, fastest = kind.speed_m_s
    # Convert to float: integers would compile a second version of the kernel.
    points, counts, speeds = _walk_all(
        rng,
        halves,
        boxes.center,
        boxes.half,
        walls.center,
        walls.half,
        low,
        high,
        float(max(gap_m, kind.clearance_m)),
        float(kind.clearance_m),
        float(kind.leg_max_m),
        float(slowest),
        float(fastest),
        float(kind.dwell_s),
        float(kind.tour_min_s),
    )
    # `math.dist` of Python lists has the same bits on every platform.
    way = points.tolist()
    # One extra leg between two tours. The last bit of the kernel's hypot depends on the platform.
    legs = np.fromiter(map(math.dist, way, way[1:]), np.float64)
    times, places, ends = _timed(points, counts, speeds, legs, kind.dwell_s)
    return [
        Tour(times[begin:end], places[begin:end]) for begin, end in pairwise((0, *ends.tolist()))
    ]


@kernel
def _walk_all(
    rng: np.random.Generator,
    halves: Floats,
    center: Floats,
    half: Floats,
    wall_center: Floats,
    wall_half: Floats,
    low: Floats,
    high: Floats,
    gap_m: float,
    clearance_m: float,
    leg_max_m: float,
    slowest: float,
    fastest: float,
    dwell_s: float,
    least_s: float,
) -> tuple[Floats, NDArray[np.int64], Floats]:
    """Return way-points (k, 2), their counts and speeds (m,) of walks; write their starts."""
    n = len(halves)
    points, counts, speeds = np.empty((0, 2)), np.zeros(n, np.int64), np.empty(n)
    for i in range(n):
        at = len(center) - n + i
        start = center[at]
        margin = halves[i] + clearance_m
        for _ in range(STARTS_PER_TOUR):
            if not draw_place(rng, halves[i], center[:at], half[:at], low, high, gap_m, start):
                return points, counts[:i], speeds[:i]
            # The speed is drawn once per obstacle.
            speeds[i] = slowest + (fastest - slowest) * rng.random()
            walk = _walk(
                rng,
                start,
                wall_center,
                wall_half + halves[i],
                low + margin,
                high - margin,
                leg_max_m,
                speeds[i],
                dwell_s,
                least_s,
            )
            if len(walk) > 1:
                points, counts[i] = np.concatenate((points, walk)), len(walk)
                break
        if counts[i] == 0:
            return points, counts[:i], speeds[:i]
    return points, counts, speeds


@large_kernel
def _walk(
    rng: np.random.Generator,
    start: Floats,
    center: Floats,
    half: Floats,
    south_west: Floats,
    north_east: Floats,
    leg_max_m: float,
    speed: float,
    dwell_s: float,
    least_s: float,
) -> Floats:
    """Return the way-points (k, 2) of a closed walk clear of the boxes, or `start` alone."""
    points = np.empty((64, 2))
    points[0, 0], points[0, 1] = start[0], start[1]
    count, elapsed, homing = 1, 0.0, 0
    while homing < HOMING_LEGS:
        here = points[count - 1]
        home = math.hypot(here[0] - start[0], here[1] - start[1])
        # The tour is long enough: return to the start if the way is free.
        if count > 1 and elapsed + home / speed + dwell_s >= least_s:
            homing += 1
            if LEG_MIN_M <= home <= leg_max_m and segment_clear(here, start, center, half):
                return np.concatenate((points[:count], points[:1]))
        low = np.maximum(south_west, here - leg_max_m)
        span = np.minimum(north_east, here + leg_max_m) - low
        if count == len(points):
            points = np.concatenate((points, np.empty_like(points)))
            here = points[count - 1]
        there = points[count]
        if not _draw_waypoint(rng, low, span, here, leg_max_m, center, half, there):
            return points[:1]
        elapsed += math.hypot(there[0] - here[0], there[1] - here[1]) / speed + dwell_s
        count += 1
    # No free way home: walk the same way-points back.
    return np.concatenate((points[:count], points[:count][-2::-1]))


def set_out_later(arena: Arena, later_s: float) -> Arena:
    """Return the arena with its moving obstacles delayed by `later_s` on their closed tours."""
    if not arena.tours or later_s == 0.0:
        return arena
    tours = tuple(_begun_at(tour, -later_s % float(tour.times_s[-1])) for tour in arena.tours)
    center = arena.obstacles.center.copy()
    # The arrays of obstacles hold the positions at time 0.
    center[arena.n_static :, :2] = [tour.points[0] for tour in tours]
    return replace(arena, obstacles=replace(arena.obstacles, center=center), tours=tours)


def _begun_at(tour: Tour, at_s: float) -> Tour:
    """Return the tour shifted to start at `at_s` [s], between 0 and its period."""
    period = float(tour.times_s[-1])
    here = [[np.interp(at_s, tour.times_s, axis) for axis in tour.points.T]]
    # The first point equals the last one.
    times, points = (tour.times_s[1:] - at_s) % period, tour.points[1:]
    order = np.argsort(times, kind="stable")
    order = order[(times[order] > ROUNDING_S) & (times[order] < period - ROUNDING_S)]
    return Tour(
        np.concatenate([[0.0], times[order], [period]]),
        np.concatenate([here, points[order], here]),
    )


@kernel
def _draw_waypoint(
    rng: np.random.Generator,
    low: Floats,
    span: Floats,
    here: Floats,
    leg_max_m: float,
    center: Floats,
    half: Floats,
    there: Floats,
) -> bool:
    """Write the first drawn point that is the end of a free leg."""
    numbers = np.empty((BATCH, 2))
    for _ in range(BATCHES):
        draw_numbers(rng, numbers)
        for number in numbers:
            for axis in range(2):
                there[axis] = low[axis] + span[axis] * number[axis]
            length = math.hypot(there[0] - here[0], there[1] - here[1])
            if LEG_MIN_M <= length <= leg_max_m and segment_clear(here, there, center, half):
                return True
    return False


@kernel
def _timed(
    points: Floats, counts: NDArray[np.int64], speeds: Floats, legs: Floats, dwell_s: float
) -> tuple[Floats, Floats, NDArray[np.int64]]:
    """Return times [s] and positions [m] of tours at constant speeds, and the end index of each.

    `points` (k, 2) are the way-points of all tours [m], `counts` (m,) their numbers, `speeds` (m,)
    [m/s], `legs` (k - 1,) the distances [m]. Each way-point but the first has a stop of `dwell_s`.
    """
    stops = 1 if dwell_s > 0.0 else 0
    times, places = np.empty(len(points) * (1 + stops)), np.empty((len(points) * (1 + stops), 2))
    ends, first, at = np.empty(len(counts), np.int64), 0, 0
    for i in range(len(counts)):
        times[at], places[at, 0], places[at, 1] = 0.0, points[first, 0], points[first, 1]
        for k in range(first + 1, first + counts[i]):
            for stop in range(1 + stops):
                # A way-point has two times with a stop: arrival and departure.
                times[at + 1] = times[at] + (dwell_s if stop else legs[k - 1] / speeds[i])
                places[at + 1, 0], places[at + 1, 1] = points[k, 0], points[k, 1]
                at += 1
        at, first = at + 1, first + counts[i]
        ends[i] = at
    return times, places, ends
