"""N arenas as padded arrays, for collision checks and rendering in the fleet kernels."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from airl_mav.arena.geometry import COLUMNS, GRID_SIZE, ROWS, STEEPEST, Arena, Relief, Shape
from airl_mav.arena.relief import extreme_within
from airl_mav.core.constants import US_PER_S
from airl_mav.core.kernels import kernel
from airl_mav.vehicle.rotation import Vec


class ArenaBatch(NamedTuple):
    """N arenas; obstacle arrays are padded to the maximum number, tours to the maximum length."""

    bounds: NDArray[np.float64]  # (n, 6) as Bounds.as_array
    n_obstacles: NDArray[np.int64]  # (n,) static ones first
    n_static: NDArray[np.int64]  # (n,)
    shape: NDArray[np.int8]  # (n, m)
    center: NDArray[np.float64]  # (n, m, 3) NED [m]; moving obstacles are updated in flight
    half_size: NDArray[np.float64]  # (n, m, 3) [m]
    yaw: NDArray[np.float64]  # (n, m) [rad]
    tour_times_s: NDArray[np.float64]  # (n, movers, k) padded with infinity
    tour_points: NDArray[np.float64]  # (n, movers, k, 2)
    tour_period_s: NDArray[np.float64]  # (n, movers)
    tour_speed: NDArray[np.float64]  # (n,) maximum speed of any mover [m/s]
    goal: NDArray[np.float64]  # (n, 3) north, east, down [m]; down is NaN if the height is free
    heights: NDArray[np.float64]  # (n, h) `Relief.heights` of each arena
    grid: NDArray[np.float64]  # (n, GRID_SIZE) `Relief.grid`; without rows the ground is flat


def empty_batch(n: int, obstacles: int, movers: int, points: int, heights: int = 0) -> ArenaBatch:
    """Return empty arrays for n arenas with maximum numbers of their elements."""
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
        # NaN marks a goal without a height.
        goal=np.tile((0.0, 0.0, math.nan), (n, 1)),
        heights=np.zeros((n, heights)),
        grid=np.zeros((n, GRID_SIZE)),
    )


def batch_of(arenas: Sequence[Arena]) -> ArenaBatch:
    """Return the arenas as one batch of minimum size."""
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
    """Return a copy of a batch that is large enough for another arena."""
    larger = empty_batch(len(batch.bounds), *map(max, _room_in(batch), _room_of(arena)))
    copy_rows(batch, larger)
    return larger


def copy_rows(batch: Iterable[NDArray[Any]], larger: Iterable[NDArray[Any]]) -> None:
    """Copy arrays into the leading part of others that are at least as large."""
    for old, new in zip(batch, larger, strict=True):
        new[tuple(map(slice, old.shape))] = old


def _room_of(arena: Arena) -> tuple[int, int, int, int]:
    """Return the numbers of obstacles, movers, waypoints and heights of an arena."""
    points = max((len(tour.times_s) for tour in arena.tours), default=0)
    return len(arena.obstacles), len(arena.tours), points, _heights_of(arena)


def _heights_of(arena: Arena) -> int:
    """Return the number of ground heights of an arena."""
    return 0 if arena.ground is None else arena.ground.heights.size


def _room_in(batch: ArenaBatch) -> tuple[int, int, int, int]:
    """Return a batch's capacity for obstacles, movers, waypoints and heights."""
    _, movers, points = batch.tour_times_s.shape
    return batch.shape.shape[1], movers, points, batch.heights.shape[1]


def put_arena(batch: ArenaBatch, i: int, arena: Arena) -> None:
    """Write an arena into row i. Raises ValueError if it exceeds the batch's capacity."""
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
    # NED: down is the negative height.
    batch.goal[i, 2] = math.nan if height_m is None else -height_m
    batch.grid[i] = 0.0
    if arena.ground is not None:
        relief = arena.ground.relief
        batch.heights[i, : len(relief.heights)], batch.grid[i] = relief
    # Padding: a tour search never passes an infinite time.
    batch.tour_times_s[i] = np.inf
    batch.tour_speed[i] = 0.0
    for j, tour in enumerate(arena.tours):
        k = len(tour.times_s)
        batch.tour_times_s[i, j, :k] = tour.times_s
        batch.tour_points[i, j, :k] = tour.points
        batch.tour_period_s[i, j] = tour.times_s[-1]
        # A mover starts at the first point of its tour.
        batch.center[i, arena.n_static + j, :2] = tour.points[0]
        batch.tour_speed[i] = max(batch.tour_speed[i], _fastest(tour.times_s, tour.points))


@kernel
def _fastest(times_s: NDArray[np.float64], points: NDArray[np.float64]) -> float:
    """Return the maximum speed [m/s] of a tour; arguments are fields of `Tour`."""
    greatest = 0.0
    for k in range(len(times_s) - 1):
        north, east = points[k + 1, 0] - points[k, 0], points[k + 1, 1] - points[k, 1]
        passed = times_s[k + 1] - times_s[k]
        # Squares are compared, so one root at the end is enough.
        greatest = max(greatest, (north * north + east * east) / (passed * passed))
    return math.sqrt(greatest)


@kernel
def relief_of(batch: ArenaBatch, i: int) -> Relief:
    """Return the ground of arena i."""
    grid = batch.grid[i]
    return Relief(batch.heights[i, : int(grid[ROWS]) * int(grid[COLUMNS])], grid)


