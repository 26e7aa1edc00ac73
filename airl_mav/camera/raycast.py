"""Depth image of an arena by analytic ray casting: the kernel that training and the plant share.

A pinhole's pixel has the ray d = forward + x right + y down with (x, y) = ((u - cx) / focal,
(v - cy) / focal), so the distance t along it is the depth along the optical axis (planar z-depth,
RealSense Z16). A cylinder's has d = cos(a) forward + sin(a) right + y down with a = (u - cx) /
focal, and t is the depth in the plane of forward and right. Either is affine along a line of the
image, and these lines are what is drawn: the rows of a pinhole, the columns of a cylinder.
Everything is done on inverse depth s = 1 / t. Of a plane it is n.d / n.(p - o): affine in the
pixel, no division, finite for grazing rays. Of a sphere or cylinder it is a root of a quadratic.
A convex body is hit where its last entry is no farther than its first exit. The image keeps the
greatest s of all bodies; one division a pixel at the end turns it into metres.

Obstacle-outer: an obstacle touches only the pixels of the rectangle that its bounding box or
sphere projects to. The loops along a line have no branch, so that they vectorise. They are in
float64: a float32 direction is off by millimetres on a floor seen at 20 m.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from airl_mav.arena.geometry import Shape
from airl_mav.camera.projection import (
    MIN_DEPTH_M,
    Image,
    Pose,
    Rectangle,
    View,
    cut,
    cylinder_span,
    dot,
    pinhole_rectangle,
)
from airl_mav.core.kernels import kernel
from airl_mav.vehicle.rotation import Quat, Vec, rotate

_BOX: Final = int(Shape.BOX)
_CYLINDER: Final = int(Shape.CYLINDER)

_UNLIMITED: Final = 1e30  # inverse depth of an entry that lies behind the camera
_TINY: Final = 1e-9  # least distance to a plane [m], least range [1/m]; keeps inverses finite

Line = NDArray[np.float64]
Lines = NDArray[np.float64]
"""(n, 2) how much of the forward axis, and of the axis across, is in the first ray of a line."""


class _Slab(NamedTuple):
    """Inverse depths at two parallel planes, for a ray's component d across them.

    Entry: enter_gain d + enter_base. Exit: the greater of exit_a d and exit_b d.
    """

    enter_gain: float
    enter_base: float
    exit_a: float
    exit_b: float


@kernel
def _slab(low: float, high: float) -> _Slab:
    """Return the slab between two planes at signed distances low < high from the camera."""
    if low > 0.0:
        return _Slab(1.0 / max(low, _TINY), 0.0, 1.0 / max(high, _TINY), 0.0)
    if high < 0.0:
        return _Slab(1.0 / min(high, -_TINY), 0.0, 1.0 / min(low, -_TINY), 0.0)
    return _Slab(0.0, _UNLIMITED, 1.0 / min(low, -_TINY), 1.0 / max(high, _TINY))


@kernel
def _turn(v: Vec, cos: float, sin: float) -> Vec:
    """Return a world vector along axes that are turned about the vertical."""
    return (cos * v[0] + sin * v[1], cos * v[1] - sin * v[0], v[2])


@kernel
def _line_start(pose: Pose, ahead: float, y: float) -> Vec:
    """Return a line's ray at x = 0."""
    f, d = pose.forward, pose.across
    return (ahead * f[0] + y * d[0], ahead * f[1] + y * d[1], ahead * f[2] + y * d[2])


