"""Ground heights for kernels: at a position, and the maximum within a disc.

Between grid points the ground is the triangles of `arena.ground`.

Random numbers on a coarse lattice are joined by a uniform cubic B-spline (de Boor, A practical
guide to splines, 1978), with continuous slope and curvature. Values above the mean are squared, so
that hills begin without an edge. The height uses only sums and products of the drawn numbers, so a
seed is bit-identical on any machine.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from airl_mav.arena.geometry import (
    COLUMNS,
    ROWS,
    Bounds,
    Floats,
    Ground,
    Obstacles,
    PlacedMesh,
    Relief,
    Shape,
    Statics,
)
from airl_mav.arena.placement import Boxes
from airl_mav.core.kernels import kernel, large_kernel
from airl_mav.profiles.arena import Terrain

TRIES = 20
"""Maximum draws of the hills; redrawn while the level area removes the highest ones."""


def draw_ground(rng: np.random.Generator, terrain: Terrain, bounds: Bounds) -> Ground:
    """Draw the hills of an arena; arguments as in `check_terrain`, which must have passed."""
    least, greatest = terrain.relief_m
    relief_m = least + (greatest - least) * float(rng.random())
    length, width = bounds.north_max - bounds.north_min, bounds.east_max - bounds.east_min
    pitch = terrain.pitch_m(length, width)
    rows, columns = max(2, math.floor(length / pitch)), max(2, math.floor(width / pitch))
    step_n, step_e = length / rows, width / columns
    north: Floats = step_n * np.arange(rows + 1, dtype=np.float64)
    east: Floats = step_e * np.arange(columns + 1, dtype=np.float64)
    away = np.sqrt(
        (bounds.north_min + north[:, None]) ** 2 + (bounds.east_min + east[None, :]) ** 2
    )
    # A rising triangle spans its cell: keep the entire cell outside the level area.
    level = terrain.flat_m + math.sqrt(step_n * step_n + step_e * step_e)
    share = _smooth((away - level) / terrain.scale_m)
    hills = np.zeros_like(away)
    for _ in range(TRIES):
        noise = np.maximum(_noise(rng, north, east, 0.5 * terrain.scale_m), 0.0)
        hills = share * noise * noise
        if hills.max() > 0.25 * float((noise * noise).max()):
            break
    top = float(hills.max())
    heights = hills * (relief_m / top) if top > 0.0 else hills
    heights.setflags(write=False)
    return Ground(heights, bounds.north_min, bounds.east_min, step_n, step_e)


def stand_on(
    ground: Ground,
    static: Obstacles,
    standing: Boxes,
    statics: Statics | None,
    meshes: tuple[PlacedMesh, ...],
) -> tuple[Obstacles, tuple[PlacedMesh, ...]]:
    """Return obstacles and meshes moved from the floor onto the ground.

    Each obstacle stands on the lowest ground below its bounding box, so that none floats. Spheres
    keep their height above the start.
    """
    if statics is None:
        kinds = tuple(Shape(int(shape)).name.lower() for shape in static.shape)
        owner = np.arange(len(kinds))
    else:
        kinds, owner = statics.names, statics.of
    lifts = np.zeros(len(kinds))
    # Spheres keep their height.
    for k, kind in enumerate(kinds):
        if kind == "sphere":
            continue
        (north, east), half = standing.center[k].tolist(), standing.half[k].tolist()
        # The bounding circle covers every heading.
        radius = half[0] if kind == "cylinder" else math.hypot(*half)
        lifts[k] = ground.lowest_within(north, east, radius)
    center = static.center.copy()
    center[:, 2] -= lifts[owner]
    seen = tuple(replace(mesh, base_m=float(lifts[owner[mesh.first]])) for mesh in meshes)
    return replace(static, center=center), seen


def _smooth(x: Floats) -> Floats:
    """Return 0 below 0, 1 above 1, and a smooth step between."""
    x = np.clip(x, 0.0, 1.0)
    stepped: Floats = x * x * (3.0 - 2.0 * x)
    return stepped


def _noise(rng: np.random.Generator, north: Floats, east: Floats, lattice_m: float) -> Floats:
    """Draw smooth noise around 0 at positions north (r,) by east (c,) [m], both from 0 on."""
    n_index, n_weights = _spline(north / lattice_m + float(rng.random()))
    e_index, e_weights = _spline(east / lattice_m + float(rng.random()))
    # Four knots influence each position, so three more than the last index are needed.
    values = rng.random((int(n_index[-1]) + 4, int(e_index[-1]) + 4)) - 0.5
    # Tensor product: first along north, then along east.
    rows = np.zeros((len(north), values.shape[1]))
    for k in range(4):
        rows += n_weights[k][:, None] * values[n_index + k]
    noise = np.zeros((len(north), len(east)))
    for k in range(4):
        noise += e_weights[k] * rows[:, e_index + k]
    return noise


def _spline(at: Floats) -> tuple[NDArray[np.int64], tuple[Floats, Floats, Floats, Floats]]:
    """Return the first of the four knots (n,) of each position, and their four weights (n,)."""
    index = np.floor(at).astype(np.int64)
    t = at - index
    s = 1.0 - t
    weights = (
        s * s * s / 6.0,
        (3.0 * t * t * t - 6.0 * t * t + 4.0) / 6.0,
        (3.0 * s * s * s - 6.0 * s * s + 4.0) / 6.0,
        t * t * t / 6.0,
    )
    return index, weights


@kernel
def plane_at(relief: Relief, north: float, east: float) -> tuple[float, float, float]:
    """Return the ground's height [m] and slopes to the north and east; 0 beyond the grid."""
    heights, grid = relief.heights, relief.grid
    if len(heights) == 0:
        return 0.0, 0.0, 0.0
    rows, columns = int(grid[ROWS]), int(grid[COLUMNS])
    x, y = (north - grid[0]) / grid[2], (east - grid[1]) / grid[3]
    # Rounding may exceed the last row.
    if not (-1e-9 <= x <= rows - 1 + 1e-9 and -1e-9 <= y <= columns - 1 + 1e-9):
        return 0.0, 0.0, 0.0
    i, j = min(max(int(x), 0), rows - 2), min(max(int(y), 0), columns - 2)
    u, v = x - i, y - j
    at = i * columns + j
    # The diagonal runs from south-west to north-east; `u >= v` is its north-west side.
    low, high = heights[at], heights[at + columns + 1]
    if u >= v:
        side = heights[at + columns]
        up, across = side - low, high - side
    else:
        side = heights[at + 1]
        up, across = high - side, side - low
    return low + u * up + v * across, up / grid[2], across / grid[3]


