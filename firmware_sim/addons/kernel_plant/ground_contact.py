"""Contacts of the vehicle's box with the floor and with hills (triangles above the floor).

Floor contacts are stored between ticks as in Bullet, which finds one point at a time, the deepest
corner, and stores up to four, in vehicle axes (btConvexPlaneCollisionAlgorithm,
btPersistentManifold). This order determines how a vehicle stands, tips and lifts off, so it is the
same here.

On hills, the box's corners touch the triangle below them, and ground vertices touch the box face in
front of them. Where a box edge crosses a ground ridge from above, the contact normal is
perpendicular to both. Triangles at floor height belong to the floor.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from airl_mav.arena.geometry import COLUMNS, ROWS, TOP, Relief
from airl_mav.arena.relief import extreme_within, plane_at
from airl_mav.core.frames import Vector
from airl_mav.core.kernels import kernel, large_kernel
from airl_mav.vehicle.rotation import Quat, Vec, conjugate, rotate
from firmware_sim.addons.kernel_plant.convex import corner_of, note

KEPT = 4
"""Maximum number of stored points (MANIFOLD_CACHE_SIZE)."""

FLOOR_ID = 0
"""Owner id of floor and hill contacts."""

UP: Vec = (0.0, 0.0, -1.0)


@kernel
def deepest_corner(q: Quat, half: Vector) -> Vec:
    """Return the deepest corner at attitude q, in vehicle axes.

    Of equally deep corners, it selects Bullet's choice: forward, left, up.
    """
    down = rotate(conjugate(q), (0.0, 0.0, 1.0))
    return (
        half[0] if down[0] >= 0.0 else -half[0],
        half[1] if down[1] > 0.0 else -half[1],
        half[2] if down[2] > 0.0 else -half[2],
    )


@kernel
def _spread(a: Vector | tuple[float, ...], b: Vector, c: Vector, d: Vector) -> float:
    """Return the squared area of the parallelogram of a - b and c - d."""
    ax, ay, az = a[0] - b[0], a[1] - b[1], a[2] - b[2]
    bx, by, bz = c[0] - d[0], c[1] - d[1], c[2] - d[2]
    x, y, z = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    square: float = x * x + y * y + z * z
    return square


@kernel
def _least_needed(new: Vector | tuple[float, ...], deep: float, kept: Vector) -> int:
    """Return the index of the point to replace: keeps the deepest, and maximizes the area."""
    # The deepest point always stays (Bullet: btPersistentManifold::sortCachedPoints).
    stays, deepest = -1, deep
    for i in range(KEPT):
        if kept[i, 6] < deepest:
            stays, deepest = i, kept[i, 6]
    best, widest = 0, -1.0
    for i in range(KEPT):
        # The other three points, for the area with the new one.
        one = 1 if i == 0 else 0
        two = 2 if i <= 1 else 1
        three = 2 if i == 3 else 3
        area = 0.0 if i == stays else _spread(new, kept[one], kept[three], kept[two])
        if area > widest:
            best, widest = i, area
    return best


@large_kernel
def touch_floor(
    p: Vec,
    q: Quat,
    half: Vector,
    close: float,
    kept: Vector,
    many: NDArray[np.int64],
    rows: Vector,
    count: int,
) -> int:
    """Find the contacts with the floor; return the new number of contacts in `rows` (MOST, ROW).

    Position p is NED [m], attitude q body -> NED, `half` (3,) half extents of the box [m], `close`
    the maximum distance of a contact [m]. Updates the stored points `kept` (4, 7): in vehicle axes,
    on the floor NED, distance [m]; and their number `many` (1,).
    """
    # Bullet finds one new point per tick: the deepest corner.
    corner = deepest_corner(q, half)
    turned = rotate(q, corner)
    height = -(p[2] + turned[2])
    n = many[0]
    if height < close:
        new = corner[0], corner[1], corner[2], p[0] + turned[0], p[1] + turned[1], 0.0, height
        # A stored point within `close` is the same point, now updated.
        at, nearest = -1, close * close
        for i in range(n):
            x, y, z = kept[i, 0] - new[0], kept[i, 1] - new[1], kept[i, 2] - new[2]
            apart = x * x + y * y + z * z
            if apart < nearest:
                at, nearest = i, apart
        if at < 0:
            if n < KEPT:
                at = n
                n += 1
            else:
                at = _least_needed(new, height, kept)
        for k in range(7):
            kept[at, k] = new[k]
    # Update the distances of stored points to the motion since.
    for i in range(n):
        arm = rotate(q, (kept[i, 0], kept[i, 1], kept[i, 2]))
        kept[i, 6] = -(p[2] + arm[2] - kept[i, 5])
    # Drop points that have lifted off or slid away; backwards, since the last one fills the gap.
    for i in range(n - 1, -1, -1):
        arm = rotate(q, (kept[i, 0], kept[i, 1], kept[i, 2]))
        x, y = kept[i, 3] - p[0] - arm[0], kept[i, 4] - p[1] - arm[1]
        if kept[i, 6] > close or x * x + y * y > close * close:
            n -= 1
            for k in range(7):
                kept[i, k] = kept[n, k]
    many[0] = n
    for i in range(n):
        arm = rotate(q, (kept[i, 0], kept[i, 1], kept[i, 2]))
        count = note(rows, count, arm, UP, kept[i, 6], FLOOR_ID)
    return count


_BESIDE_M = 1e-3
"""Distance from a ground edge at which heights are compared to detect a ridge [m]."""

_RIDGE = 1e-5
"""Minimum height of a ridge above its sides, on average, as a fraction of that distance."""

_PARALLEL = 1e-3
"""Minimum cross product of two unit edges in contact. Parallel edges touch at corners or points."""


@kernel
def near_ground(relief: Relief, p: Vec, radius: float, close: float) -> bool:
    """Return True if a sphere around the vehicle may be close to hills."""
    # First the highest hill of all, then the hills below the vehicle.
    if len(relief.heights) == 0 or -p[2] - radius - close > relief.grid[TOP]:
        return False
    return bool(-p[2] - radius < extreme_within(relief, p[0], p[1], radius + close, 1.0) + close)


@large_kernel
def touch_ground(
    p: Vec, q: Quat, half: Vector, close: float, relief: Relief, rows: Vector, count: int
) -> int:
    """Find the contacts with hills; arguments and result as `touch_floor`."""
    for k in range(8):
        arm = rotate(q, corner_of(k, half))
        height, up, across = plane_at(relief, p[0] + arm[0], p[1] + arm[1])
        # Level at height 0 is the floor, which has its own contacts.
        if height == 0.0 and up == 0.0 and across == 0.0:
            continue
        # Height above a slope is measured along its normal.
        per = 1.0 / math.sqrt(1.0 + up * up + across * across)
        apart = per * (-(p[2] + arm[2]) - height)
        if apart < close:
            normal = (-per * up, -per * across, -per)
            count = note(rows, count, arm, normal, apart, FLOOR_ID)
    count = _touch_points(p, q, half, close, relief, rows, count)
    # Every edge of the box once: corners that differ in one axis.
    for k in range(8):
        for axis in range(3):
            other = k ^ (1 << axis)
            if k < other:
                a, b = rotate(q, corner_of(k, half)), rotate(q, corner_of(other, half))
                # Ground edges have three directions: rows, columns, diagonals of the cells.
                for family in range(3):
                    count = _touch_ridges(p, a, b, family, close, relief, rows, count)
    return count


@kernel
def _touch_points(
    p: Vec, q: Quat, half: Vector, close: float, relief: Relief, rows: Vector, count: int
) -> int:
    """Find ground vertices inside the box, or just outside a face.

    The contact is with the downward face that requires the shortest displacement.
    """
    heights, grid = relief.heights, relief.grid
    n_rows, n_columns = int(grid[ROWS]), int(grid[COLUMNS])
    radius = math.sqrt(half[0] ** 2 + half[1] ** 2 + half[2] ** 2)
    x, y = p[0] - grid[0], p[1] - grid[1]
    back = conjugate(q)
    down = rotate(back, (0.0, 0.0, 1.0))
    # Vertices of the grid within the vehicle's radius.
    first_row = max(math.ceil((x - radius) / grid[2]), 0)
    last_row = min(math.floor((x + radius) / grid[2]), n_rows - 1)
    first_column = max(math.ceil((y - radius) / grid[3]), 0)
    last_column = min(math.floor((y + radius) / grid[3]), n_columns - 1)
    for i in range(first_row, last_row + 1):
        for j in range(first_column, last_column + 1):
            height = heights[i * n_columns + j]
            # Vertices at height 0 belong to the floor.
            if height == 0.0:
                continue
            arm = (i * grid[2] - x, j * grid[3] - y, -height - p[2])
            b = rotate(back, arm)
            best, face = math.inf, -1
            for axis in range(3):
                side = 1.0 if down[axis] >= 0.0 else -1.0
                depth = half[axis] - side * b[axis]
                # Beyond the opposite face: the box does not contain the vertex.
                if side * b[axis] < -half[axis]:
                    best, face = math.inf, -1
                    break
                # Only faces within 60 degrees of straight down qualify.
                if abs(down[axis]) > 0.5 and depth < best:
                    best, face = depth, axis
            if face < 0 or best < -close:
                continue
            # The vertex must lie within the face's edges.
            inside = True
            for axis in range(3):
                if axis != face and abs(b[axis]) > half[axis]:
                    inside = False
            if inside:
                side = -1.0 if down[face] >= 0.0 else 1.0
                out = (
                    side if face == 0 else 0.0,
                    side if face == 1 else 0.0,
                    side if face == 2 else 0.0,
                )
                count = note(rows, count, arm, rotate(q, out), -best, FLOOR_ID)
    return count


@kernel
def _touch_ridges(
    p: Vec, a: Vec, b: Vec, family: int, close: float, relief: Relief, rows: Vector, count: int
) -> int:
    """Find the points where a box edge from a to b, relative to p [m], crosses ground ridges.

    `family` of ground edges: 0 from west to east, 1 from south to north, 2 diagonals.
    """
    grid = relief.grid
    d = (b[0] - a[0], b[1] - a[1], b[2] - a[2])
    # In cells; ground edges are at whole numbers.
    x, y = (p[0] + a[0] - grid[0]) / grid[2], (p[1] + a[1] - grid[1]) / grid[3]
    dx, dy = d[0] / grid[2], d[1] / grid[3]
    at, step = x - y, dx - dy
    beside, along = (grid[2], -grid[3]), (grid[2], grid[3])
    if family == 0:
        at, step, beside, along = x, dx, (grid[2], 0.0), (0.0, grid[3])
    elif family == 1:
        at, step, beside, along = y, dy, (0.0, grid[3]), (grid[2], 0.0)
    # Parallel to this family: no crossing.
    if abs(step) < 1e-12:
        return count
    for line in range(math.ceil(min(at, at + step)), math.floor(max(at, at + step)) + 1):
        share = (line - at) / step
        arm = (a[0] + share * d[0], a[1] + share * d[1], a[2] + share * d[2])
        n, e = p[0] + arm[0], p[1] + arm[1]
        height = plane_at(relief, n, e)[0]
        gap = -(p[2] + arm[2]) - height
        if height == 0.0 or gap >= close:
            continue
        # Compare heights on both sides: only convex edges, ridges, can be touched.
        k = _BESIDE_M / math.sqrt(beside[0] ** 2 + beside[1] ** 2)
        one = plane_at(relief, n + k * beside[0], e + k * beside[1])[0]
        other = plane_at(relief, n - k * beside[0], e - k * beside[1])[0]
        if height - 0.5 * (one + other) < _RIDGE * _BESIDE_M:
            continue
        # Slope along the ridge gives its direction in space.
        k = _BESIDE_M / math.sqrt(along[0] ** 2 + along[1] ** 2)
        rise = plane_at(relief, n + k * along[0], e + k * along[1])[0]
        rise -= plane_at(relief, n - k * along[0], e - k * along[1])[0]
        ridge = (2.0 * k * along[0], 2.0 * k * along[1], -rise)
        cx = d[1] * ridge[2] - d[2] * ridge[1]
        cy = d[2] * ridge[0] - d[0] * ridge[2]
        cz = d[0] * ridge[1] - d[1] * ridge[0]
        size = math.sqrt(cx * cx + cy * cy + cz * cz)
        lengths = math.sqrt(d[0] ** 2 + d[1] ** 2 + d[2] ** 2)
        lengths *= math.sqrt(ridge[0] ** 2 + ridge[1] ** 2 + ridge[2] ** 2)
        # Parallel edges, and nearly horizontal normals, belong to other contacts.
        if size < _PARALLEL * lengths or abs(cz) < 0.1 * size:
            continue
        # The normal points up.
        per = (-1.0 if cz > 0.0 else 1.0) / size
        normal = (per * cx, per * cy, per * cz)
        # The gap is vertical: project it on the normal.
        count = note(rows, count, arm, normal, -normal[2] * gap, FLOOR_ID)
    return count
