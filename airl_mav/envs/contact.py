"""Does the vehicle touch something? Closed forms, for one vehicle in one arena.

The vehicle is a level disc: as wide as its collision box, that tall. pybullet's plant has the box
itself, tilted as it flies; the two differ by a few centimetres at a box's corners.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from airl_mav.arena.geometry import Shape
from airl_mav.arena.ground import STEEPEST, Relief
from airl_mav.arena.relief import extreme_within
from airl_mav.core.kernels import kernel
from airl_mav.vehicle.rotation import Vec

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
    """Return a distance [m] that the vehicle may move without touching anything; below 0 = unsure.

    A lower bound: obstacles count as upright cylinders around their bounding boxes. The ground is
    nowhere steeper than its steepest triangle: what lies a height above it is so far from it, less
    what the cosine of that slope takes. Arguments as of `touches`.
    """
    x, y, z = position
    low = z + half_height
    beside = min(min(x - bounds[0], bounds[1] - x), min(y - bounds[2], bounds[3] - y)) - radius
    room: float = min(-low, max(beside, -bounds[4] - low))
    if relief is not None and len(relief.heights) > 0:
        # From beyond a wall the nearest ground is that at its foot.
        north, east = min(max(x, bounds[0]), bounds[1]), min(max(y, bounds[2]), bounds[3])
        above = -low - extreme_within(relief, north, east, radius, 1.0)
        steepest = relief.grid[STEEPEST]
        room = min(room, above / math.sqrt(1.0 + steepest * steepest))
    if bounds[5] > 0.0:
        room = min(room, bounds[4] + z - half_height)
    for i in range(count):
        dx, dy, dz = x - center[i, 0], y - center[i, 1], z - center[i, 2]
        hx, hy, hz = half_size[i, 0], half_size[i, 1], half_size[i, 2]
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
        radius: Of the vehicle's disc [m].
        half_height: Of the vehicle's disc [m].
        bounds: As Bounds.as_array.
        count: Number of obstacles.
        shape: (m,).
        center: (m, 3) NED [m].
        half_size: (m, 3) [m].
        yaw: (m,) [rad].
        relief: The ground, which is the floor where it rises; None: it does nowhere.
    """
    x, y, z = position
    if z + half_height > 0.0:
        return FLOOR
    # Beyond the walls, and without hills, it is minus infinity: there the floor is level.
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
            continue  # far off, which nearly all are: no need for the shape
        gap_z = max(0.0, abs(dz) - half_height - (0.0 if shape[i] == _SPHERE else hz))
        if shape[i] == _SPHERE:
            # The nearest point of the disc's rim or face to the centre.
            gap = max(0.0, math.hypot(dx, dy) - radius)
            if gap * gap + gap_z * gap_z < hx * hx:
                return i
        elif gap_z == 0.0:
            if shape[i] == _BOX:
                c, s = math.cos(yaw[i]), math.sin(yaw[i])
                gx = max(0.0, abs(c * dx + s * dy) - hx)
                gy = max(0.0, abs(c * dy - s * dx) - hy)
                if gx * gx + gy * gy < radius * radius:
                    return i
            elif math.hypot(dx, dy) < hx + radius:
                return i
    return NOTHING