@kernel
def _draw_room(out: Image, lines: Lines, xs: Line, view: View, pose: Pose, half: Vec) -> None:
    """Write the inverse depth of floor and walls; 0 = no return.

    The room is a box without a lid. A ray that leaves it by the lid sees nothing, one that enters
    by the lid sees the inside, any other that enters sees a wall from outside.
    """
    c, r = pose.center, pose.along
    north = _slab(c[0] - half[0], c[0] + half[0])
    east = _slab(c[1] - half[1], c[1] + half[1])
    floor, top = 1.0 / (c[2] + half[2]), c[2] - half[2]
    above = top > 0.0
    lid = 1.0 / (max(top, _TINY) if above else min(top, -_TINY))
    enter_gain, enter_base, exit_gain = (lid, 0.0, 0.0) if above else (0.0, _UNLIMITED, lid)
    for v in range(out.shape[0]):
        d0, d1, d2 = _line_start(pose, lines[v, 0], lines[v, 1])
        row = out[v]
        for u in range(len(xs)):
            x = xs[u]
            n, e, d = d0 + x * r[0], d1 + x * r[1], d2 + x * r[2]
            by_side = min(
                north.enter_gain * n + north.enter_base, east.enter_gain * e + east.enter_base
            )
            by_lid = enter_gain * d + enter_base
            leave = max(
                max(north.exit_a * n, north.exit_b * n),
                max(max(east.exit_a * e, east.exit_b * e), floor * d),
            )
            leave_lid = exit_gain * d
            inner = leave if leave >= leave_lid else 0.0
            s = by_side if by_side < by_lid else inner
            s = s if min(by_side, by_lid) >= max(leave, leave_lid) else 0.0
            row[u] = s if s >= view.s_min else 0.0


@kernel
def _draw_box(
    out: Image, lines: Lines, xs: Line, view: View, pose: Pose, half: Vec, rectangle: Rectangle
) -> bool:
    """Draw a box; return whether the camera is inside."""
    c, r = pose.center, pose.along
    i = _slab(c[0] - half[0], c[0] + half[0])
    j = _slab(c[1] - half[1], c[1] + half[1])
    k = _slab(c[2] - half[2], c[2] + half[2])
    if i.enter_base > 0.0 and j.enter_base > 0.0 and k.enter_base > 0.0:
        return True
    top, bottom, left, end = rectangle
    x_span = xs[left:end]
    for v in range(top, bottom):
        d0, d1, d2 = _line_start(pose, lines[v, 0], lines[v, 1])
        row = out[v, left:end]
        for u in range(len(x_span)):
            x = x_span[u]
            a, b, d = d0 + x * r[0], d1 + x * r[1], d2 + x * r[2]
            enter = min(
                i.enter_gain * a + i.enter_base,
                min(j.enter_gain * b + j.enter_base, k.enter_gain * d + k.enter_base),
            )
            leave = max(
                max(max(i.exit_a * a, i.exit_b * a), max(j.exit_a * b, j.exit_b * b)),
                max(max(k.exit_a * d, k.exit_b * d), view.s_min),
            )
            s = enter if enter >= leave else 0.0
            row[u] = max(row[u], s)
    return False


@kernel
def _draw_cylinder(
    out: Image, lines: Lines, xs: Line, view: View, pose: Pose, half: Vec, rectangle: Rectangle
) -> bool:
    """Draw a vertical cylinder with caps; return whether the camera is inside."""
    c, r = pose.center, pose.along
    k = _slab(c[2] - half[2], c[2] + half[2])
    # Side: (c.c - radius²) s² - 2 (d.c) s + d.d = 0, horizontal components only.
    cc = c[0] * c[0] + c[1] * c[1] - half[0] * half[0]
    outside = cc > 0.0
    if not outside and k.enter_base > 0.0:
        return True
    out_gain = 1.0 / max(cc, _TINY * _TINY) if outside else 1.0 / min(cc, -_TINY * _TINY)
    in_gain, in_base = (out_gain, 0.0) if outside else (0.0, _UNLIMITED)
    top, bottom, left, end = rectangle
    x_span = xs[left:end]
    for v in range(top, bottom):
        d0, d1, d2 = _line_start(pose, lines[v, 0], lines[v, 1])
        row = out[v, left:end]
        for u in range(len(x_span)):
            x = x_span[u]
            a, b, d = d0 + x * r[0], d1 + x * r[1], d2 + x * r[2]
            toward = a * c[0] + b * c[1]
            square = toward * toward - cc * (a * a + b * b)
            root = math.sqrt(max(square, 0.0))
            enter = min(in_gain * (toward + root) + in_base, k.enter_gain * d + k.enter_base)
            leave = max(
                max(out_gain * (toward - root), view.s_min), max(k.exit_a * d, k.exit_b * d)
            )
            s = enter if enter >= leave else 0.0
            s = s if square >= 0.0 else 0.0
            row[u] = max(row[u], s)
    return False


