"""Which of an image's points the sun does not reach.

Drawn as the bodies are: an obstacle's shadow touches only the pixels of the rectangle that its
shadow volume (the body, drawn along the light down to the floor) projects to. A convex body's own
dark side is where it faces away from the sun, so no body is tested against itself, and nothing
needs an offset against false shadows.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from airl_mav.camera.primitives import BOX, CYLINDER, OBSTACLE, Ids, Line, Lines, turned
from airl_mav.camera.projection import Bent, Pose, Rectangle, View, dot, ray_of
from airl_mav.camera.shading import F32, ONE, ZERO, Plane, Rays, Vec32
from airl_mav.core.kernels import borrowing_kernel, kernel
from airl_mav.vehicle.rotation import Vec

_NEAR_M: Final = 0.01
"""What of a shadow volume is nearer than this to the image plane is cut off [m]."""

_STEP_M: Final = F32(1e-3)
"""A point less than this before a wall, towards the sun, lies on it [m]."""

VECTOR: Final = 16
"""Pixels that are worked on together."""

CORNERS: Final = 16
"""Of a shadow volume: those of the box around a body, then where their shadows fall."""


@kernel
def sized(value: float) -> float:
    """Return a component of a direction, kept off 0 so that it can be divided by."""
    least = 1e-6
    return max(value, least) if value >= 0.0 else min(value, -least)


@kernel
def widened(left: int, end: int, low: int, high: int) -> tuple[int, int]:
    """Return the pixels left..end widened within low..high to whole vectors.

    The rest of a vectorized loop runs one by one. Vectors begin where the pixels do, since few
    pixels across a boundary would need two.
    """
    whole = end - left + (left - end) % VECTOR
    first = max(min(left, high - whole), low)
    return first, min(first + whole, high)


@borrowing_kernel
def shade_by_walls(
    lit: Plane,
    clear: Plane,
    far: Plane,
    rays: Rays,
    camera: Vec,
    bounds: NDArray[np.float64],
    to_sun: Vec,
    extinction: float,
    through: np.float32,
) -> None:
    """Write the sunlight `lit` (n,) that passes the walls, and the fog's transmission `clear`.

    `far` (n,) is depth [m], 0: no surface; `extinction` is that of fog [1/m], `through` the
    transmission of the walls, 0 but for glass.
    """
    north, east, up = sized(to_sun[0]), sized(to_sun[1]), F32(-to_sun[2])
    # From the camera to the walls that the sunlight comes over.
    edge_n = F32((bounds[1] if north > 0.0 else bounds[0]) - camera[0])
    edge_e = F32((bounds[3] if east > 0.0 else bounds[2]) - camera[1])
    per_n, per_e = F32(1.0 / north), F32(1.0 / east)
    above, height = F32(-camera[2]), F32(bounds[4])
    for u in range(len(far)):
        t = far[u]
        n, e, d = t * rays.north[u], t * rays.east[u], t * rays.down[u]
        run = min((edge_n - n) * per_n, (edge_e - e) * per_e)
        over = above - d + run * up
        lit[u] = through if (run > _STEP_M and over < height) else ONE
        clear[u] = ONE
    if extinction > 0.0:
        for u in range(len(far)):
            t = far[u]
            n, e, d = t * rays.north[u], t * rays.east[u], t * rays.down[u]
            clear[u] = math.exp(-extinction * math.sqrt(n * n + e * e + d * d))


@kernel
def start32(axes: Pose, ahead: float, y: float) -> Vec32:
    """Return a line's ray at x = 0."""
    f, d = axes.forward, axes.across
    return (
        F32(ahead * f[0] + y * d[0]),
        F32(ahead * f[1] + y * d[1]),
        F32(ahead * f[2] + y * d[2]),
    )


@kernel
def along32(pose: Pose) -> Vec32:
    """Return the axis along a line."""
    r = pose.along
    return F32(r[0]), F32(r[1]), F32(r[2])


