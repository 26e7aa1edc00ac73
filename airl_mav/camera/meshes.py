"""Inverse depth of meshes along the lines of an image, and hits of single rays.

All rays of an image share one origin, so a node of a mesh's tree is tested against all of them at
once. Candidate rays form the rectangle of the node's projected box, cut to the parent's. A node is
skipped if its rectangle is empty, as for most of a fine distant mesh, or if all of its rays hit
something nearer. Near nodes come before far ones. A single remaining ray traverses the rest alone.
A fisheye's rays are not affine along lines, so each traverses the whole tree alone.

A triangle with the corners a, b and c, relative to the camera, is hit by the ray d if the volumes
d.(b x c), d.(c x a) and d.(a x b) have one sign. A rounding tolerance closes shared edges. Each
volume is affine along a line of the image. The inverse depth is n.d / n.a, n = (b - a) x (c - a).
Both sides are visible.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from airl_mav.camera.bvh import STACK, Bvh, Meshes
from airl_mav.camera.primitives import OBSTACLE, Ids, Rectangles, turned
from airl_mav.camera.projection import (
    Bent,
    Image,
    ImageProjection,
    Line,
    Lines,
    Optics,
    Pose,
    Rectangle,
    Span,
    cut,
    cylinder_span,
    dot,
    fisheye_rectangle,
    ray_of,
)
from airl_mav.core.kernels import borrowing_kernel, kernel, large_borrowing_kernel, large_kernel
from airl_mav.vehicle.rotation import Vec

_LEAST: Final = 1e-12
"""Minimum magnitude of a ray component used as a divisor."""

_MOST_LOOKED_AT: Final = 256
"""Maximum number of pixels for the occlusion test of a node."""


@borrowing_kernel
def seen_from(optics: Optics, pose: NDArray[np.float64], k: int) -> Pose:
    """Return the camera's axes in mesh k's frame, and the mesh's origin, in units of the mesh."""
    axes, camera = optics.axes, optics.camera
    per = 1.0 / pose[k, 4]
    offset = (pose[k, 0] - camera[0], pose[k, 1] - camera[1], pose[k, 5] - camera[2])
    at = (per * offset[0], per * offset[1], per * offset[2])
    return turned(Pose(axes.forward, axes.across, axes.along, at), pose[k, 2], pose[k, 3])


@large_kernel
def draw_meshes(
    out: Image,
    ids: Ids | None,
    faces: Faces | None,
    drawn_in: Rectangles | None,
    optics: Optics,
    bent: Bent | None,
    meshes: Meshes,
) -> None:
    """Draw the meshes of an arena over the present image; arguments as in `raycast.draw_bodies`.

    `bent` is `optics.bent`. `ids`, `faces` and `drawn_in` are all None or all given; `drawn_in` is
    written after the obstacles, in the first row of each mesh.
    """
    # Each pending node has its index and a rectangle.
    waiting = np.empty((STACK, 5), np.int32)
    nearest = np.empty(STACK)
    for k in range(len(meshes.root)):
        kept = None if drawn_in is None else drawn_in[len(meshes.owner) + k, 0]
        if bent is None:
            _draw_mesh(out, ids, faces, kept, optics, meshes, k, waiting, nearest)
        else:
            _cast_mesh(out, ids, faces, kept, optics, bent, meshes, k, waiting)