@kernel
def _draw_sphere(
    out: Image, lines: Lines, xs: Line, view: View, pose: Pose, radius: float, rectangle: Rectangle
) -> bool:
    """Draw a sphere; return whether the camera is inside."""
    c, r = pose.center, pose.along
    cc = dot(c, c) - radius * radius
    if cc <= 0.0:
        return True
    gain = 1.0 / max(cc, _TINY * _TINY)
    top, bottom, left, end = rectangle
    x_span = xs[left:end]
    for v in range(top, bottom):
        d0, d1, d2 = _line_start(pose, lines[v, 0], lines[v, 1])
        row = out[v, left:end]
        for u in range(len(x_span)):
            x = x_span[u]
            a, b, d = d0 + x * r[0], d1 + x * r[1], d2 + x * r[2]
            toward = a * c[0] + b * c[1] + d * c[2]
            square = toward * toward - cc * (a * a + b * b + d * d)
            s = gain * (toward + math.sqrt(max(square, 0.0)))
            s = s if s >= view.s_min else 0.0
            s = s if square >= 0.0 else 0.0
            row[u] = max(row[u], s)
    return False


@kernel
def _draw_obstacle(
    out: Image, lines: Lines, xs: Line, view: View, world: Pose, shape: int, half: Vec, yaw: float
) -> bool:
    """Draw one obstacle whose centre is `world.center`; return whether the camera is inside."""
    cos, sin = 1.0, 0.0
    if shape == _BOX:
        cos, sin = math.cos(yaw), math.sin(yaw)
    elif shape == _CYLINDER:
        # Its bounding box turned towards the camera is the narrowest in the image.
        distance = math.hypot(world.center[0], world.center[1])
        if distance > 0.0:
            cos, sin = world.center[0] / distance, world.center[1] / distance
    pose = Pose(
        _turn(world.forward, cos, sin),
        _turn(world.across, cos, sin),
        _turn(world.along, cos, sin),
        _turn(world.center, cos, sin),
    )
    sphere = shape != _BOX and shape != _CYLINDER
    turns = 0
    span = (0.0, 0.0, 0, 0)
    rectangle = (0, 0, 0, 0)
    if view.cylindrical:
        # What is behind the camera may be at both ends of the image.
        turns = 1
        span = cylinder_span(out, view, pose, half, sphere)
    else:
        rectangle = pinhole_rectangle(out, view, pose, half, sphere)
    for turn in range(-turns, turns + 1):
        if view.cylindrical:
            rectangle = cut(out, view, span, turn)
        if rectangle[0] >= rectangle[1] or rectangle[2] >= rectangle[3]:
            continue
        inside: bool
        if shape == _BOX:
            inside = _draw_box(out, lines, xs, view, pose, half, rectangle)
        elif shape == _CYLINDER:
            inside = _draw_cylinder(out, lines, xs, view, pose, half, rectangle)
        else:
            inside = _draw_sphere(out, lines, xs, view, pose, half[0], rectangle)
        if inside:
            return True
    return False


@kernel
def _invert(out: Image) -> None:
    """Turn inverse depth into depth [m], in place."""
    zero, one = np.float32(0.0), np.float32(1.0)
    least, most = np.float32(_TINY), np.float32(1.0 / MIN_DEPTH_M)
    for v in range(out.shape[0]):
        row = out[v]
        for u in range(len(row)):
            s = row[u]
            t = one / min(max(s, least), most)
            row[u] = t if s > zero else zero