@borrowing_kernel
def ray32(
    pose: Pose, along: Vec32, bent: Bent | None, v: int, u: int, start: Vec32, x: np.float32
) -> Vec32:
    """Return the ray of pixel u on line v as `projection.ray_of` does."""
    if bent is None:
        return start[0] + x * along[0], start[1] + x * along[1], start[2] + x * along[2]
    n, e, d = ray_of(pose, bent, v, u, (0.0, 0.0, 0.0), 0.0)
    return F32(n), F32(e), F32(d)


@borrowing_kernel
def shade_by_obstacle(
    lit: Plane,
    far: Plane,
    ids: Ids,
    corners: NDArray[np.float64],
    number: int,
    lines: Lines,
    xs: Line,
    bent: Bent | None,
    view: View,
    world: Pose,
    camera: Vec,
    shape: int,
    half: Vec,
    yaw: float,
    to_sun: Vec,
    through: np.float32,
) -> None:
    """Put the points that an obstacle hides from the sun into shadow: `lit` (n, m) times `through`.

    `far` (n, m) is depth [m], `ids` what is seen, `corners` (CORNERS, 3) a buffer, `number`,
    `shape`, `half` [m] and `yaw` [rad] are the obstacle's, `world` holds the camera's axes and its
    centre from the camera, `to_sun` (3,) is a unit vector NED; the rest as of
    `raycast.draw_bodies`.
    """
    level = math.sqrt(to_sun[0] * to_sun[0] + to_sun[1] * to_sun[1])
    cos, sin = 1.0, 0.0
    if shape == BOX:
        cos, sin = math.cos(yaw), math.sin(yaw)
    elif level > 0.0:
        cos, sin = to_sun[0] / level, to_sun[1] / level
    pose = turned(world, cos, sin)
    sun = (cos * to_sun[0] + sin * to_sun[1], cos * to_sun[1] - sin * to_sun[0], to_sun[2])
    top, bottom, left, end = 0, len(lines), 0, len(xs)
    if bent is None and not view.cylindrical:
        floor = -(world.center[2] + camera[2])
        top, bottom, left, end = shadow_rectangle(
            corners, len(lines), len(xs), view, pose, half, sun, floor
        )
    if top >= bottom or left >= end:
        return
    left, end = widened(left, end, 0, len(xs))
    f, c, along = pose, pose.center, along32(pose)
    c0, c1, c2 = F32(c[0]), F32(c[1]), F32(c[2])
    s0, s1, s2 = F32(sun[0]), F32(sun[1]), F32(sun[2])
    i0, i1, i2 = F32(1.0 / sized(sun[0])), F32(1.0 / sized(sun[1])), F32(1.0 / sized(sun[2]))
    w0, w1, w2 = F32(half[0]) * abs(i0), F32(half[1]) * abs(i1), F32(half[2]) * abs(i2)
    square, per_level = F32(half[0] * half[0]), F32(1.0 / max(level, 1e-6))
    own = np.int32(OBSTACLE + number)
    for v in range(top, bottom):
        start = start32(f, lines[v, 0], lines[v, 1])
        far_row, ids_row, lit_row = far[v, left:end], ids[v, left:end], lit[v, left:end]
        x_row = xs[left:end]
        if shape == BOX:
            for u in range(end - left):
                t = far_row[u]
                n, e, s = ray32(f, along, bent, v, left + u, start, F32(x_row[u]))
                a = (c0 - t * n) * i0
                b = (c1 - t * e) * i1
                d = (c2 - t * s) * i2
                enter = max(max(a - w0, b - w1), d - w2)
                leave = min(min(a + w0, b + w1), d + w2)
                hidden = (leave >= max(enter, ZERO)) & (ids_row[u] != own)
                lit_row[u] = through * lit_row[u] if hidden else lit_row[u]
        elif shape == CYLINDER:
            for u in range(end - left):
                t = far_row[u]
                n, e, s = ray32(f, along, bent, v, left + u, start, F32(x_row[u]))
                # Its first axis lies under the sun: the light's way is along it, seen from above.
                a = c0 - t * n
                b = c1 - t * e
                d = (c2 - t * s) * i2
                rest = square - b * b
                chord = np.sqrt(max(rest, ZERO))
                enter = max((a - chord) * per_level, d - w2)
                leave = min((a + chord) * per_level, d + w2)
                stopped = (leave >= max(enter, ZERO)) & (rest > ZERO)
                hidden = stopped & (ids_row[u] != own)
                lit_row[u] = through * lit_row[u] if hidden else lit_row[u]
        else:
            for u in range(end - left):
                t = far_row[u]
                n, e, s = ray32(f, along, bent, v, left + u, start, F32(x_row[u]))
                a = c0 - t * n
                b = c1 - t * e
                d = c2 - t * s
                toward = a * s0 + b * s1 + d * s2
                apart = a * a + b * b + d * d - toward * toward
                hidden = (apart < square) & (toward > ZERO) & (ids_row[u] != own)
                lit_row[u] = through * lit_row[u] if hidden else lit_row[u]