@large_borrowing_kernel
def _draw_mesh(
    out: Image,
    ids: Ids | None,
    faces: Faces | None,
    drawn_in: Rectangles | None,
    optics: Optics,
    meshes: Meshes,
    k: int,
    waiting: NDArray[np.int32],
    nearest: NDArray[np.float64],
) -> None:
    """Draw mesh k."""
    lines, xs, view, bvh, root = optics.lines, optics.xs, optics.lens, meshes.bvh, meshes.root[k]
    number, scale = OBSTACLE + meshes.first[k], meshes.pose[k, 4]
    pose = seen_from(optics, meshes.pose, k)
    # The range in units of the mesh.
    own = ImageProjection(
        view.focal, view.line_centre, view.pixel_centre, view.s_min * scale, view.cylindrical
    )
    per = 1.0 / scale
    whole = (0, len(lines), 0, len(xs))
    near, part = part_of(out, own, pose, bvh.boxes, root, whole)
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
        # A single ray traverses the rest of the tree without projected boxes.
        if (part[1] - part[0]) * (part[3] - part[2]) == 1:
            v, u = part[0], part[2]
            f, d, ahead, y = pose.forward, pose.across, lines[v, 0], lines[v, 1]
            start = (ahead * f[0] + y * d[0], ahead * f[1] + y * d[1], ahead * f[2] + y * d[2])
            _cast(
                out, ids, faces, number, v, u, start, xs[u], own, pose, bvh, node, per, waiting,
                tops,
            )  # fmt: skip
            continue
        # `per / nearest` is the maximum inverse depth of the node [1/m].
        if _hidden(out, part, per / nearest[tops]):
            continue
        first, count = bvh.links[node, 0], bvh.links[node, 1]
        if count > 0:
            for i in range(first, first + count):
                draw_triangle(
                    out, ids, faces, number, lines, xs, own, pose, bvh.corners, i, part, per
                )
            continue
        left, right = node + 1, first
        near_l, part_l = part_of(out, own, pose, bvh.boxes, left, part)
        near_r, part_r = part_of(out, own, pose, bvh.boxes, right, part)
        if near_l < near_r:
            left, right = right, left
            near_l, near_r, part_l, part_r = near_r, near_l, part_r, part_l
        # The nearer child is on the right; pushed last, it is popped first.
        if part_l[0] < part_l[1] and part_l[2] < part_l[3]:
            _wait(waiting, nearest, tops, left, near_l, part_l)
            tops += 1
        if part_r[0] < part_r[1] and part_r[2] < part_r[3]:
            _wait(waiting, nearest, tops, right, near_r, part_r)
            tops += 1


@large_borrowing_kernel
def _cast_mesh(
    out: Image,
    ids: Ids | None,
    faces: Faces | None,
    drawn_in: Rectangles | None,
    optics: Optics,
    bent: Bent,
    meshes: Meshes,
    k: int,
    waiting: NDArray[np.int32],
) -> None:
    """Draw mesh k with the rays of a fisheye, one by one; other arguments as in `_draw_mesh`."""
    view, bvh, root = optics.lens, meshes.bvh, meshes.root[k]
    number, scale = OBSTACLE + meshes.first[k], meshes.pose[k, 4]
    pose = seen_from(optics, meshes.pose, k)
    # The last argument (cylindrical) disables `met`'s limits, which hold for pinhole depth only.
    own = ImageProjection(view.focal, view.line_centre, view.pixel_centre, view.s_min * scale, True)
    per = 1.0 / scale
    box, c = bvh.boxes[root], pose.center
    half = (float(box[3]), float(box[4]), float(box[5]))
    middle = (c[0] + box[0], c[1] + box[1], c[2] + box[2])
    at = Pose(pose.forward, pose.across, pose.along, middle)
    part = fisheye_rectangle(out, own, bent, at, half, False)
    if drawn_in is not None:
        for side in range(4):
            drawn_in[side] = part[side]
    nowhere = (0.0, 0.0, 0.0)
    for v in range(part[0], part[1]):
        for u in range(part[2], part[3]):
            ray = ray_of(pose, bent, v, u, nowhere, 0.0)
            if dot(ray, ray) == 0.0:
                # A pixel beyond the lens's image circle.
                continue
            _cast(out, ids, faces, number, v, u, ray, 0.0, own, pose, bvh, root, per, waiting, 0)


@borrowing_kernel
def _wait(
    waiting: NDArray[np.int32],
    nearest: NDArray[np.float64],
    at: int,
    node: int,
    near: float,
    part: Rectangle,
) -> None:
    """Push a node, its minimum depth, and its candidate rays."""
    waiting[at, 0] = node
    for side in range(4):
        waiting[at, 1 + side] = part[side]
    nearest[at] = max(near, 1e-12)


