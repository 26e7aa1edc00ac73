"""Contacts of the vehicle's box with walls and obstacles: closed forms and separating axes.

All computations use the obstacle's axes, where it is a box, an upright cylinder or a sphere around
the origin. The contact normal is the axis of maximum separation, or of minimum penetration.
"""

from __future__ import annotations

import math

import numpy as np

from airl_mav.arena.geometry import Shape
from airl_mav.core.frames import Vector
from airl_mav.core.kernels import kernel, large_kernel
from airl_mav.vehicle.rotation import Quat, Vec, conjugate, multiply, rotate
from firmware_sim.plant.body import reach_along

ROW = 8
"""Number of values in a contact row: arm from the vehicle's centre NED [m], normal NED from the
other body to the vehicle, distance [m], and owner (`FLOOR_ID`, and so on)."""

MOST = 32
"""Maximum number of contacts."""


@kernel
def corner_of(k: int, half: Vector) -> Vec:
    """Return corner k, 0 to 7, of a box with half extents (3,) [m], in box axes."""
    return (
        half[0] if k & 1 else -half[0],
        half[1] if k & 2 else -half[1],
        half[2] if k & 4 else -half[2],
    )


@kernel
def note(rows: Vector, count: int, arm: Vec, normal: Vec, distance: float, owner: int) -> int:
    """Write a contact to row `count`, if there is room; return the new count."""
    if count == MOST:
        return count
    row = rows[count]
    row[0], row[1], row[2] = arm
    row[3], row[4], row[5] = normal
    row[6], row[7] = distance, owner
    return count + 1


_BOX = int(Shape.BOX)
_CYLINDER = int(Shape.CYLINDER)
_SPHERE = int(Shape.SPHERE)

_LEVEL_M = 0.01
"""Maximum distance of a touching corner above the deepest corner [m]."""

_BESIDE_M = 1e-3
"""Tolerance of the surface below a corner in contact [m]."""

_STEPS = 30
"""Alternating projections that locate a contact without corners."""

_PARALLEL = 1e-6
"""Minimum length of an axis. Shorter cross products of edges are skipped."""

_MOST_AXES = 23
"""Maximum number of separating axes: 15 for a box; 7, and 16 of corners, for a cylinder."""


@kernel
def _clamped(x: float, most: float) -> float:
    return min(max(x, -most), most)


@kernel
def nearest_point(kind: int, size: Vec, x: Vec) -> Vec:
    """Return the nearest point to x of an obstacle around the origin [m]; x if inside.

    `size` are the half extents as `Obstacles.half_size`; x is in the obstacle's axes.
    """
    if kind == _BOX:
        return _clamped(x[0], size[0]), _clamped(x[1], size[1]), _clamped(x[2], size[2])
    if kind == _CYLINDER:
        away = math.hypot(x[0], x[1])
        k = 1.0 if away <= size[0] else size[0] / away
        return k * x[0], k * x[1], _clamped(x[2], size[2])
    away = math.sqrt(x[0] * x[0] + x[1] * x[1] + x[2] * x[2])
    k = 1.0 if away <= size[0] else size[0] / away
    return k * x[0], k * x[1], k * x[2]


@kernel
def _support(kind: int, size: Vec, n: Vec) -> float:
    """Return the extent [m] of a box or cylinder from its centre along a unit vector."""
    if kind == _BOX:
        return abs(n[0]) * size[0] + abs(n[1]) * size[1] + abs(n[2]) * size[2]
    return math.hypot(n[0], n[1]) * size[0] + abs(n[2]) * size[2]


@kernel
def separation(kind: int, size: Vec, d: Vec, q: Quat, half: Vector) -> tuple[float, Vec]:
    """Return the vehicle's distance from a box or cylinder [m], and the unit axis to it.

    Negative distances are penetration depths. Positive distances are lower bounds, exact if faces
    or the side of a cylinder are nearest. The vehicle's centre d [m] and attitude q are in the
    obstacle's axes; sizes are half extents [m].
    """
    axes = np.zeros((_MOST_AXES, 3))
    # Axes of the obstacle's faces; a cylinder has only the vertical one.
    axes[0, 2] = axes[1, 0] = axes[2, 1] = 1.0
    count = 3 if kind == _BOX else 1
    edges = (
        rotate(q, (1.0, 0.0, 0.0)),
        rotate(q, (0.0, 1.0, 0.0)),
        rotate(q, (0.0, 0.0, 1.0)),
    )
    for i in range(3):
        e = edges[i]
        # Axes of the vehicle's faces, and their cross products with the obstacle's axes.
        axes[count, 0], axes[count, 1], axes[count, 2] = e
        axes[count + 1, 0], axes[count + 1, 1] = -e[1], e[0]
        count += 2
        if kind == _BOX:
            axes[count, 1], axes[count, 2] = -e[2], e[1]
            axes[count + 1, 0], axes[count + 1, 2] = e[2], -e[0]
            count += 2
    # A cylinder's round side has no finite set of axes: use its nearest points to the corners.
    if kind == _CYLINDER:
        for i in range(8):
            c = rotate(q, corner_of(i, half))
            x = (d[0] + c[0], d[1] + c[1], d[2] + c[2])
            o = nearest_point(kind, size, x)
            axes[count, 0], axes[count, 1] = x[0], x[1]
            axes[count + 1, 0], axes[count + 1, 1] = x[0] - o[0], x[1] - o[1]
            axes[count + 1, 2] = x[2] - o[2]
            count += 2
    best, n = -math.inf, (0.0, 0.0, -1.0)
    for j in range(count):
        x, y, z = axes[j, 0], axes[j, 1], axes[j, 2]
        length = math.sqrt(x * x + y * y + z * z)
        # Parallel edges give a zero axis.
        if length < _PARALLEL:
            continue
        # Point the axis from the obstacle to the vehicle.
        along = (x * d[0] + y * d[1] + z * d[2]) / length
        k = 1.0 / length if along >= 0.0 else -1.0 / length
        a = (k * x, k * y, k * z)
        apart = abs(along) - _support(kind, size, a) - reach_along(q, half, a)
        # The largest separation decides; if all are negative, it is the smallest penetration.
        if apart > best:
            best, n = apart, a
    return best, n