@kernel
def render_depth(
    out: Image,
    position: Vec | NDArray[np.float64],
    quaternion: Quat | NDArray[np.float64],
    focal: float,
    cx: float,
    cy: float,
    cylindrical: bool,
    max_range: float,
    bounds: NDArray[np.float64],
    shape: NDArray[np.int8],
    center: NDArray[np.float64],
    half_size: NDArray[np.float64],
    yaw: NDArray[np.float64],
) -> None:
    """Render the depth image of an arena.

    The floor is the rectangle of the bounds at z = 0. The walls are thin, stand on its edges and
    are seen from both sides; a ray that passes over them has no return. A camera less than
    `MIN_DEPTH_M` above the floor is lifted to that height (a resting vehicle sinks in by the
    contact's penetration). From inside an obstacle every pixel reads `MIN_DEPTH_M`.

    Args:
        out: (height, width) depth [m], written; 0 = no return. Along the optical axis of a pinhole,
            in the camera's horizontal plane of a cylinder.
        position: (3,) camera NED [m].
        quaternion: (4,) unit [w, x, y, z] camera -> NED: its x axis is the optical axis, y points
            to the right of the image, z to its bottom.
        focal: Focal length [px] of a pinhole, columns for an angle [px/rad] of a cylinder.
        cx: Column of the optical axis; pixel centres are at whole numbers.
        cy: Row of the optical axis.
        cylindrical: The image is a cylinder's, as `Intrinsics` defines it.
        max_range: Greatest depth that gives a return [m].
        bounds: (5,) `Bounds.as_array()`.
        shape: (n,) `Shape`.
        center: (n, 3) NED [m].
        half_size: (n, 3) as in `Obstacles` [m].
        yaw: (n,) heading of a box's first axis [rad].
    """
    camera = (position[0], position[1], min(position[2], -MIN_DEPTH_M))
    q = (quaternion[0], quaternion[1], quaternion[2], quaternion[3])
    forward, right, down = (
        rotate(q, (1.0, 0.0, 0.0)),
        rotate(q, (0.0, 1.0, 0.0)),
        rotate(q, (0.0, 0.0, 1.0)),
    )
    height, width = out.shape
    xs = np.empty(height if cylindrical else width)
    lines = np.empty((width if cylindrical else height, 2))
    if cylindrical:
        # Drawn column by column, each of them in one piece; `out` gets them at the end.
        drawn = np.empty((width, height), np.float32)
        view = View(focal, cx, cy, max(1.0 / max_range, _TINY), cylindrical)
        across, along = right, down
        for u in range(width):
            angle = (u - cx) / focal
            lines[u, 0], lines[u, 1] = math.cos(angle), math.sin(angle)
        for v in range(height):
            xs[v] = (v - cy) / focal
    else:
        drawn = out
        view = View(focal, cy, cx, max(1.0 / max_range, _TINY), cylindrical)
        across, along = down, right
        for v in range(height):
            lines[v, 0], lines[v, 1] = 1.0, (v - cy) / focal
        for u in range(width):
            xs[u] = (u - cx) / focal

    room = (
        0.5 * (bounds[0] + bounds[1]) - camera[0],
        0.5 * (bounds[2] + bounds[3]) - camera[1],
        -0.5 * bounds[4] - camera[2],
    )
    half_room = (0.5 * (bounds[1] - bounds[0]), 0.5 * (bounds[3] - bounds[2]), 0.5 * bounds[4])
    _draw_room(drawn, lines, xs, view, Pose(forward, across, along, room), half_room)
    for i in range(len(shape)):
        offset = (center[i, 0] - camera[0], center[i, 1] - camera[1], center[i, 2] - camera[2])
        half = (half_size[i, 0], half_size[i, 1], half_size[i, 2])
        pose = Pose(forward, across, along, offset)
        if _draw_obstacle(drawn, lines, xs, view, pose, shape[i], half, yaw[i]):
            out[:, :] = MIN_DEPTH_M
            return
    _invert(drawn)
    if cylindrical:
        out[:, :] = drawn.T
