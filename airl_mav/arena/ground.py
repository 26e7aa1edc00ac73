"""Ground that rises above the floor: heights on a grid, and the triangles between them.

Each cell of the grid is two triangles, split from its south-west to its north-east corner. Cameras,
contacts, placement and maps all use this surface, and it alone: `plane_at` and `extreme_within`
say how high it is, `faces` lists its triangles.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from airl_mav.core.kernels import kernel, large_kernel

Floats = NDArray[np.float64]

GRID_SIZE = 8
"""Numbers that say where a grid lies; see `Relief.grid`."""

TOP, STEEPEST, ROWS, COLUMNS = 4, 5, 6, 7
"""Places of some of them."""


class Relief(NamedTuple):
    """The ground as kernels take it."""

    heights: Floats  # (r c,) of the grid's points above the floor, row by row, south to north [m]
    """(0,): there are no hills, the ground is the floor."""
    grid: Floats
    """(GRID_SIZE,) north and east of the first point [m], steps north and east [m], the greatest
    height [m], the greatest slope, r and c."""


def no_relief() -> Relief:
    """Return ground that is the floor."""
    return Relief(np.zeros(0), np.zeros(GRID_SIZE))


@dataclass(frozen=True, eq=False)
class Ground:
    """Ground of an arena with hills. Two of them are the same where they are one object."""

    heights: Floats  # (r, c) above the floor, not below 0 [m]; r and c are 2 at least
    south: float
    """North of the first row [m]."""
    west: float
    """East of the first column [m]."""
    step_north: float
    """From one row to the next [m]."""
    step_east: float
    """From one column to the next [m]."""

    @cached_property
    def relief(self) -> Relief:
        """The ground as kernels take it."""
        step_n, step_e = self.step_north, self.step_east
        rise_n, rise_e = (
            np.diff(self.heights, axis=0) / step_n,
            np.diff(self.heights, axis=1) / step_e,
        )
        # Of the triangle north-west of a cell's diagonal, and of that south-east of it.
        steepest = max(
            float(np.hypot(rise_n[:, :-1], rise_e[1:]).max()),
            float(np.hypot(rise_n[:, 1:], rise_e[:-1]).max()),
        )
        grid = [self.south, self.west, step_n, step_e, self.top_m, steepest, *self.heights.shape]
        return Relief(self.heights.ravel(), np.array(grid))

    @property
    def top_m(self) -> float:
        """The greatest height [m]."""
        return float(self.heights.max())

    @property
    def points(self) -> Floats:
        """All points of the grid (r c, 3) NED [m], row by row."""
        r, c = self.heights.shape
        north = self.south + self.step_north * np.arange(r)
        east = self.west + self.step_east * np.arange(c)
        n, e = np.meshgrid(north, east, indexing="ij")
        return np.stack([n.ravel(), e.ravel(), -self.heights.ravel()], axis=1)

    @cached_property
    def faces(self) -> NDArray[np.int32]:
        """Triangles (m, 3) of numbers of `points` that rise above the floor, upper side front.

        Seen from above their corners are clockwise, from north to east. The others are the floor's.
        """
        r, c = self.heights.shape
        first = (np.arange(r - 1)[:, None] * c + np.arange(c - 1)).ravel()
        north, east, both = first + c, first + 1, first + c + 1
        split = [np.stack([first, north, both], axis=1), np.stack([first, both, east], axis=1)]
        every = np.stack(split, axis=1).reshape(-1, 3).astype(np.int32)
        rising: NDArray[np.int32] = every[(self.heights.ravel()[every] > 0.0).any(axis=1)]
        return rising

    def height_at(self, north: float, east: float) -> float:
        """Return how high the ground is above the floor at a place [m]; 0 beyond the walls."""
        return float(plane_at(self.relief, north, east)[0])

    def heights_at(self, places: Floats) -> Floats:
        """Return the heights (n,) [m] below points (n, >= 2) NED [m]."""
        return np.array([self.height_at(float(each[0]), float(each[1])) for each in places])

    def coarser(self, most: int) -> Ground:
        """Return ground of so many cells at most, for pictures: its own where it has no more."""
        rows, columns = (count - 1 for count in self.heights.shape)
        if rows * columns <= most:
            return self
        share = math.sqrt(most / (rows * columns))
        fewer_n, fewer_e = max(1, math.floor(share * rows)), max(1, math.floor(share * columns))
        step_n, step_e = self.step_north * rows / fewer_n, self.step_east * columns / fewer_e
        north = self.south + step_n * np.arange(fewer_n + 1, dtype=np.float64)
        east = self.west + step_e * np.arange(fewer_e + 1, dtype=np.float64)
        return Ground(self.sampled(north, east), self.south, self.west, step_n, step_e)

    def lowest_within(self, north: float, east: float, radius: float) -> float:
        """Return the least height of the ground within a radius [m] of a place on the floor."""
        return -float(extreme_within(self.relief, north, east, radius, -1.0))

    def sampled(self, north: Floats, east: Floats) -> Floats:
        """Return the heights (rows, columns) [m] at places north (rows,) by east (columns,)."""
        heights = np.empty((len(north), len(east)))
        _sample(self.relief, north, east, heights)
        return heights


@kernel
def plane_at(relief: Relief, north: float, east: float) -> tuple[float, float, float]:
    """Return the height of the ground at a place [m], and its slopes to the north and to the east.

    Beyond the grid, or where there are no hills, all are 0.
    """
    heights, grid = relief.heights, relief.grid
    if len(heights) == 0:
        return 0.0, 0.0, 0.0
    rows, columns = int(grid[ROWS]), int(grid[COLUMNS])
    x, y = (north - grid[0]) / grid[2], (east - grid[1]) / grid[3]
    # What rounding puts beyond the last row is on it.
    if not (-1e-9 <= x <= rows - 1 + 1e-9 and -1e-9 <= y <= columns - 1 + 1e-9):
        return 0.0, 0.0, 0.0
    i, j = min(max(int(x), 0), rows - 2), min(max(int(y), 0), columns - 2)
    u, v = x - i, y - j
    at = i * columns + j
    low, high = heights[at], heights[at + columns + 1]
    if u >= v:
        side = heights[at + columns]
        up, across = side - low, high - side
    else:
        side = heights[at + 1]
        up, across = high - side, side - low
    return low + u * up + v * across, up / grid[2], across / grid[3]


@kernel
def _sample(relief: Relief, north: Floats, east: Floats, out: Floats) -> None:
    for i in range(len(north)):
        for j in range(len(east)):
            out[i, j] = plane_at(relief, north[i], east[j])[0]


@large_kernel
def extreme_within(relief: Relief, north: float, east: float, radius: float, sign: float) -> float:
    """Return the greatest of `sign` times the height of the ground within a disc [m].

    Exact: a triangle is flat, so its extremes in a disc are at its corners, where its edges cross
    the disc's, or where it is steepest on the disc's edge.

    Args:
        relief: The ground.
        north: Of the disc's middle [m].
        east: The same.
        radius: Of the disc [m].
        sign: 1: the highest point; -1: the lowest, its height negative.

    Returns:
        Minus infinity where the disc is beyond the grid, or there are no hills.
    """
    heights, grid = relief.heights, relief.grid
    best = -math.inf
    if len(heights) == 0:
        return best
    rows, columns = int(grid[ROWS]), int(grid[COLUMNS])
    step_n, step_e = grid[2], grid[3]
    x, y = north - grid[0], east - grid[1]
    first_row, last_row = math.floor((x - radius) / step_n), math.floor((x + radius) / step_n)
    first_column, last_column = math.floor((y - radius) / step_e), math.floor((y + radius) / step_e)
    for i in range(max(int(first_row), 0), min(int(last_row), rows - 2) + 1):
        for j in range(max(int(first_column), 0), min(int(last_column), columns - 2) + 1):
            # From the disc's middle to the cell's south-west corner.
            s, w = i * step_n - x, j * step_e - y
            n, e = s + step_n, w + step_e
            at = i * columns + j
            h00, h01 = sign * heights[at], sign * heights[at + 1]
            h10, h11 = sign * heights[at + columns], sign * heights[at + columns + 1]
            # The diagonal, the west and south sides; those to the north and east are the
            # neighbours', but where there are none, or the disc ends before them.
            best = _on_edge(s, w, h00, n, e, h11, radius, best)
            best = _on_edge(s, w, h00, n, w, h10, radius, best)
            best = _on_edge(s, w, h00, s, e, h01, radius, best)
            best = _on_edge(n, w, h10, n, e, h11, radius, best)
            best = _on_edge(s, e, h01, n, e, h11, radius, best)
            up, across = (h10 - h00) / step_n, (h11 - h10) / step_e
            best = _in_middle(s, w, h00, up, across, step_n, step_e, True, radius, best)
            up, across = (h11 - h01) / step_n, (h01 - h00) / step_e
            best = _in_middle(s, w, h00, up, across, step_n, step_e, False, radius, best)
    return best


@kernel
def _on_edge(
    x0: float, y0: float, h0: float, x1: float, y1: float, h1: float, radius: float, best: float
) -> float:
    """Return the greatest height of an edge's part within a radius of the origin, or `best`."""
    dx, dy = x1 - x0, y1 - y0
    a, b = dx * dx + dy * dy, x0 * dx + y0 * dy
    root = b * b - a * (x0 * x0 + y0 * y0 - radius * radius)
    if root < 0.0:
        return best
    root = math.sqrt(root)
    low, high = max((-b - root) / a, 0.0), min((root - b) / a, 1.0)
    if low > high:
        return best
    return max(best, max(h0 + low * (h1 - h0), h0 + high * (h1 - h0)))


@kernel
def _in_middle(
    s: float,
    w: float,
    low: float,
    up: float,
    across: float,
    step_n: float,
    step_e: float,
    north_west: bool,
    radius: float,
    best: float,
) -> float:
    """Return the height of a triangle where it is greatest on the disc's edge, or `best`.

    Args:
        s: From the disc's middle to the south-west corner of its cell [m].
        w: The same to the east.
        low: Height of that corner [m].
        up: Slope to the north.
        across: Slope to the east.
        step_n: Side of the cell to the north [m].
        step_e: Side to the east [m].
        north_west: Which of the cell's triangles it is.
        radius: Of the disc [m].
        best: Greatest height so far [m].
    """
    steep = math.sqrt(up * up + across * across)
    x, y = 0.0, 0.0
    if steep > 0.0:
        x, y = radius * up / steep, radius * across / steep
    u, v = (x - s) / step_n, (y - w) / step_e
    inside = (1.0 >= u >= v >= 0.0) if north_west else (1.0 >= v >= u >= 0.0)
    return max(best, low + (x - s) * up + (y - w) * across) if inside else best
