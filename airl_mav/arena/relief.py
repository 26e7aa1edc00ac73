"""How high the ground is, for kernels: at a place, and at most within a disc.

Between the points of its grid it is the triangles that `arena.ground` defines.
"""

from __future__ import annotations

import math

from airl_mav.arena.ground import COLUMNS, ROWS, Floats, Relief
from airl_mav.core.kernels import kernel, large_kernel


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
def sample(relief: Relief, north: Floats, east: Floats, out: Floats) -> None:
    """Write the heights (rows, columns) [m] at places north (rows,) by east (columns,)."""
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