@borrowing_kernel
def _hidden(out: Image, part: Rectangle, greatest: float) -> bool:
    """Return True if all pixels of a small part see something nearer than an inverse depth."""
    if (part[1] - part[0]) * (part[3] - part[2]) > _MOST_LOOKED_AT:
        return False
    for v in range(part[0], part[1]):
        for u in range(part[2], part[3]):
            if out[v, u] < greatest:
                return False
    return True


@borrowing_kernel
def _cast(
    out: Image,
    ids: Ids | None,
    faces: Faces | None,
    number: int,
    v: int,
    u: int,
    start: Vec,
    x: float,
    view: ImageProjection,
    pose: Pose,
    bvh: Bvh,
    root: int,
    per: float,
    waiting: NDArray[np.int32],
    tops: int,
) -> None:
    """Draw a ray's hits in a node; the stack starts at `waiting[tops]`."""
    c, r = pose.center, pose.along
    ray = (start[0] + x * r[0], start[1] + x * r[1], start[2] + x * r[2])
    i0, i1, i2 = inverse_of(ray[0]), inverse_of(ray[1]), inverse_of(ray[2])
    begin, inverse = (c[0] * i0, c[1] * i1, c[2] * i2), (i0, i1, i2)
    amounts = (abs(i0), abs(i1), abs(i2))
    boxes, links, corners = bvh.boxes, bvh.links, bvh.corners
    # Distance limit: the present hit, or the end of the range.
    most = 1.0 / max(out[v, u] / per, view.s_min)
    bottom, node = tops, root
    enter, leave = _through(boxes, node, begin, inverse, amounts)
    if not leave >= max(enter, 0.0):
        return
    while True:
        # A hit since the push may be nearer than the node.
        if enter <= most:
            first, count = links[node, 0], links[node, 1]
            if count == 0:
                left, right = node + 1, first
                enter, leave = _through(boxes, left, begin, inverse, amounts)
                enter_r, leave_r = _through(boxes, right, begin, inverse, amounts)
                hit = leave >= max(enter, 0.0) and enter <= most
                hit_r = leave_r >= max(enter_r, 0.0) and enter_r <= most
                if hit and hit_r:
                    # Hits in the nearer child shorten `most` for the other one.
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
                    s = met(corners, i, view, pose, start, x)
                    s32 = np.float32(per * s)
                    if s >= view.s_min and s32 > out[v, u]:
                        out[v, u] = s32
                        most = 1.0 / s
                        if ids is not None:
                            ids[v, u] = number
                        if faces is not None:
                            faces[v, u] = i
        # Nodes below `bottom` belong to the caller.
        if tops == bottom:
            return
        tops -= 1
        node = waiting[tops, 0]
        enter, leave = _through(boxes, node, begin, inverse, amounts)


@kernel
def inverse_of(x: float) -> float:
    """Return the reciprocal of a ray component, finite."""
    return 1.0 / (max(x, _LEAST) if x >= 0.0 else min(x, -_LEAST))


@borrowing_kernel
def _through(
    boxes: NDArray[np.float32], node: int, begin: Vec, inverse: Vec, amounts: Vec
) -> tuple[float, float]:
    """Return the entry and exit distance of a ray through a node's box; exit < entry is a miss.

    `begin` is the mesh's origin relative to the ray's start, divided by the ray; `inverse` is the
    reciprocal of the ray, and `amounts` its absolute value, along the three axes.
    """
    a, b, c = (
        begin[0] + boxes[node, 0] * inverse[0],
        begin[1] + boxes[node, 1] * inverse[1],
        begin[2] + boxes[node, 2] * inverse[2],
    )
    w0, w1, w2 = (
        boxes[node, 3] * amounts[0],
        boxes[node, 4] * amounts[1],
        boxes[node, 5] * amounts[2],
    )
    return max(max(a - w0, b - w1), c - w2), min(min(a + w0, b + w1), c + w2)


# --- single rays: occlusion, and the first hit of a mesh


