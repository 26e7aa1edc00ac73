"""Ground that rises above the floor: heights on a grid, and the triangles between them.

Each cell is two triangles, split from south-west to north-east, listed by `Ground.faces` and used
everywhere. The kernels of `arena.relief` are imported lazily, for programs without numba.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, NamedTuple

import numpy as np
from numpy.typing import NDArray

from airl_mav.core.fields import ArrayField

Floats = NDArray[np.float64]

GRID_SIZE = 8
"""Length of a grid description; see `Relief.grid`."""

TOP, STEEPEST, ROWS, COLUMNS = 4, 5, 6, 7


class Relief(NamedTuple):
    """Ground as arrays for kernels."""

    heights: Floats  # (r c,) of the grid's points above the floor, row by row, south to north [m]
    """(0,) = no hills, the ground is the floor."""
    grid: Floats
    """(GRID_SIZE,) north and east of the first point [m], steps north and east [m], maximum height
    [m], maximum slope, r and c."""


def no_relief() -> Relief:
    """Return flat ground at floor level."""
    return Relief(np.zeros(0), np.zeros(GRID_SIZE))


@dataclass(frozen=True, eq=False)
class Ground:
    """Ground of an arena with hills. Compared by identity."""

    heights: Annotated[Floats, ArrayField(np.float64)]
    """(r, c) heights above the floor, not below 0 [m]; r and c are at least 2."""
    south: float
    """North of the first row [m]."""
    west: float
    """East of the first column [m]."""
    step_north: float
    """Distance between rows [m]."""
    step_east: float
    """Distance between columns [m]."""

    @cached_property
    def relief(self) -> Relief:
        """Ground as arrays for kernels."""
        step_n, step_e = self.step_north, self.step_east
        rise_n = np.diff(self.heights, axis=0) / step_n
        rise_e = np.diff(self.heights, axis=1) / step_e
        # Slopes of the triangles north-west, then south-east, of each cell's diagonal.
        steepest = max(
            float(np.hypot(rise_n[:, :-1], rise_e[1:]).max()),
            float(np.hypot(rise_n[:, 1:], rise_e[:-1]).max()),
        )
        grid = [self.south, self.west, step_n, step_e, self.top_m, steepest, *self.heights.shape]
        return Relief(self.heights.flatten(), np.array(grid))

    @property
    def top_m(self) -> float:
        """Maximum height [m]."""
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
        """Triangles (m, 3) of `points` above the floor, clockwise from above, north to east."""
        r, c = self.heights.shape
        first = (np.arange(r - 1)[:, None] * c + np.arange(c - 1)).ravel()
        # Corner numbers of each cell, counted from its south-west corner.
        north, east, both = first + c, first + 1, first + c + 1
        split = [np.stack([first, north, both], axis=1), np.stack([first, both, east], axis=1)]
        every = np.stack(split, axis=1).reshape(-1, 3).astype(np.int32)
        # Level triangles at the floor belong to the floor.
        rising: NDArray[np.int32] = every[(self.heights.ravel()[every] > 0.0).any(axis=1)]
        return rising

    def height_at(self, north: float, east: float) -> float:
        """Return the height of the ground above the floor at a position [m]; 0 beyond the walls."""
        from airl_mav.arena.relief import plane_at

        return float(plane_at(self.relief, north, east)[0])

    def heights_at(self, places: Floats) -> Floats:
        """Return the heights (n,) [m] below points (n, >= 2) NED [m]."""
        return np.array([self.height_at(float(each[0]), float(each[1])) for each in places])

    def coarser(self, most: int) -> Ground:
        """Return the ground with at most `most` cells, for pictures."""
        rows, columns = (count - 1 for count in self.heights.shape)
        if rows * columns <= most:
            return self
        share = math.sqrt(most / (rows * columns))
        fewer_n, fewer_e = max(1, math.floor(share * rows)), max(1, math.floor(share * columns))
        # The total size stays; only the steps grow.
        step_n, step_e = self.step_north * rows / fewer_n, self.step_east * columns / fewer_e
        north = self.south + step_n * np.arange(fewer_n + 1, dtype=np.float64)
        east = self.west + step_e * np.arange(fewer_e + 1, dtype=np.float64)
        return Ground(self.sampled(north, east), self.south, self.west, step_n, step_e)

    def lowest_within(self, north: float, east: float, radius: float) -> float:
        """Return the ground's minimum height within a radius [m] of a position on the floor."""
        from airl_mav.arena.relief import extreme_within

        # The minimum is the negative maximum of the negative height.
        return -float(extreme_within(self.relief, north, east, radius, -1.0))

    def sampled(self, north: Floats, east: Floats) -> Floats:
        """Return the heights (rows, columns) [m] at positions north (rows,) by east (columns,)."""
        from airl_mav.arena.relief import sample

        heights = np.empty((len(north), len(east)))
        sample(self.relief, north, east, heights)
        return heights
