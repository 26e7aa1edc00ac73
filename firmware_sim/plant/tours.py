"""Where moving obstacles are: their tours as arrays, for kernels."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from airl_mav.arena.geometry import Arena
from airl_mav.core.constants import US_PER_S
from airl_mav.core.frames import Vector
from airl_mav.core.kernels import kernel


def tour_arrays(arena: Arena) -> tuple[Vector, Vector]:
    """Return the tours of an arena's n moving obstacles, which have up to k way-points.

    Returns:
        times: (n, 1 + k) period of the tour; then when its way-points are passed [s], and inf.
        points: (n, k, 2) way-points north, east [m].
    """
    n, k = len(arena.tours), max((len(tour.times_s) for tour in arena.tours), default=1)
    times, points = np.full((n, 1 + k), np.inf), np.zeros((n, k, 2))
    for i, tour in enumerate(arena.tours):
        times[i, 0] = tour.times_s[-1]
        times[i, 1 : 1 + len(tour.times_s)] = tour.times_s
        points[i, : len(tour.points)] = tour.points
    return times, points


@kernel
def place_at(
    time_us: int, times_s: Vector, points: Vector, leg: NDArray[np.int64], i: int
) -> tuple[float, float]:
    """Return north, east [m] of moving obstacle i.

    Args:
        time_us: Since the start of the episode [µs].
        times_s: (n, 1 + k) as `tour_arrays`.
        points: (n, k, 2) as `tour_arrays`.
        leg: (n,) the way-point passed last; updated.
        i: Which.
    """
    t = (time_us / US_PER_S) % times_s[i, 0]
    passed = times_s[i, 1:]
    k = leg[i] if passed[leg[i]] <= t else 0
    while passed[k + 1] <= t:
        k += 1
    leg[i] = k
    # The order of numpy.interp, so that body and picture agree to the last bit.
    a, b, step = points[i, k], points[i, k + 1], passed[k + 1] - passed[k]
    north = (b[0] - a[0]) / step * (t - passed[k]) + a[0]
    east = (b[1] - a[1]) / step * (t - passed[k]) + a[1]
    return north, east
