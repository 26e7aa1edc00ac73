"""The map of an episode: how far what stands is from each place, and how long the goal is from it.

Ground that rises to the height of the flight is in the way as an obstacle is.

The time to go is that of the best way, which keeps a distance where there is room: the eikonal
equation, solved by fast sweeping (Zhao, Math. Comp. 74(250), 2005).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from airl_mav.arena.geometry import Shape
from airl_mav.arena.ground import TOP
from airl_mav.arena.relief import extreme_within
from airl_mav.core.kernels import kernel
from airl_mav.envs.arenas import ArenaBatch, relief_of

CELLS = 125
"""Cells of the map along the longer side of an arena, at most."""

FINEST_M = 0.4
"""Least side of a cell [m]."""

COMFORT_M = 1.2
"""Gap to what stands from which on the way there is as good as any [m]."""

SLOWEST = 0.25
"""Share of the speed on the map where the vehicle just fits."""

BLOCKED = 0.02
"""The same where it does not: small, so that the way out is still downhill."""

OVER_M = 0.3
"""What is lower than the vehicle's lower side by this, or higher than its upper, is not in the way
[m]."""

_BOX = int(Shape.BOX)

FAR = 1e9
"""Farther than any place is [m], or longer than any way [s]."""


class Map(NamedTuple):
    """What an episode's planning needs of its arena; cells (rows north, columns east)."""

    north: float
    """Of the first cell's centre [m]."""
    east: float
    cell: float
    """Side of a cell [m]."""
    gap: NDArray[np.float64]
    """From a cell's centre to the nearest thing that stands, or hill [m]; negative inside."""
    to_go: NDArray[np.float64]
    """Time to the goal at 1 m/s [s]."""


class Body(NamedTuple):
    """The vehicle, as the planner flies it."""

    radius: float
    half_height: float
    altitude: float
    """Height that it holds [m]."""
    top_speed: float
    """Of the action set [m/s]."""
    arrived: float
    """How near the goal it has arrived [m]."""


def map_of(batch: ArenaBatch, i: int, body: Body) -> Map:
    """Return the map of arena i."""
    south, north, west, east = batch.bounds[i, :4]
    cell = max(FINEST_M, max(north - south, east - west) / CELLS)
    shape = math.ceil((north - south) / cell), math.ceil((east - west) / cell)
    gap, to_go = np.empty(shape), np.full(shape, FAR)
    first = south + 0.5 * cell, west + 0.5 * cell
    _fill_gaps(batch, i, body, first, cell, gap)
    most_m = body.altitude - body.half_height - OVER_M
    if batch.grid[i, TOP] > most_m:
        gap = np.minimum(gap, _to_hills(batch, i, most_m, first, cell, gap.shape))
    _fill_times(gap, body.radius, first, cell, (batch.goal[i, 0], batch.goal[i, 1]), to_go)
    return Map(first[0], first[1], cell, gap, to_go)


@kernel
def beside(
    batch: ArenaBatch, i: int, obstacle: int, body: Body, north: float, east: float
) -> float:
    """Return the distance [m] from a place at flight altitude to an obstacle, seen from above."""
    half_size = batch.half_size[i, obstacle]
    center = batch.center[i, obstacle]
    if abs(-body.altitude - center[2]) > half_size[2] + body.half_height + OVER_M:
        return FAR  # above or below
    dx, dy = north - center[0], east - center[1]
    if batch.shape[i, obstacle] != _BOX:
        gap: float = math.sqrt(dx * dx + dy * dy) - half_size[0]
        return gap
    c, s = math.cos(batch.yaw[i, obstacle]), math.sin(batch.yaw[i, obstacle])
    gx, gy = abs(c * dx + s * dy) - half_size[0], abs(c * dy - s * dx) - half_size[1]
    beside: float = math.sqrt(max(gx, 0.0) ** 2 + max(gy, 0.0) ** 2) + min(0.0, max(gx, gy))
    return beside


