"""Contacts of the vehicle's box with the floor, kept from tick to tick as Bullet keeps them.

Bullet finds one point at a time, the deepest corner, and remembers up to four of them, in the
vehicle's axes (btConvexPlaneCollisionAlgorithm, btPersistentManifold). How a vehicle stands, tips
and lifts off follows from that order, so it is the same here.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from airl_mav.core.frames import Vector
from airl_mav.core.kernels import kernel, large_kernel
from airl_mav.vehicle.rotation import Quat, Vec, conjugate, rotate
from firmware_sim.plant.contacts.box import note

KEPT = 4
"""Points that are remembered (MANIFOLD_CACHE_SIZE)."""

FLOOR_ID = 0
"""Whose contacts these are."""

UP: Vec = (0.0, 0.0, -1.0)


@kernel
def deepest_corner(q: Quat, half: Vector) -> Vec:
    """Return the corner, in the vehicle's axes, that is deepest at attitude q.

    Of two as deep it is the one that Bullet takes: forward, left, up.
    """
    down = rotate(conjugate(q), (0.0, 0.0, 1.0))
    return (
        half[0] if down[0] >= 0.0 else -half[0],
        half[1] if down[1] > 0.0 else -half[1],
        half[2] if down[2] > 0.0 else -half[2],
    )


@kernel
def _spread(a: Vector, b: Vector, c: Vector, d: Vector) -> float:
    """Return the square of the area that is spanned by a - b and c - d."""
    ax, ay, az = a[0] - b[0], a[1] - b[1], a[2] - b[2]
    bx, by, bz = c[0] - d[0], c[1] - d[1], c[2] - d[2]
    x, y, z = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    square: float = x * x + y * y + z * z
    return square


@kernel
def _least_needed(new: Vector, deep: float, kept: Vector) -> int:
    """Return which of four points a new one replaces: the deepest stays, and the area is large."""
    stays, deepest = -1, deep
    for i in range(KEPT):
        if kept[i, 6] < deepest:
            stays, deepest = i, kept[i, 6]
    best, widest = 0, -1.0
    for i in range(KEPT):
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
    """Find the contacts with the floor.

    Args:
        p: Of the vehicle's centre, NED [m].
        q: Attitude body -> NED.
        half: (3,) half extents of its box [m].
        close: Points further off are none [m].
        kept: (4, 7) the points from before: in the vehicle's axes, on the floor NED, the distance
            [m]; updated.
        many: (1,) how many of them there are; updated.
        rows: (MOST, ROW) contacts; written from `count` on.
        count: How many there are already.

    Returns:
        How many there are now.
    """
    corner = deepest_corner(q, half)
    turned = rotate(q, corner)
    height = -(p[2] + turned[2])
    n = many[0]
    if height < close:
        new = np.array(
            (corner[0], corner[1], corner[2], p[0] + turned[0], p[1] + turned[1], 0.0, height)
        )
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
        kept[at] = new
    for i in range(n):
        arm = rotate(q, (kept[i, 0], kept[i, 1], kept[i, 2]))
        kept[i, 6] = -(p[2] + arm[2] - kept[i, 5])
    for i in range(n - 1, -1, -1):
        arm = rotate(q, (kept[i, 0], kept[i, 1], kept[i, 2]))
        x, y = kept[i, 3] - p[0] - arm[0], kept[i, 4] - p[1] - arm[1]
        if kept[i, 6] > close or x * x + y * y > close * close:
            n -= 1
            kept[i] = kept[n]
    many[0] = n
    for i in range(n):
        arm = rotate(q, (kept[i, 0], kept[i, 1], kept[i, 2]))
        count = note(rows, count, arm, UP, kept[i, 6], FLOOR_ID)
    return count