@kernel
def move_all_obstacles(batch: ArenaBatch, time_us: NDArray[np.int64]) -> None:
    """Move the obstacles of all arenas to their positions at a time (n,) of each episode."""
    for i in range(len(time_us)):
        move_obstacles(batch, i, time_us[i])


@kernel
def move_obstacles(batch: ArenaBatch, i: int, time_us: int) -> None:
    """Move the obstacles of arena i to their positions `time_us` after the episode's start.

    The same interpolation as `Arena.centers_at`.
    """
    for j in range(batch.n_obstacles[i] - batch.n_static[i]):
        # Tours are cyclic.
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


# Contacts that are no obstacle; an obstacle's contact is its index.
NOTHING = -1
FLOOR = -2
WALL = -3
CEILING = -4

_BOX = int(Shape.BOX)
_SPHERE = int(Shape.SPHERE)


@kernel
def clearance(
    position: Vec,
    radius: float,
    half_height: float,
    bounds: NDArray[np.float64],
    count: int,
    center: NDArray[np.float64],
    half_size: NDArray[np.float64],
    relief: Relief | None = None,
) -> float:
    """Return a distance [m] that the vehicle may move without a contact; below 0 = unknown.

    A lower bound: obstacles count as upright cylinders around their bounding boxes. The distance to
    the ground is at least the height above it times the cosine of the steepest triangle's slope.
    Arguments as in `touches`.
    """
    x, y, z = position
    # Down is positive: `low` is the lowest point of the vehicle.
    low = z + half_height
    beside = min(min(x - bounds[0], bounds[1] - x), min(y - bounds[2], bounds[3] - y)) - radius
    # Above the walls only the height counts, otherwise the distance to the nearest wall.
    room: float = min(-low, max(beside, -bounds[4] - low))
    if relief is not None and len(relief.heights) > 0:
        # Beyond a wall the nearest ground is at the wall's foot.
        north, east = min(max(x, bounds[0]), bounds[1]), min(max(y, bounds[2]), bounds[3])
        above = -low - extreme_within(relief, north, east, radius, 1.0)
        steepest = relief.grid[STEEPEST]
        room = min(room, above / math.sqrt(1.0 + steepest * steepest))
    if bounds[5] > 0.0:
        room = min(room, bounds[4] + z - half_height)
    for i in range(count):
        dx, dy, dz = x - center[i, 0], y - center[i, 1], z - center[i, 2]
        hx, hy, hz = half_size[i, 0], half_size[i, 1], half_size[i, 2]
        # The bounding cylinder ignores yaw, so the distance is a lower bound.
        beside = math.sqrt(dx * dx + dy * dy) - math.sqrt(hx * hx + hy * hy) - radius
        room = min(room, max(beside, abs(dz) - half_height - hz))
    return room


@kernel
def touches(
    position: Vec,
    radius: float,
    half_height: float,
    bounds: NDArray[np.float64],
    count: int,
    shape: NDArray[np.int8],
    center: NDArray[np.float64],
    half_size: NDArray[np.float64],
    yaw: NDArray[np.float64],
    relief: Relief | None = None,
) -> int:
    """Return the index of the obstacle that the vehicle overlaps, or FLOOR, CEILING, WALL, NOTHING.

    Args:
        position: Vehicle NED [m].
        radius: Radius of the vehicle's disc [m].
        half_height: Half height of the vehicle's disc [m].
        bounds: `Bounds.as_array()`.
        count: Number of obstacles.
        shape: (m,).
        center: (m, 3) NED [m].
        half_size: (m, 3) [m].
        yaw: (m,) [rad].
        relief: The ground; None = flat. Contacts with it count as FLOOR.
    """
    x, y, z = position
    # The order of the tests decides what a simultaneous contact reports.
    if z + half_height > 0.0:
        return FLOOR
    # Beyond the walls and without hills the result is -infinity, so the ground is level.
    if relief is not None and z + half_height > -extreme_within(relief, x, y, radius, 1.0):
        return FLOOR
    if bounds[5] > 0.0 and z - half_height < -bounds[4]:
        return CEILING
    if z + half_height > -bounds[4] and (
        x - radius < bounds[0]
        or x + radius > bounds[1]
        or y - radius < bounds[2]
        or y + radius > bounds[3]
    ):
        return WALL
    for i in range(count):
        dx, dy, dz = x - center[i, 0], y - center[i, 1], z - center[i, 2]
        hx, hy, hz = half_size[i, 0], half_size[i, 1], half_size[i, 2]
        reach = hx + hy + radius
        if dx * dx + dy * dy > reach * reach:
            continue  # most obstacles are far away: no need for the shape
        gap_z = max(0.0, abs(dz) - half_height - (0.0 if shape[i] == _SPHERE else hz))
        if shape[i] == _SPHERE:
            # Nearest point of the disc's rim or face to the centre.
            gap = max(0.0, math.hypot(dx, dy) - radius)
            if gap * gap + gap_z * gap_z < hx * hx:
                return i
        elif gap_z == 0.0:
            if shape[i] == _BOX:
                # Offset from a box in its own axes; inside it is 0.
                c, s = math.cos(yaw[i]), math.sin(yaw[i])
                gx = max(0.0, abs(c * dx + s * dy) - hx)
                gy = max(0.0, abs(c * dy - s * dx) - hy)
                if gx * gx + gy * gy < radius * radius:
                    return i
            elif math.hypot(dx, dy) < hx + radius:
                return i
    return NOTHING