@borrowing_kernel
def _span_of(boxes: NDArray[np.float32], node: int, at: Vec, inverse: Vec) -> tuple[float, float]:
    """Return the entry and exit distance of a ray through a node's box; exit < entry is a miss."""
    i0, i1, i2 = inverse
    a, b, c = (
        (boxes[node, 0] - at[0]) * i0,
        (boxes[node, 1] - at[1]) * i1,
        (boxes[node, 2] - at[2]) * i2,
    )
    w0, w1, w2 = boxes[node, 3] * abs(i0), boxes[node, 4] * abs(i1), boxes[node, 5] * abs(i2)
    return max(max(a - w0, b - w1), c - w2), min(min(a + w0, b + w1), c + w2)


@borrowing_kernel
def stopped_by(
    bvh: Bvh,
    root: int,
    at: Vec,
    sun: Vec,
    inverse: Vec,
    least: float,
    last: int,
    waiting: NDArray[np.int32],
) -> int:
    """Return a triangle beyond `least` between a point and the sun; -1 = none.

    Arguments as in `distance_to`; `inverse` (3,) is the reciprocal of `sun`, and `last` the
    triangle that hid the previous point, tested first.
    """
    # The triangle that hid the previous point often hides this one too.
    if last >= 0 and _stops(bvh.corners, last, at, sun, least):
        return last
    boxes, links = bvh.boxes, bvh.links
    tops, node = 0, root
    while True:
        enter, leave = _span_of(boxes, node, at, inverse)
        # The first hit ends the search, so the order of the children is free.
        if leave >= max(enter, least):
            count = links[node, 1]
            if count == 0:
                waiting[tops] = links[node, 0]
                tops += 1
                node += 1
                continue
            first = links[node, 0]
            for i in range(first, first + count):
                if _stops(bvh.corners, i, at, sun, least):
                    return i
        if tops == 0:
            return -1
        tops -= 1
        node = waiting[tops]


@borrowing_kernel
def distance_to(
    bvh: Bvh,
    root: int,
    at: Vec,
    way: Vec,
    least: float,
    most: float,
    waiting: NDArray[np.int32],
) -> tuple[float, int]:
    """Return distance and triangle of a ray's first hit in `least`..`most`; -1 = none.

    Distances are in units of the mesh, `at` (3,) is relative to its origin; `waiting` (STACK,) is a
    buffer.
    """
    inverse = (inverse_of(way[0]), inverse_of(way[1]), inverse_of(way[2]))
    boxes, links = bvh.boxes, bvh.links
    tops, node, best, which = 0, root, most, -1
    while True:
        enter, leave = _span_of(boxes, node, at, inverse)
        if leave >= max(enter, least) and enter <= best:
            count = links[node, 1]
            if count == 0:
                waiting[tops] = links[node, 0]
                tops += 1
                node += 1
                continue
            first = links[node, 0]
            for i in range(first, first + count):
                distance = _distance(bvh.corners, i, at, way)
                if least <= distance < best:
                    best, which = distance, i
        if tops == 0:
            return best, which
        tops -= 1
        node = waiting[tops]


@borrowing_kernel
def _stops(corners: NDArray[np.float32], i: int, at: Vec, way: Vec, least: float) -> bool:
    """Return True if a ray hits a triangle, from either side, at `least` or beyond."""
    return _distance(corners, i, at, way) >= least