@borrowing_kernel
def shadow_rectangle(
    corners: NDArray[np.float64],
    n_lines: int,
    n_pixels: int,
    view: View,
    pose: Pose,
    half: Vec,
    sun: Vec,
    floor: float,
) -> Rectangle:
    """Return the pixels of a pinhole that an obstacle's shadow volume projects to.

    `pose` has the camera's axes along the body's and the body's centre from the camera, `half` the
    half extents of the box around it [m], `sun` the unit vector along the body's axes, `floor` the
    depth of the floor below its centre [m]; `corners` (CORNERS, 3) is a buffer.
    """
    c = pose.center
    nearest, farthest = math.inf, -math.inf
    for k in range(8):
        i = half[0] if k & 1 else -half[0]
        j = half[1] if k & 2 else -half[1]
        m = half[2] if k & 4 else -half[2]
        fall = max(floor - m, 0.0) / sun[2]
        for down in range(2):
            if down:
                i, j, m = i + fall * sun[0], j + fall * sun[1], m + fall * sun[2]
            p = (c[0] + i, c[1] + j, c[2] + m)
            z = dot(pose.forward, p)
            at = k + 8 * down
            corners[at, 0], corners[at, 1], corners[at, 2] = (
                z,
                dot(pose.along, p),
                dot(pose.across, p),
            )
            nearest, farthest = min(nearest, z), max(farthest, z)
    if farthest <= _NEAR_M:
        return 0, 0, 0, 0
    low_x, high_x, low_y, high_y = math.inf, -math.inf, math.inf, -math.inf
    for k in range(CORNERS):
        z = corners[k, 0]
        if z >= _NEAR_M:
            x, y = corners[k, 1] / z, corners[k, 2] / z
            low_x, high_x = min(low_x, x), max(high_x, x)
            low_y, high_y = min(low_y, y), max(high_y, y)
    if nearest < _NEAR_M:
        # The volume crosses the image plane: its edges do, between corners on both sides. Corners
        # differ in one bit along an edge; every shadow's edge has one of them.
        for k in range(CORNERS):
            for bit in range(4):
                m = k ^ (1 << bit)
                z, other = corners[k, 0], corners[m, 0]
                if z >= _NEAR_M > other:
                    share = (z - _NEAR_M) / (z - other)
                    x = (corners[k, 1] + share * (corners[m, 1] - corners[k, 1])) / _NEAR_M
                    y = (corners[k, 2] + share * (corners[m, 2] - corners[k, 2])) / _NEAR_M
                    low_x, high_x = min(low_x, x), max(high_x, x)
                    low_y, high_y = min(low_y, y), max(high_y, y)
    return (
        _first(view.line_centre + view.focal * low_y, n_lines),
        _last(view.line_centre + view.focal * high_y, n_lines),
        _first(view.pixel_centre + view.focal * low_x, n_pixels),
        _last(view.pixel_centre + view.focal * high_x, n_pixels),
    )


@kernel
def _first(low: float, n: int) -> int:
    """Return the first of n pixels that what begins at a place can fall on."""
    return int(min(max(math.floor(low), 0.0), float(n)))


@kernel
def _last(high: float, n: int) -> int:
    """Return the end of those that what ends at a place can fall on."""
    return int(min(max(math.ceil(high) + 1.0, 0.0), float(n)))