@kernel
def sample(relief: Relief, north: Floats, east: Floats, out: Floats) -> None:
    """Write the heights (rows, columns) [m] at positions north (rows,) by east (columns,)."""
    for i in range(len(north)):
        for j in range(len(east)):
            out[i, j] = plane_at(relief, north[i], east[j])[0]


@large_kernel
def extreme_within(relief: Relief, north: float, east: float, radius: float, sign: float) -> float:
    """Return the maximum of `sign` times the ground's height within a disc [m].

    Exact: a triangle's extremes in a disc are at its corners, where its edges cross the disc's, or
    where it is steepest on the disc's edge. Minus infinity beyond the grid or without hills.
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
    # Only cells that the disc may touch.
    for i in range(max(int(first_row), 0), min(int(last_row), rows - 2) + 1):
        for j in range(max(int(first_column), 0), min(int(last_column), columns - 2) + 1):
            # From the disc's centre to the cell's south-west corner.
            s, w = i * step_n - x, j * step_e - y
            n, e = s + step_n, w + step_e
            at = i * columns + j
            h00, h01 = sign * heights[at], sign * heights[at + 1]
            h10, h11 = sign * heights[at + columns], sign * heights[at + columns + 1]
            # Diagonal, west and south sides. The next cell covers the north and east sides, except
            # at the border of the grid or the disc.
            best = _on_edge(s, w, h00, n, e, h11, radius, best)
            best = _on_edge(s, w, h00, n, w, h10, radius, best)
            best = _on_edge(s, w, h00, s, e, h01, radius, best)
            best = _on_edge(n, w, h10, n, e, h11, radius, best)
            best = _on_edge(s, e, h01, n, e, h11, radius, best)
            # The slopes of both triangles of the cell.
            up, across = (h10 - h00) / step_n, (h11 - h10) / step_e
            best = _in_middle(s, w, h00, up, across, step_n, step_e, True, radius, best)
            up, across = (h11 - h01) / step_n, (h01 - h00) / step_e
            best = _in_middle(s, w, h00, up, across, step_n, step_e, False, radius, best)
    return best


@kernel
def _on_edge(
    x0: float, y0: float, h0: float, x1: float, y1: float, h1: float, radius: float, best: float
) -> float:
    """Return the maximum height of an edge within a radius of the origin, or `best`."""
    dx, dy = x1 - x0, y1 - y0
    a, b = dx * dx + dy * dy, x0 * dx + y0 * dy
    # Intersection of the edge's line with the circle.
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
    """Return a triangle's maximum height on the disc's edge, or `best`.

    `s` and `w` are the distances [m] from the disc's centre to the south-west corner of its cell,
    of height `low` and sides `step_n`, `step_e`; `up` and `across` are the slopes north and east.
    """
    steep = math.sqrt(up * up + across * across)
    # A plane is highest on the circle in the direction of its slope.
    x, y = 0.0, 0.0
    if steep > 0.0:
        x, y = radius * up / steep, radius * across / steep
    u, v = (x - s) / step_n, (y - w) / step_e
    inside = (1.0 >= u >= v >= 0.0) if north_west else (1.0 >= v >= u >= 0.0)
    return max(best, low + (x - s) * up + (y - w) * across) if inside else best
