"""Inverse depth of a room, box, cylinder or sphere along the lines of an image; see `raycast`."""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from airl_mav.arena.geometry import Shape
from airl_mav.camera.projection import Image, Optics, Pose, ProjectedBody, Rectangle, dot, ray_of
from airl_mav.core.kernels import borrowing_kernel, kernel
from airl_mav.vehicle.rotation import Vec

BOX: Final = int(Shape.BOX)
CYLINDER: Final = int(Shape.CYLINDER)

GROUND: Final = -2
"""Number of hills during rendering; the output reports them as floor."""

CEILING: Final = -1
SKY: Final = 0
FLOOR: Final = 1
WALL_NORTH_SOUTH: Final = 2
WALL_EAST_WEST: Final = 3
OBSTACLE: Final = 4
"""Number of the first obstacle in a segmentation; others follow in order."""

_UNLIMITED: Final = 1e30  # inverse depth of an entry behind the camera
TINY: Final = 1e-9  # minimum distance to a plane [m] and minimum range [1/m]; keeps inverses finite

Ids = NDArray[np.int32]
Rectangles = NDArray[np.int32]


class _Slab(NamedTuple):
    """Inverse depths at two parallel planes, for the ray component d perpendicular to them.

    Entry: enter_gain d + enter_base. Exit: the maximum of exit_a d and exit_b d.
    """

    enter_gain: float
    enter_base: float
    exit_a: float
    exit_b: float


@kernel
def _slab(low: float, high: float) -> _Slab:
    """Return the slab between two planes at signed distances low < high from the camera."""
    if low > 0.0:
        return _Slab(1.0 / max(low, TINY), 0.0, 1.0 / max(high, TINY), 0.0)
    if high < 0.0:
        return _Slab(1.0 / min(high, -TINY), 0.0, 1.0 / min(low, -TINY), 0.0)
    # Between the planes the entry is behind the camera; the exit is the plane ahead.
    return _Slab(0.0, _UNLIMITED, 1.0 / min(low, -TINY), 1.0 / max(high, TINY))


@kernel
def turn_axes(v: Vec, cos: float, sin: float) -> Vec:
    """Return a world vector in axes rotated about the vertical."""
    return (cos * v[0] + sin * v[1], cos * v[1] - sin * v[0], v[2])


@kernel
def _line_start(pose: Pose, ahead: float, y: float) -> Vec:
    """Return a line's ray at x = 0."""
    f, d = pose.forward, pose.across
    return (ahead * f[0] + y * d[0], ahead * f[1] + y * d[1], ahead * f[2] + y * d[2])


@borrowing_kernel
def draw_room(
    out: Image, ids: Ids | None, optics: Optics, pose: Pose, half: Vec, closed: bool
) -> None:
    """Write the inverse depth of floor, walls and ceiling, 0 = no return, and `ids`.

    Without a ceiling the room is a box without a lid. A ray that leaves through the lid has no
    return; a ray that enters through it sees the inside; any other entering ray sees a wall from
    outside. In a closed room, rays in either direction see the lid.
    """
    c, lines, xs = pose.center, optics.lines, optics.xs
    north = _slab(c[0] - half[0], c[0] + half[0])
    east = _slab(c[1] - half[1], c[1] + half[1])
    floor, top = 1.0 / (c[2] + half[2]), c[2] - half[2]
    above = top > 0.0
    lid = 1.0 / (max(top, TINY) if above else min(top, -TINY))
    enter_gain, enter_base, exit_gain = (lid, 0.0, 0.0) if above else (0.0, _UNLIMITED, lid)
    covered, lid_seen = closed and above, 1.0 if closed else 0.0
    # A camera in the room needs no entry test, so that loop is shorter.
    if north.enter_base > 0.0 and east.enter_base > 0.0 and not above:
        _draw_room_around(out, ids, optics, pose, north, east, floor, lid, lid_seen)
        return
    for v in range(out.shape[0]):
        start = _line_start(pose, lines[v, 0], lines[v, 1])
        row = out[v]
        if ids is not None:
            marks = ids[v]
        for u in range(len(xs)):
            n, e, d = ray_of(pose, optics.bent, v, u, start, xs[u])
            # Of several entries the last counts, which has the smallest inverse depth.
            by_side = min(
                north.enter_gain * n + north.enter_base, east.enter_gain * e + east.enter_base
            )
            by_lid = enter_gain * d + enter_base
            leave = max(
                max(north.exit_a * n, north.exit_b * n),
                max(max(east.exit_a * e, east.exit_b * e), floor * d),
            )
            leave_lid = exit_gain * d
            inner = leave if leave >= leave_lid else lid_seen * leave_lid
            inner = by_lid if covered else inner
            # An entry through a wall shows its outer side, an entry through the lid the inside.
            s = by_side if by_side < by_lid else inner
            enters = min(by_side, by_lid) >= max(leave, leave_lid)
            s = s if enters else 0.0
            s = s if s >= optics.lens.s_min else 0.0
            row[u] = s
            if ids is not None:
                # The surface's number follows from the same comparisons.
                inwards = by_side < by_lid
                norths = max(north.exit_a * n, north.exit_b * n)
                easts = max(east.exit_a * e, east.exit_b * e)
                north_in = north.enter_gain * n + north.enter_base
                east_in = east.enter_gain * e + east.enter_base
                wall_out = WALL_NORTH_SOUTH if norths >= easts else WALL_EAST_WEST
                inner_id = FLOOR if floor * d >= max(norths, easts) else wall_out
                inner_id = CEILING if covered or leave < leave_lid else inner_id
                outer_id = WALL_NORTH_SOUTH if north_in <= east_in else WALL_EAST_WEST
                found = outer_id if inwards else inner_id
                marks[u] = found if s > 0.0 else SKY