@kernel
def _meeting_point(
    kind: int, size: Vec, d: Vec, q: Quat, half: Vector, apart: float, n: Vec
) -> Vec:
    """Return the contact point with an obstacle, as an arm from the vehicle's centre [m].

    The vehicle is first moved along the normal until the bodies just touch.
    """
    # Move the vehicle along the normal until the bodies just touch.
    at = (d[0] - apart * n[0], d[1] - apart * n[1], d[2] - apart * n[2])
    back = conjugate(q)
    arm = (0.0, 0.0, 0.0)
    # Alternate: nearest point of the obstacle, then nearest point of the vehicle.
    for _ in range(_STEPS):
        o = nearest_point(kind, size, (at[0] + arm[0], at[1] + arm[1], at[2] + arm[2]))
        b = rotate(back, (o[0] - at[0], o[1] - at[1], o[2] - at[2]))
        arm = rotate(q, (_clamped(b[0], half[0]), _clamped(b[1], half[1]), _clamped(b[2], half[2])))
    return arm


@kernel
def _touch_sphere(radius: float, d: Vec, q: Quat, half: Vector) -> tuple[float, Vec, Vec]:
    """Return the distance to a sphere [m], the unit axis to the vehicle, and the arm [m]."""
    b = rotate(conjugate(q), (-d[0], -d[1], -d[2]))
    c = (_clamped(b[0], half[0]), _clamped(b[1], half[1]), _clamped(b[2], half[2]))
    off = (c[0] - b[0], c[1] - b[1], c[2] - b[2])
    away = math.sqrt(off[0] * off[0] + off[1] * off[1] + off[2] * off[2])
    if away > 0.0:
        n = rotate(q, (off[0] / away, off[1] / away, off[2] / away))
        return away - radius, n, rotate(q, c)
    # The centre is inside the vehicle: exit through the nearest face.
    room = (half[0] - abs(b[0]), half[1] - abs(b[1]), half[2] - abs(b[2]))
    axis = 0
    for i in range(1, 3):
        if room[i] < room[axis]:
            axis = i
    sign = -1.0 if b[axis] > 0.0 else 1.0
    out = (
        sign if axis == 0 else 0.0,
        sign if axis == 1 else 0.0,
        sign if axis == 2 else 0.0,
    )
    face = (b[0] - out[0] * room[0], b[1] - out[1] * room[1], b[2] - out[2] * room[2])
    return -room[axis] - radius, rotate(q, out), rotate(q, face)


@large_kernel
def touch_obstacle(
    kind: int,
    size: Vec,
    center: Vec,
    yaw: float,
    p: Vec,
    q: Quat,
    half: Vector,
    close: float,
    rows: Vector,
    count: int,
    owner: int,
) -> int:
    """Find the contacts with a wall or an obstacle; return the new number of contacts.

    As in Bullet, box contacts require overlap; cylinder and sphere contacts start earlier, at
    `close` [m]. The obstacle's centre is NED [m], its sizes are half extents [m], `yaw` is the
    heading of a box's first axis [rad]; the vehicle is given as in `touch_floor`, `owner` is the id
    of the contacts.
    """
    # Work in the obstacle's axes: only yaw turns it.
    turn = (math.cos(0.5 * yaw), 0.0, 0.0, math.sin(0.5 * yaw))
    d = rotate(conjugate(turn), (p[0] - center[0], p[1] - center[1], p[2] - center[2]))
    q = multiply(conjugate(turn), q)
    if kind == _SPHERE:
        apart, n, arm = _touch_sphere(size[0], d, q, half)
        if apart < close:
            count = note(rows, count, rotate(turn, arm), rotate(turn, n), apart, owner)
        return count
    apart, n = separation(kind, size, d, q, half)
    if apart >= (0.0 if kind == _BOX else close):
        return count
    # Collect the corners that are about as deep as the deepest one.
    normal, face, before = rotate(turn, n), _support(kind, size, n), count
    for k in range(8):
        arm = rotate(q, corner_of(k, half))
        x = (d[0] + arm[0], d[1] + arm[1], d[2] + arm[2])
        off = n[0] * x[0] + n[1] * x[1] + n[2] * x[2] - face
        if off > apart + _LEVEL_M or off > close:
            continue
        # The foot of the corner must lie on the obstacle's surface, not beside it.
        under = (x[0] - off * n[0], x[1] - off * n[1], x[2] - off * n[2])
        o = nearest_point(kind, size, under)
        beside = (under[0] - o[0]) ** 2 + (under[1] - o[1]) ** 2 + (under[2] - o[2]) ** 2
        if beside < _BESIDE_M * _BESIDE_M:
            count = note(rows, count, rotate(turn, arm), normal, off, owner)
    # No corner touches: an edge or a face meets an edge or point of the obstacle.
    if count == before:
        arm = _meeting_point(kind, size, d, q, half, apart, n)
        count = note(rows, count, rotate(turn, arm), normal, apart, owner)
    return count
