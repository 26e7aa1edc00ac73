"""The inverse depth of a mesh along the lines of an image: its tree, walked by all rays together.

All rays of an image begin in one place, so a node of the tree is tested against all of them at
once: the rays that may hit it are those of the rectangle that its box projects to, cut to that of
its parent. A node is passed over where no ray goes through its rectangle, as most are of a fine
mesh seen from afar, or where all of its rays have been stopped nearer. Near nodes come before far
ones. Where one ray is left, it alone goes on through the tree.

A triangle with the corners a, b and c, seen from the camera, is hit by the ray d where the volumes
d.(b x c), d.(c x a) and d.(a x b) have one sign, but for rounding, so that no ray passes between
two that share an edge or a corner: each is affine along a line of the image. The inverse depth is
n.d / n.a with n = (b - a) x (c - a). Both sides are seen.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from airl_mav.camera.bvh import STACK, Bvh, Meshes
from airl_mav.camera.primitives import OBSTACLE, Ids, Line, Lines, Rectangles, turned
from airl_mav.camera.projection import (
    Image,
    Pose,
    Rectangle,
    Span,
    View,
    cut,
    cylinder_span,
    dot,
)
from airl_mav.core.kernels import kernel, large_kernel
from airl_mav.vehicle.rotation import Vec

_MARGIN_PX: Final = 1e-6
"""Rounding of a place in the image is far below this."""

_NEAR: Final = 1e-4
"""Corners nearer to the image plane than this are not projected, in units of the mesh."""

_LEAST: Final = 1e-12
"""Least component of a ray that is divided by."""

_SPARE: Final = 4e-14
"""Of a volume in the square of the distance: above rounding, below a billionth of a metre."""

_EDGE_ON2: Final = 1e-18
"""Square of the angle below which a triangle is not seen."""

_MOST_LOOKED_AT: Final = 256
"""In more pixels it is not looked whether all see something nearer."""

_NOWHERE: Final = (0, 0, 0, 0)

Faces = NDArray[np.int32]


@kernel
def seen_from(axes: Pose, camera: Vec, pose: NDArray[np.float64], k: int) -> Pose:
    """Return the camera's axes along mesh k's, and its origin from the camera, in units of it.

    Args:
        axes: The camera's axes.
        camera: (3,) NED [m].
        pose: `Meshes.pose`.
        k: Number of the mesh.
    """
    per = 1.0 / pose[k, 4]
    offset = (pose[k, 0] - camera[0], pose[k, 1] - camera[1], -camera[2])
    at = (per * offset[0], per * offset[1], per * offset[2])
    return turned(Pose(axes.forward, axes.across, axes.along, at), pose[k, 2], pose[k, 3])


@large_kernel
def draw_meshes(
    out: Image,
    ids: Ids | None,
    faces: Faces | None,
    drawn_in: Rectangles | None,
    lines: Lines,
    xs: Line,
    view: View,
    axes: Pose,
    camera: Vec,
    meshes: Meshes,
) -> None:
    """Draw the meshes of an arena over what has been drawn.

    Args:
        out: (n, m) inverse depth [1/m], changed.
        ids: (n, m) what each pixel sees, changed; None: nobody asks.
        faces: (n, m) the triangle that each pixel sees, written where it sees one; None as `ids`.
        drawn_in: (obstacles, 3, 4) written for the first obstacle of each mesh, in its first place:
            the rectangle that it may be seen in; None as `ids`.
        lines: Of the image, with the next two.
        xs: Rays of a line.
        view: How the image sees.
        axes: The camera's axes.
        camera: (3,) NED [m].
        meshes: Those of the arena.
    """
    waiting = np.empty((STACK, 5), np.int32)
    nearest = np.empty(STACK)
    for k in range(len(meshes.root)):
        number = meshes.first[k]
        kept = None if drawn_in is None else drawn_in[number, 0]
        pose = seen_from(axes, camera, meshes.pose, k)
        scale = meshes.pose[k, 4]
        _draw_mesh(
            out, ids, faces, kept, OBSTACLE + number, lines, xs, view, pose, meshes.bvh,
            meshes.root[k], scale, waiting, nearest,
        )  # fmt: skip


@large_kernel
def _draw_mesh(
    out: Image,
    ids: Ids | None,
    faces: Faces | None,
    drawn_in: Rectangles | None,
    number: int,
    lines: Lines,
    xs: Line,
    view: View,
    pose: Pose,
    bvh: Bvh,
    root: int,
    scale: float,
    waiting: NDArray[np.int32],
    nearest: NDArray[np.float64],
) -> None:
    """Draw one mesh; `view` and `pose` are in metres and in units of the mesh."""
    own = View(
        view.focal, view.line_centre, view.pixel_centre, view.s_min * scale, view.cylindrical
    )
    per = 1.0 / scale
    whole = (0, len(lines), 0, len(xs))
    near, part = _part(out, own, pose, bvh.boxes, root, whole)
    if drawn_in is not None:
        for side in range(4):
            drawn_in[side] = part[side]
    if part[0] >= part[1] or part[2] >= part[3]:
        return
    _wait(waiting, nearest, 0, root, near, part)
    tops = 1
    while tops > 0:
        tops -= 1
        node = waiting[tops, 0]
        part = (
            int(waiting[tops, 1]),
            int(waiting[tops, 2]),
            int(waiting[tops, 3]),
            int(waiting[tops, 4]),
        )
        if (part[1] - part[0]) * (part[3] - part[2]) == 1:
            v, u = part[0], part[2]
            _cast(
                out, ids, faces, number, v, u, lines[v, 0], lines[v, 1], xs[u], own, pose, bvh,
                node, per, waiting, tops,
            )  # fmt: skip
            continue
        if _hidden(out, part, per / nearest[tops]):
            continue
        first, count = bvh.links[node, 0], bvh.links[node, 1]
        if count > 0:
            for i in range(first, first + count):
                _draw_triangle(
                    out, ids, faces, number, lines, xs, own, pose, bvh.corners, i, part, per
                )
            continue
        left, right = node + 1, first
        near_l, part_l = _part(out, own, pose, bvh.boxes, left, part)
        near_r, part_r = _part(out, own, pose, bvh.boxes, right, part)
        if near_l < near_r:
            left, right = right, left
            near_l, near_r, part_l, part_r = near_r, near_l, part_r, part_l
        # The nearer one is on the right now: put down last, it is taken up first.
        if part_l[0] < part_l[1] and part_l[2] < part_l[3]:
            _wait(waiting, nearest, tops, left, near_l, part_l)
            tops += 1
        if part_r[0] < part_r[1] and part_r[2] < part_r[3]:
            _wait(waiting, nearest, tops, right, near_r, part_r)
            tops += 1


@kernel
def _wait(
    waiting: NDArray[np.int32],
    nearest: NDArray[np.float64],
    at: int,
    node: int,
    near: float,
    part: Rectangle,
) -> None:
    """Note a node, the least depth in it, and the rays that may hit it."""
    waiting[at, 0] = node
    for side in range(4):
        waiting[at, 1 + side] = part[side]
    nearest[at] = max(near, 1e-12)


@kernel
def _hidden(out: Image, part: Rectangle, greatest: float) -> bool:
    """Return whether all pixels of a small part see something nearer than an inverse depth."""
    if (part[1] - part[0]) * (part[3] - part[2]) > _MOST_LOOKED_AT:
        return False
    for v in range(part[0], part[1]):
        for u in range(part[2], part[3]):
            if out[v, u] < greatest:
                return False
    return True


@kernel
def _part(
    out: Image,
    view: View,
    pose: Pose,
    boxes: NDArray[np.float32],
    node: int,
    outer: Rectangle,
) -> tuple[float, Rectangle]:
    """Return the least depth of a node and the pixels, out of some, whose rays may hit it."""
    c = pose.center
    middle = (c[0] + boxes[node, 0], c[1] + boxes[node, 1], c[2] + boxes[node, 2])
    half = (float(boxes[node, 3]), float(boxes[node, 4]), float(boxes[node, 5]))
    if view.cylindrical:
        at = Pose(pose.forward, pose.across, pose.along, middle)
        span = cylinder_span(out, view, at, half, False)
        # As `cylinder_span` has it: the depth is that in the plane of the cylinder's ring.
        near = math.hypot(dot(pose.forward, middle), dot(pose.across, middle))
        near -= math.sqrt(dot(half, half))
        return near, _around(out, view, span, outer)
    f, r, d = pose.forward, pose.along, pose.across
    z, deep = dot(f, middle), _reach(f, half)
    near, far = z - deep, z + deep
    if far <= 0.0 or near * view.s_min > 1.0:
        return near, _NOWHERE
    x, y, wide, high = dot(r, middle), dot(d, middle), _reach(r, half), _reach(d, half)
    return near, _between(view, near, far, x - wide, x + wide, y - high, y + high, outer)


@kernel
def _around(out: Image, view: View, span: Span, outer: Rectangle) -> Rectangle:
    """Return the pixels of a part of a cylinder that lie in a span, after any turn of it."""
    low, high = max(span[2], outer[2]), min(span[3], outer[3])
    if span[0] == 0.0 and span[1] == float(out.shape[0]):
        # It stands across the cylinder's axis: what is in it may be seen all round.
        return outer[0], outer[1], low, high
    first, last = outer[1], outer[0]
    for turn in range(-1, 2):
        begin, end, _, _ = cut(out, view, span, turn)
        begin, end = max(begin, outer[0]), min(end, outer[1])
        if begin < end:
            first, last = min(first, begin), max(last, end)
    return first, last, low, high


@kernel
def _between(
    view: View,
    near: float,
    far: float,
    left: float,
    right: float,
    top: float,
    bottom: float,
    outer: Rectangle,
) -> Rectangle:
    """Return the pixels of a part that see anything of a box along the camera's axes.

    What of it lies behind the image plane is not seen: there the slopes have no bound.
    """
    per_near, per_far = 1.0 / max(near, _NEAR), 1.0 / max(far, _NEAR)
    return _pixels(
        view,
        left * (per_near if left < 0.0 else per_far),
        right * (per_near if right > 0.0 else per_far),
        top * (per_near if top < 0.0 else per_far),
        bottom * (per_near if bottom > 0.0 else per_far),
        outer,
    )


@kernel
def _reach(axis: Vec, half: Vec) -> float:
    """Return how far a box reaches from its centre along an axis, either way."""
    return abs(half[0] * axis[0]) + abs(half[1] * axis[1]) + abs(half[2] * axis[2])


@kernel
def _pixels(
    view: View, left: float, right: float, top: float, bottom: float, outer: Rectangle
) -> Rectangle:
    """Return the pixels of a part whose centres lie between slopes along and across a line."""
    u_centre, v_centre = view.pixel_centre, view.line_centre
    return (
        max(math.ceil(v_centre + view.focal * top - _MARGIN_PX), outer[0]),
        min(math.floor(v_centre + view.focal * bottom + _MARGIN_PX) + 1, outer[1]),
        max(math.ceil(u_centre + view.focal * left - _MARGIN_PX), outer[2]),
        min(math.floor(u_centre + view.focal * right + _MARGIN_PX) + 1, outer[3]),
    )


@kernel
def _cross(a: Vec, b: Vec) -> Vec:
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


class _Sides(NamedTuple):
    """What a ray d is tested with against a triangle.

    The volumes that it spans with the edges are d.n0, d.n1 and d.n2, where it is hit not below 0
    but by `spare`, for rounding. The inverse depth is gain d.normal; a gain of 0: seen edge on.
    """

    n0: Vec
    n1: Vec
    n2: Vec
    normal: Vec
    gain: float
    spare: float


@kernel
def _sides(p0: Vec, p1: Vec, p2: Vec) -> _Sides:
    """Return what a ray is tested with against a triangle, by its corners from the camera."""
    n0, n1, n2 = _cross(p1, p2), _cross(p2, p0), _cross(p0, p1)
    volume = dot(p0, n0)
    sign = 1.0 if volume > 0.0 else -1.0
    normal = _cross(
        (p1[0] - p0[0], p1[1] - p0[1], p1[2] - p0[2]), (p2[0] - p0[0], p2[1] - p0[1], p2[2] - p0[2])
    )
    height, away2 = dot(normal, p0), dot(p0, p0)
    edge_on = height * height <= _EDGE_ON2 * dot(normal, normal) * away2
    gain = 0.0 if edge_on else 1.0 / height
    spare = _SPARE * (away2 + dot(p1, p1) + dot(p2, p2))
    return _Sides(_signed(n0, sign), _signed(n1, sign), _signed(n2, sign), normal, gain, spare)


@kernel
def _signed(v: Vec, sign: float) -> Vec:
    return (sign * v[0], sign * v[1], sign * v[2])


@kernel
def _draw_triangle(
    out: Image,
    ids: Ids | None,
    faces: Faces | None,
    number: int,
    lines: Lines,
    xs: Line,
    view: View,
    pose: Pose,
    corners: NDArray[np.float32],
    i: int,
    part: Rectangle,
    per: float,
) -> None:
    """Draw a triangle into a part of the image; `per` is a metre in units of the mesh."""
    c, f, r, d = pose.center, pose.forward, pose.along, pose.across
    p0 = (c[0] + corners[i, 0], c[1] + corners[i, 1], c[2] + corners[i, 2])
    p1 = (c[0] + corners[i, 3], c[1] + corners[i, 4], c[2] + corners[i, 5])
    p2 = (c[0] + corners[i, 6], c[1] + corners[i, 7], c[2] + corners[i, 8])
    least, most = 0.0, math.inf  # inverse depth of its corners
    if not view.cylindrical:
        z0, z1, z2 = dot(f, p0), dot(f, p1), dot(f, p2)
        near, far = min(min(z0, z1), z2), max(max(z0, z1), z2)
        if far <= 0.0:
            return
        if near > _NEAR:
            g0, g1, g2 = 1.0 / z0, 1.0 / z1, 1.0 / z2
            least, most = min(min(g0, g1), g2), max(max(g0, g1), g2)
            x0, x1, x2 = dot(r, p0) * g0, dot(r, p1) * g1, dot(r, p2) * g2
            y0, y1, y2 = dot(d, p0) * g0, dot(d, p1) * g1, dot(d, p2) * g2
            part = _pixels(
                view,
                min(min(x0, x1), x2),
                max(max(x0, x1), x2),
                min(min(y0, y1), y2),
                max(max(y0, y1), y2),
                part,
            )
        else:
            x0, x1, x2 = dot(r, p0), dot(r, p1), dot(r, p2)
            y0, y1, y2 = dot(d, p0), dot(d, p1), dot(d, p2)
            part = _between(
                view,
                near,
                far,
                min(min(x0, x1), x2),
                max(max(x0, x1), x2),
                min(min(y0, y1), y2),
                max(max(y0, y1), y2),
                part,
            )
        if part[0] >= part[1] or part[2] >= part[3]:
            return
    sides = _sides(p0, p1, p2)
    if sides.gain == 0.0:
        return
    slope0, slope1, slope2 = dot(sides.n0, r), dot(sides.n1, r), dot(sides.n2, r)
    slope = dot(sides.normal, r)
    for v in range(part[0], part[1]):
        ahead, y = lines[v, 0], lines[v, 1]
        ray = (ahead * f[0] + y * d[0], ahead * f[1] + y * d[1], ahead * f[2] + y * d[2])
        start0, start1, start2 = dot(sides.n0, ray), dot(sides.n1, ray), dot(sides.n2, ray)
        start = dot(sides.normal, ray)
        for u in range(part[2], part[3]):
            x = xs[u]
            e0, e1, e2 = start0 + x * slope0, start1 + x * slope1, start2 + x * slope2
            if min(min(e0, e1), e2) >= -sides.spare:
                # Of a triangle seen edge on, rounding is kept within its corners.
                s = min(max(sides.gain * (start + x * slope), least), most)
                s32 = np.float32(per * s)
                if s >= view.s_min and s32 > out[v, u]:
                    out[v, u] = s32
                    if ids is not None:
                        ids[v, u] = number
                    if faces is not None:
                        faces[v, u] = i


@kernel
def _cast(
    out: Image,
    ids: Ids | None,
    faces: Faces | None,
    number: int,
    v: int,
    u: int,
    ahead: float,
    y: float,
    x: float,
    view: View,
    pose: Pose,
    bvh: Bvh,
    root: int,
    per: float,
    waiting: NDArray[np.int32],
    tops: int,
) -> None:
    """Draw what one ray hits of a node; those that wait are in front of `waiting[tops]`."""
    c, f, r, d = pose.center, pose.forward, pose.along, pose.across
    start = (ahead * f[0] + y * d[0], ahead * f[1] + y * d[1], ahead * f[2] + y * d[2])
    ray = (start[0] + x * r[0], start[1] + x * r[1], start[2] + x * r[2])
    i0, i1, i2 = inverse_of(ray[0]), inverse_of(ray[1]), inverse_of(ray[2])
    v0, v1, v2 = abs(i0), abs(i1), abs(i2)
    c0, c1, c2 = c[0] * i0, c[1] * i1, c[2] * i2
    boxes, links, corners = bvh.boxes, bvh.links, bvh.corners
    # How far the ray goes: to what it has hit, or to the end of the range.
    most = 1.0 / max(out[v, u] / per, view.s_min)
    bottom, node = tops, root
    enter, leave = _through(boxes, node, c0, c1, c2, i0, i1, i2, v0, v1, v2)
    if not leave >= max(enter, 0.0):
        return
    while True:
        if enter <= most:
            first, count = links[node, 0], links[node, 1]
            if count == 0:
                left, right = node + 1, first
                enter, leave = _through(boxes, left, c0, c1, c2, i0, i1, i2, v0, v1, v2)
                enter_r, leave_r = _through(boxes, right, c0, c1, c2, i0, i1, i2, v0, v1, v2)
                hit = leave >= max(enter, 0.0) and enter <= most
                hit_r = leave_r >= max(enter_r, 0.0) and enter_r <= most
                if hit and hit_r:
                    if enter_r < enter:
                        left, right, enter = right, left, enter_r
                    waiting[tops, 0] = right
                    tops += 1
                    node = left
                    continue
                if hit or hit_r:
                    node = left if hit else right
                    enter = enter if hit else enter_r
                    continue
            else:
                for i in range(first, first + count):
                    s = _met(corners, i, view, pose, start, x)
                    s32 = np.float32(per * s)
                    if s >= view.s_min and s32 > out[v, u]:
                        out[v, u] = s32
                        most = 1.0 / s
                        if ids is not None:
                            ids[v, u] = number
                        if faces is not None:
                            faces[v, u] = i
        if tops == bottom:
            return
        tops -= 1
        node = waiting[tops, 0]
        enter, leave = _through(boxes, node, c0, c1, c2, i0, i1, i2, v0, v1, v2)


@kernel
def inverse_of(x: float) -> float:
    """Return one over a component of a ray, finite."""
    return 1.0 / (max(x, _LEAST) if x >= 0.0 else min(x, -_LEAST))


@kernel
def _through(
    boxes: NDArray[np.float32],
    node: int,
    c0: float,
    c1: float,
    c2: float,
    i0: float,
    i1: float,
    i2: float,
    v0: float,
    v1: float,
    v2: float,
) -> tuple[float, float]:
    """Return where a ray enters and leaves a node's box; it leaves before it enters: never.

    Args:
        boxes: `Bvh.boxes`.
        node: Which one.
        c0: Of the mesh's origin from where the ray begins, over the ray, with the next two.
        c1: The same along the second axis.
        c2: Along the third.
        i0: One over the ray, with the next two.
        i1: The same along the second axis.
        i2: Along the third.
        v0: Amounts of these, with the next two.
        v1: Along the second axis.
        v2: Along the third.
    """
    a, b, c = c0 + boxes[node, 0] * i0, c1 + boxes[node, 1] * i1, c2 + boxes[node, 2] * i2
    w0, w1, w2 = boxes[node, 3] * v0, boxes[node, 4] * v1, boxes[node, 5] * v2
    return max(max(a - w0, b - w1), c - w2), min(min(a + w0, b + w1), c + w2)


@kernel
def _met(
    corners: NDArray[np.float32], i: int, view: View, pose: Pose, start: Vec, x: float
) -> float:
    """Return the inverse depth of a triangle along a ray, as `_draw_triangle`; 0: it misses it."""
    c, f, r = pose.center, pose.forward, pose.along
    p0 = (c[0] + corners[i, 0], c[1] + corners[i, 1], c[2] + corners[i, 2])
    p1 = (c[0] + corners[i, 3], c[1] + corners[i, 4], c[2] + corners[i, 5])
    p2 = (c[0] + corners[i, 6], c[1] + corners[i, 7], c[2] + corners[i, 8])
    sides = _sides(p0, p1, p2)
    e0, e1, e2 = (
        dot(sides.n0, start) + x * dot(sides.n0, r),
        dot(sides.n1, start) + x * dot(sides.n1, r),
        dot(sides.n2, start) + x * dot(sides.n2, r),
    )
    if sides.gain == 0.0 or min(min(e0, e1), e2) < -sides.spare:
        return 0.0
    s = sides.gain * (dot(sides.normal, start) + x * dot(sides.normal, r))
    if not view.cylindrical:
        z0, z1, z2 = dot(f, p0), dot(f, p1), dot(f, p2)
        if min(min(z0, z1), z2) > _NEAR:
            g0, g1, g2 = 1.0 / z0, 1.0 / z1, 1.0 / z2
            s = min(max(s, min(min(g0, g1), g2)), max(max(g0, g1), g2))
    return s