@borrowing_kernel
def _draw_room_around(
    out: Image,
    ids: Ids | None,
    optics: Optics,
    pose: Pose,
    north: _Slab,
    east: _Slab,
    floor: float,
    lid: float,
    lid_seen: float,
) -> None:
    """Draw the room around the camera, as in `draw_room`; rays only leave the room.

    `north` and `east` are slabs between walls, `floor` and `lid` inverse depths below and,
    negative, above the camera [1/m]; `lid_seen` is 1 for a ceiling, 0 for an open room.
    """
    lines, xs = optics.lines, optics.xs
    for v in range(out.shape[0]):
        start = _line_start(pose, lines[v, 0], lines[v, 1])
        row = out[v]
        if ids is not None:
            marks = ids[v]
        for u in range(len(xs)):
            n, e, d = ray_of(pose, optics.bent, v, u, start, xs[u])
            norths = max(north.exit_a * n, north.exit_b * n)
            easts = max(east.exit_a * e, east.exit_b * e)
            walls, by_floor, by_lid = max(norths, easts), floor * d, lid * d
            leave = max(walls, by_floor)
            by_top = leave < by_lid
            s = lid_seen * by_lid if by_top else leave
            s = s if s >= optics.lens.s_min else 0.0
            row[u] = s
            if ids is not None:
                wall = WALL_NORTH_SOUTH if norths >= easts else WALL_EAST_WEST
                found = FLOOR if by_floor >= walls else wall
                found = CEILING if by_top else found
                marks[u] = found if s > 0.0 else SKY


@borrowing_kernel
def draw_box(
    out: Image, ids: Ids | None, optics: Optics, body: ProjectedBody, rectangle: Rectangle
) -> bool:
    """Draw a box; return True if the camera is inside."""
    c, half, lines = body.pose.center, body.half, optics.lines
    i = _slab(c[0] - half[0], c[0] + half[0])
    j = _slab(c[1] - half[1], c[1] + half[1])
    k = _slab(c[2] - half[2], c[2] + half[2])
    if i.enter_base > 0.0 and j.enter_base > 0.0 and k.enter_base > 0.0:
        return True
    top, bottom, left, end = rectangle
    x_span = optics.xs[left:end]
    for v in range(top, bottom):
        start = _line_start(body.pose, lines[v, 0], lines[v, 1])
        row = out[v, left:end]
        if ids is not None:
            marks = ids[v, left:end]
        for u in range(len(x_span)):
            a, b, d = ray_of(body.pose, optics.bent, v, left + u, start, x_span[u])
            # A convex body is hit if its last entry is no farther than its first exit.
            enter = min(
                i.enter_gain * a + i.enter_base,
                min(j.enter_gain * b + j.enter_base, k.enter_gain * d + k.enter_base),
            )
            leave = max(
                max(max(i.exit_a * a, i.exit_b * a), max(j.exit_a * b, j.exit_b * b)),
                max(max(k.exit_a * d, k.exit_b * d), optics.lens.s_min),
            )
            s = enter if enter >= leave else 0.0
            if ids is not None:
                marks[u] = OBSTACLE + body.number if s > row[u] else marks[u]
            row[u] = max(row[u], s)
    return False