@borrowing_kernel
def _distance(corners: NDArray[np.float32], i: int, at: Vec, way: Vec) -> float:
    """Return the distance of a triangle along a ray, or minus infinity (Moller, Trumbore, 1997)."""
    p0, p1, p2 = float(corners[i, 0]), float(corners[i, 1]), float(corners[i, 2])
    a0, a1, a2 = corners[i, 3] - p0, corners[i, 4] - p1, corners[i, 5] - p2
    b0, b1, b2 = corners[i, 6] - p0, corners[i, 7] - p1, corners[i, 8] - p2
    h0, h1, h2 = way[1] * b2 - way[2] * b1, way[2] * b0 - way[0] * b2, way[0] * b1 - way[1] * b0
    volume = a0 * h0 + a1 * h1 + a2 * h2
    if volume == 0.0:
        return -math.inf
    # Barycentric coordinates u and v, then the distance.
    per = 1.0 / volume
    s0, s1, s2 = at[0] - p0, at[1] - p1, at[2] - p2
    u = per * (s0 * h0 + s1 * h1 + s2 * h2)
    if u < 0.0 or u > 1.0:
        return -math.inf
    q0, q1, q2 = s1 * a2 - s2 * a1, s2 * a0 - s0 * a2, s0 * a1 - s1 * a0
    v = per * (way[0] * q0 + way[1] * q1 + way[2] * q2)
    if v < 0.0 or u + v > 1.0:
        return -math.inf
    return float(per * (b0 * q0 + b1 * q1 + b2 * q2))


_MARGIN_PX: Final = 1e-6
"""Tolerance for the rounding of image positions."""

NEAR: Final = 1e-4
"""Distance from the image plane below which corners are not projected, in units of the mesh."""

NOWHERE: Final = (0, 0, 0, 0)


@borrowing_kernel
def part_of(
    out: Image,
    view: ImageProjection,
    pose: Pose,
    boxes: NDArray[np.float32],
    node: int,
    outer: Rectangle,
) -> tuple[float, Rectangle]:
    """Return the minimum depth of a node and the pixels within `outer` whose rays may hit it."""
    c = pose.center
    middle = (c[0] + boxes[node, 0], c[1] + boxes[node, 1], c[2] + boxes[node, 2])
    half = (float(boxes[node, 3]), float(boxes[node, 4]), float(boxes[node, 5]))
    if view.cylindrical:
        at = Pose(pose.forward, pose.across, pose.along, middle)
        span = cylinder_span(out, view, at, half, False)
        # `cylinder_span` measures depth in the plane of the cylinder's ring.
        near = math.hypot(dot(pose.forward, middle), dot(pose.across, middle))
        near -= math.sqrt(dot(half, half))
        return near, _around(out, view, span, outer)
    f, r, d = pose.forward, pose.along, pose.across
    z, deep = dot(f, middle), _reach(f, half)
    near, far = z - deep, z + deep
    # Behind the image plane, or beyond the range.
    if far <= 0.0 or near * view.s_min > 1.0:
        return near, NOWHERE
    x, y, wide, high = dot(r, middle), dot(d, middle), _reach(r, half), _reach(d, half)
    return near, between(view, near, far, x - wide, x + wide, y - high, y + high, outer)


@borrowing_kernel
def _around(out: Image, view: ImageProjection, span: Span, outer: Rectangle) -> Rectangle:
    """Return the pixels of a part of a cylinder within a span, at any number of turns."""
    low, high = max(span[2], outer[2]), min(span[3], outer[3])
    if span[0] == 0.0 and span[1] == float(out.shape[0]):
        # The box crosses the cylinder's axis and may be visible in all directions.
        return outer[0], outer[1], low, high
    first, last = outer[1], outer[0]
    for turn in range(-1, 2):
        begin, end, _, _ = cut(out, view, span, turn)
        begin, end = max(begin, outer[0]), min(end, outer[1])
        if begin < end:
            first, last = min(first, begin), max(last, end)
    return first, last, low, high


@kernel
def between(
    view: ImageProjection,
    near: float,
    far: float,
    left: float,
    right: float,
    top: float,
    bottom: float,
    outer: Rectangle,
) -> Rectangle:
    """Return the pixels that see a box along the camera's axes, in front of the image plane."""
    # A side off the axis has its extreme slope at the near depth, otherwise at the far depth.
    per_near, per_far = 1.0 / max(near, NEAR), 1.0 / max(far, NEAR)
    return pixels(
        view,
        left * (per_near if left < 0.0 else per_far),
        right * (per_near if right > 0.0 else per_far),
        top * (per_near if top < 0.0 else per_far),
        bottom * (per_near if bottom > 0.0 else per_far),
        outer,
    )