def _to_hills(
    batch: ArenaBatch,
    i: int,
    most_m: float,
    first: tuple[float, float],
    cell: float,
    shape: tuple[int, int],
) -> NDArray[np.float64]:
    """Return the distances (rows, columns) [m] to ground that is higher; negative in it.

    No more than a quarter of a cell too far, and little more than a cell too near: by the exact
    Euclidean distances between the centres of cells of both kinds.
    """
    high = np.empty(shape, np.bool_)
    _fill_high(batch, i, most_m, first, cell, high)
    if not high.any():
        return np.full(shape, FAR)
    to_high = scipy.ndimage.distance_transform_edt(~high, sampling=cell)
    to_low = scipy.ndimage.distance_transform_edt(high, sampling=cell)
    distance: NDArray[np.float64] = to_high - to_low + np.where(high, 0.5, -0.5) * cell
    return distance


@kernel
def _fill_high(
    batch: ArenaBatch,
    i: int,
    most_m: float,
    first: tuple[float, float],
    cell: float,
    high: NDArray[np.bool_],
) -> None:
    """Write in which cells (rows, columns), out to their corners, any ground is higher [m]."""
    relief, corner = relief_of(batch, i), cell / math.sqrt(2.0)
    for row in range(high.shape[0]):
        for column in range(high.shape[1]):
            north, east = first[0] + row * cell, first[1] + column * cell
            high[row, column] = extreme_within(relief, north, east, corner, 1.0) > most_m


@kernel
def _fill_gaps(
    batch: ArenaBatch,
    i: int,
    body: Body,
    first: tuple[float, float],
    cell: float,
    gap: NDArray[np.float64],
) -> None:
    bounds = batch.bounds[i]
    for row in range(gap.shape[0]):
        north = first[0] + row * cell
        for column in range(gap.shape[1]):
            east = first[1] + column * cell
            least = min(
                min(north - bounds[0], bounds[1] - north), min(east - bounds[2], bounds[3] - east)
            )
            for obstacle in range(batch.n_static[i]):
                least = min(least, beside(batch, i, obstacle, body, north, east))
            gap[row, column] = least


@kernel
def _fill_times(
    gap: NDArray[np.float64],
    radius: float,
    first: tuple[float, float],
    cell: float,
    goal: tuple[float, float],
    to_go: NDArray[np.float64],
) -> None:
    """Solve the eikonal equation from the goal outwards; `to_go` comes in as far as can be."""
    rows, columns = gap.shape
    slow = np.empty((rows, columns))
    for row in range(rows):
        for column in range(columns):
            room = gap[row, column] - radius
            share = SLOWEST + (1.0 - SLOWEST) * room / COMFORT_M
            slow[row, column] = 1.0 / (BLOCKED if room < 0.0 else min(1.0, share))
    goal_row = min(max(int((goal[0] - first[0]) / cell + 0.5), 0), rows - 1)
    goal_column = min(max(int((goal[1] - first[1]) / cell + 0.5), 0), columns - 1)
    to_go[goal_row, goal_column] = 0.0
    changed = 1.0
    sweep = 0
    while changed > 1e-2 and sweep < 200:
        if sweep % 4 == 0:
            changed = 0.0
        for k in range(rows):
            row = k if sweep % 4 < 2 else rows - 1 - k
            for m in range(columns):
                column = m if sweep % 2 == 0 else columns - 1 - m
                a = min(
                    to_go[row - 1, column] if row > 0 else FAR,
                    to_go[row + 1, column] if row < rows - 1 else FAR,
                )
                b = min(
                    to_go[row, column - 1] if column > 0 else FAR,
                    to_go[row, column + 1] if column < columns - 1 else FAR,
                )
                least = min(a, b)
                if least >= FAR:
                    continue
                f = cell * slow[row, column]
                found = least + f
                if abs(a - b) < f:
                    found = 0.5 * (a + b + math.sqrt(2.0 * f * f - (a - b) ** 2))
                if found < to_go[row, column]:
                    changed = max(changed, to_go[row, column] - found)
                    to_go[row, column] = found
        sweep += 1
        if sweep % 4 != 0:
            changed = 1.0


@kernel
def read_at(known: Map, field: NDArray[np.float64], north: float, east: float) -> float:
    """Return a field of the map at a place, between its cells."""
    rows, columns = field.shape
    x = min(max((north - known.north) / known.cell, 0.0), rows - 1.001)
    y = min(max((east - known.east) / known.cell, 0.0), columns - 1.001)
    row, column = int(x), int(y)
    u, v = x - row, y - column
    near = (1.0 - v) * field[row, column] + v * field[row, column + 1]
    far = (1.0 - v) * field[row + 1, column] + v * field[row + 1, column + 1]
    found: float = (1.0 - u) * near + u * far
    return found