@borrowing_kernel
def draw_cylinder(
    out: Image, ids: Ids | None, optics: Optics, body: ProjectedBody, rectangle: Rectangle
) -> bool:
    """Draw a vertical cylinder with caps; return True if the camera is inside."""
    c, half, lines = body.pose.center, body.half, optics.lines
    k = _slab(c[2] - half[2], c[2] + half[2])
    # Side: (c.c - radius²) s² - 2 (d.c) s + d.d = 0, horizontal components only.
    cc = c[0] * c[0] + c[1] * c[1] - half[0] * half[0]
    outside = cc > 0.0
    if not outside and k.enter_base > 0.0:
        return True
    out_gain = 1.0 / max(cc, TINY * TINY) if outside else 1.0 / min(cc, -TINY * TINY)
    in_gain, in_base = (out_gain, 0.0) if outside else (0.0, _UNLIMITED)
    top, bottom, left, end = rectangle
    x_span = optics.xs[left:end]
    for v in range(top, bottom):
        start = _line_start(body.pose, lines[v, 0], lines[v, 1])
        row = out[v, left:end]
        if ids is not None:
            marks = ids[v, left:end]
        for u in range(len(x_span)):
            a, b, d = ray_of(body.pose, optics.bent, v, left + u, start, x_span[u])
            toward = a * c[0] + b * c[1]
            square = toward * toward - cc * (a * a + b * b)
            root = math.sqrt(max(square, 0.0))
            enter = min(in_gain * (toward + root) + in_base, k.enter_gain * d + k.enter_base)
            leave = max(
                max(out_gain * (toward - root), optics.lens.s_min), max(k.exit_a * d, k.exit_b * d)
            )
            s = enter if enter >= leave else 0.0
            s = s if square >= 0.0 else 0.0
            if ids is not None:
                marks[u] = OBSTACLE + body.number if s > row[u] else marks[u]
            row[u] = max(row[u], s)
    return False


@borrowing_kernel
def draw_sphere(
    out: Image, ids: Ids | None, optics: Optics, body: ProjectedBody, rectangle: Rectangle
) -> bool:
    """Draw a sphere; return True if the camera is inside."""
    c, radius, lines = body.pose.center, body.half[0], optics.lines
    cc = dot(c, c) - radius * radius
    if cc <= 0.0:
        return True
    gain = 1.0 / max(cc, TINY * TINY)
    top, bottom, left, end = rectangle
    x_span = optics.xs[left:end]
    for v in range(top, bottom):
        start = _line_start(body.pose, lines[v, 0], lines[v, 1])
        row = out[v, left:end]
        if ids is not None:
            marks = ids[v, left:end]
        for u in range(len(x_span)):
            a, b, d = ray_of(body.pose, optics.bent, v, left + u, start, x_span[u])
            # The larger root of (c.c - radius²) s² - 2 (d.c) s + d.d = 0 is the entry.
            toward = a * c[0] + b * c[1] + d * c[2]
            square = toward * toward - cc * (a * a + b * b + d * d)
            s = gain * (toward + math.sqrt(max(square, 0.0)))
            s = s if s >= optics.lens.s_min else 0.0
            s = s if square >= 0.0 else 0.0
            if ids is not None:
                marks[u] = OBSTACLE + body.number if s > row[u] else marks[u]
            row[u] = max(row[u], s)
    return False


@kernel
def turned(pose: Pose, cos: float, sin: float) -> Pose:
    """Return a world pose in axes rotated about the vertical."""
    return Pose(
        turn_axes(pose.forward, cos, sin),
        turn_axes(pose.across, cos, sin),
        turn_axes(pose.along, cos, sin),
        turn_axes(pose.center, cos, sin),
    )