@kernel
def _reach(axis: Vec, half: Vec) -> float:
    """Return the half extent of a box along an axis."""
    return abs(half[0] * axis[0]) + abs(half[1] * axis[1]) + abs(half[2] * axis[2])


@kernel
def pixels(
    view: ImageProjection, left: float, right: float, top: float, bottom: float, outer: Rectangle
) -> Rectangle:
    """Return the pixels of a part whose centres lie between slopes along and across a line."""
    u_centre, v_centre = view.pixel_centre, view.line_centre
    return (
        max(math.ceil(v_centre + view.focal * top - _MARGIN_PX), outer[0]),
        min(math.floor(v_centre + view.focal * bottom + _MARGIN_PX) + 1, outer[1]),
        max(math.ceil(u_centre + view.focal * left - _MARGIN_PX), outer[2]),
        min(math.floor(u_centre + view.focal * right + _MARGIN_PX) + 1, outer[3]),
    )


_SPARE: Final = 4e-14
"""Tolerance of a volume relative to the squared distance: above rounding, below 1e-9 m."""

_EDGE_ON2: Final = 1e-18
"""Squared angle below which a triangle is invisible."""

Faces = NDArray[np.int32]
"""Index of the visible triangle at each pixel."""


@kernel
def _cross(a: Vec, b: Vec) -> Vec:
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


class _Sides(NamedTuple):
    """Coefficients of the test of a ray d against a triangle.

    The volumes of ray and edges are d.n0, d.n1 and d.n2; a hit requires all of them >= -`spare`,
    for rounding. The inverse depth is gain d.normal; gain 0 = edge on.
    """

    n0: Vec
    n1: Vec
    n2: Vec
    normal: Vec
    gain: float
    spare: float


@kernel
def _sides(p0: Vec, p1: Vec, p2: Vec) -> _Sides:
    """Return the coefficients of the ray test for a triangle's corners relative to the camera."""
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


@borrowing_kernel
def draw_triangle(
    out: Image,
    ids: Ids | None,
    faces: Faces | None,
    number: int,
    lines: Lines,
    xs: Line,
    view: ImageProjection,
    pose: Pose,
    corners: NDArray[np.float32],
    i: int,
    part: Rectangle,
    per: float,
) -> None:
    """Draw a triangle into part of the image; `per` is one metre in units of the mesh."""
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
        # With all corners in front the projection is exact; otherwise the depth range bounds it.
        if near > NEAR:
            g0, g1, g2 = 1.0 / z0, 1.0 / z1, 1.0 / z2
            least, most = min(min(g0, g1), g2), max(max(g0, g1), g2)
            x0, x1, x2 = dot(r, p0) * g0, dot(r, p1) * g1, dot(r, p2) * g2
            y0, y1, y2 = dot(d, p0) * g0, dot(d, p1) * g1, dot(d, p2) * g2
            part = pixels(
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
            part = between(
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
    # The volumes and the inverse depth are affine along a line; only their start changes.
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
                # Limits rounding for a triangle that is almost edge on.
                s = min(max(sides.gain * (start + x * slope), least), most)
                # `s` is in units of the mesh, the image in 1/m.
                s32 = np.float32(per * s)
                if s >= view.s_min and s32 > out[v, u]:
                    out[v, u] = s32
                    if ids is not None:
                        ids[v, u] = number
                    if faces is not None:
                        faces[v, u] = i


@borrowing_kernel
def met(
    corners: NDArray[np.float32], i: int, view: ImageProjection, pose: Pose, start: Vec, x: float
) -> float:
    """Return a triangle's inverse depth along a ray, as `draw_triangle`; 0 = missed.

    Only a pinhole's depth is limited to the range of the corners.
    """
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
        if min(min(z0, z1), z2) > NEAR:
            g0, g1, g2 = 1.0 / z0, 1.0 / z1, 1.0 / z2
            s = min(max(s, min(min(g0, g1), g2)), max(max(g0, g1), g2))
    return s
