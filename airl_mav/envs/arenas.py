"""N arenas as padded arrays: what the fleet kernels collide with and look at."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from airl_mav.arena.geometry import Arena
from airl_mav.arena.ground import COLUMNS, GRID_SIZE, ROWS, Relief
from airl_mav.core.constants import US_PER_S
from airl_mav.core.kernels import kernel


class ArenaBatch(NamedTuple):
    """N arenas; obstacle arrays are padded to the greatest number, tours to the longest."""

    bounds: NDArray[np.float64]  # (n, 6) as Bounds.as_array
    n_obstacles: NDArray[np.int64]  # (n,) static ones first
    n_static: NDArray[np.int64]  # (n,)
    shape: NDArray[np.int8]  # (n, m)
    center: NDArray[np.float64]  # (n, m, 3) NED [m]; moving ones are updated in flight
    half_size: NDArray[np.float64]  # (n, m, 3) [m]
    yaw: NDArray[np.float64]  # (n, m) [rad]
    tour_times_s: NDArray[np.float64]  # (n, movers, k) padded with infinity
    tour_points: NDArray[np.float64]  # (n, movers, k, 2)
    tour_period_s: NDArray[np.float64]  # (n, movers)
    tour_speed: NDArray[np.float64]  # (n,) greatest speed of any mover [m/s]
    goal: NDArray[np.float64]  # (n, 3) north, east, down [m]; down is NaN where it has no height
    heights: NDArray[np.float64]  # (n, h) `Relief.heights` of each
    grid: NDArray[np.float64]  # (n, GRID_SIZE) `Relief.grid`; no rows: the ground is the floor


def empty_batch(n: int, obstacles: int, movers: int, points: int, heights: int = 0) -> ArenaBatch:
    """Return room for n arenas of at most so many obstacles, movers, way-points and heights."""
    return ArenaBatch(
        bounds=np.zeros((n, 6)),
        n_obstacles=np.zeros(n, np.int64),
        n_static=np.zeros(n, np.int64),
        shape=np.zeros((n, obstacles), np.int8),
        center=np.zeros((n, obstacles, 3)),
        half_size=np.zeros((n, obstacles, 3)),
        yaw=np.zeros((n, obstacles)),
        tour_times_s=np.full((n, movers, points), np.inf),
        tour_points=np.zeros((n, movers, points, 2)),
        tour_period_s=np.ones((n, movers)),
        tour_speed=np.zeros(n),
        goal=np.tile((0.0, 0.0, math.nan), (n, 1)),
        heights=np.zeros((n, heights)),
        grid=np.zeros((n, GRID_SIZE)),
    )


def batch_of(arenas: Sequence[Arena]) -> ArenaBatch:
    """Return the arenas as one batch, with exactly the room they need."""
    tours = [tour for arena in arenas for tour in arena.tours]
    batch = empty_batch(
        len(arenas),
        max((len(arena.obstacles) for arena in arenas), default=0),
        max((len(arena.tours) for arena in arenas), default=0),
        max((len(tour.times_s) for tour in tours), default=0),
        max((_heights_of(arena) for arena in arenas), default=0),
    )
    for i, arena in enumerate(arenas):
        put_arena(batch, i, arena)
    return batch


def with_room(batch: ArenaBatch, arena: Arena) -> ArenaBatch:
    """Return a batch with the same arenas in which there is room for another one."""
    larger = empty_batch(len(batch.bounds), *map(max, _room_in(batch), _room_of(arena)))
    copy_rows(batch, larger)
    return larger


def copy_rows(batch: Iterable[NDArray[Any]], larger: Iterable[NDArray[Any]]) -> None:
    """Write arrays into the first places of others that have at least as much room."""
    for old, new in zip(batch, larger, strict=True):
        new[tuple(map(slice, old.shape))] = old


def _room_of(arena: Arena) -> tuple[int, int, int, int]:
    """Return how many obstacles, movers, way-points and heights an arena has."""
    points = max((len(tour.times_s) for tour in arena.tours), default=0)
    return len(arena.obstacles), len(arena.tours), points, _heights_of(arena)


def _heights_of(arena: Arena) -> int:
    """Return how many heights the ground of an arena has."""
    return 0 if arena.ground is None else arena.ground.heights.size


def _room_in(batch: ArenaBatch) -> tuple[int, int, int, int]:
    """Return how many of the same there is room for in a batch."""
    _, movers, points = batch.tour_times_s.shape
    return batch.shape.shape[1], movers, points, batch.heights.shape[1]


def put_arena(batch: ArenaBatch, i: int, arena: Arena) -> None:
    """Write an arena into row i. Raises ValueError when it needs more room than there is."""
    o = arena.obstacles
    need, room = _room_of(arena), _room_in(batch)
    if any(each > most for each, most in zip(need, room, strict=True)):
        raise ValueError(f"arena needs {need}, the batch has room for {room}")
    count = need[0]
    batch.bounds[i] = arena.bounds.as_array()
    batch.n_obstacles[i], batch.n_static[i] = count, arena.n_static
    batch.shape[i, :count] = o.shape
    batch.center[i, :count] = o.center
    batch.half_size[i, :count] = o.half_size
    batch.yaw[i, :count] = o.yaw
    height_m = arena.goal_height_m
    batch.goal[i, :2] = arena.goal
    batch.goal[i, 2] = math.nan if height_m is None else -height_m
    batch.grid[i] = 0.0
    if arena.ground is not None:
        relief = arena.ground.relief
        batch.heights[i, : len(relief.heights)], batch.grid[i] = relief
    batch.tour_times_s[i] = np.inf
    batch.tour_speed[i] = 0.0
    for j, tour in enumerate(arena.tours):
        k = len(tour.times_s)
        batch.tour_times_s[i, j, :k] = tour.times_s
        batch.tour_points[i, j, :k] = tour.points
        batch.tour_period_s[i, j] = tour.times_s[-1]
        batch.center[i, arena.n_static + j, :2] = tour.points[0]
        batch.tour_speed[i] = max(batch.tour_speed[i], _fastest(tour.times_s, tour.points))


@kernel
def _fastest(times_s: NDArray[np.float64], points: NDArray[np.float64]) -> float:
    """Return the greatest speed [m/s] of a tour, as the fields of `Tour`."""
    greatest = 0.0
    for k in range(len(times_s) - 1):
        north, east = points[k + 1, 0] - points[k, 0], points[k + 1, 1] - points[k, 1]
        passed = times_s[k + 1] - times_s[k]
        greatest = max(greatest, (north * north + east * east) / (passed * passed))
    return math.sqrt(greatest)


@kernel
def relief_of(batch: ArenaBatch, i: int) -> Relief:
    """Return the ground of arena i."""
    grid = batch.grid[i]
    return Relief(batch.heights[i, : int(grid[ROWS]) * int(grid[COLUMNS])], grid)


@kernel
def move_all_obstacles(batch: ArenaBatch, time_us: NDArray[np.int64]) -> None:
    """Put the moving obstacles of all arenas where they are at a time (n,) of each episode."""
    for i in range(len(time_us)):
        move_obstacles(batch, i, time_us[i])


@kernel
def move_obstacles(batch: ArenaBatch, i: int, time_us: int) -> None:
    """Put the moving obstacles of arena i where they are `time_us` after its episode's start.

    The same interpolation as `Arena.centers_at`.
    """
    for j in range(batch.n_obstacles[i] - batch.n_static[i]):
        t = (time_us / US_PER_S) % batch.tour_period_s[i, j]
        times = batch.tour_times_s[i, j]
        k = 0
        while times[k + 1] <= t:
            k += 1
        a = (t - times[k]) / (times[k + 1] - times[k])
        obstacle = batch.n_static[i] + j
        for axis in range(2):
            start = batch.tour_points[i, j, k, axis]
            end = batch.tour_points[i, j, k + 1, axis]
            batch.center[i, obstacle, axis] = start + a * (end - start)
