"""Inverse depth of a mesh along the lines of an image; all rays traverse the tree together.

All rays of an image share one origin, so a node of the tree is tested against all of them at once.
Candidate rays form the rectangle of the node's projected box, cut to the parent's. A node is
skipped if its rectangle is empty, as for most of a fine distant mesh, or if all of its rays hit
something nearer. Near nodes come before far ones. A single remaining ray traverses the rest alone.
A fisheye's rays are not affine along lines, so each traverses the whole tree alone.

`mesh_triangles` projects boxes and intersects rays with triangles.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from airl_mav.camera import projection
from airl_mav.camera.bvh import STACK, Bvh, Meshes
from airl_mav.camera.mesh_triangles import Faces, draw_triangle, met, part_of
from airl_mav.camera.primitives import OBSTACLE, Ids, Rectangles, turned
from airl_mav.core.kernels import borrowing_kernel, kernel, large_borrowing_kernel, large_kernel
from airl_mav.vehicle.rotation import Vec

_LEAST: Final = 1e-12
"""Minimum magnitude of a ray component used as a divisor."""

_MOST_LOOKED_AT: Final = 256
"""Maximum number of pixels for the occlusion test of a node."""


@borrowing_kernel
def seen_from(optics: projection.Optics, pose: NDArray[np.float64], k: int) -> projection.Pose:
    """Return the camera's axes in mesh k's frame, and the mesh's origin, in units of the mesh."""
    axes, camera = optics.axes, optics.camera
    per = 1.0 / pose[k, 4]
    offset = (pose[k, 0] - camera[0], pose[k, 1] - camera[1], pose[k, 5] - camera[2])
    at = (per * offset[0], per * offset[1], per * offset[2])
    return turned(
        projection.Pose(axes.forward, axes.across, axes.along, at), pose[k, 2], pose[k, 3]
    )


@large_kernel
def draw_meshes(
    out: projection.Image,
    ids: Ids | None,
    faces: Faces | None,
    drawn_in: Rectangles | None,
    optics: projection.Optics,
    bent: projection.Bent | None,
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
    out: projection.Image,
    ids: Ids | None,
    faces: Faces | None,
    drawn_in: Rectangles | None,
    optics: projection.Optics,
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
    own = projection.ImageProjection(
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
    out: projection.Image,
    ids: Ids | None,
    faces: Faces | None,
    drawn_in: Rectangles | None,
    optics: projection.Optics,
    bent: projection.Bent,
    meshes: Meshes,
    k: int,
    waiting: NDArray[np.int32],
) -> None:
    """Draw mesh k with the rays of a fisheye, one by one; other arguments as in `_draw_mesh`."""
    view, bvh, root = optics.lens, meshes.bvh, meshes.root[k]
    number, scale = OBSTACLE + meshes.first[k], meshes.pose[k, 4]
    pose = seen_from(optics, meshes.pose, k)
    # The last argument (cylindrical) disables `met`'s limits, which hold for pinhole depth only.
    own = projection.ImageProjection(
        view.focal, view.line_centre, view.pixel_centre, view.s_min * scale, True
    )
    per = 1.0 / scale
    box, c = bvh.boxes[root], pose.center
    half = (float(box[3]), float(box[4]), float(box[5]))
    middle = (c[0] + box[0], c[1] + box[1], c[2] + box[2])
    at = projection.Pose(pose.forward, pose.across, pose.along, middle)
    part = projection.fisheye_rectangle(out, own, bent, at, half, False)
    if drawn_in is not None:
        for side in range(4):
            drawn_in[side] = part[side]
    nowhere = (0.0, 0.0, 0.0)
    for v in range(part[0], part[1]):
        for u in range(part[2], part[3]):
            ray = projection.ray_of(pose, bent, v, u, nowhere, 0.0)
            if projection.dot(ray, ray) == 0.0:
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
    part: projection.Rectangle,
) -> None:
    """Push a node, its minimum depth, and its candidate rays."""
    waiting[at, 0] = node
    for side in range(4):
        waiting[at, 1 + side] = part[side]
    nearest[at] = max(near, 1e-12)


@borrowing_kernel
def _hidden(out: projection.Image, part: projection.Rectangle, greatest: float) -> bool:
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
    out: projection.Image,
    ids: Ids | None,
    faces: Faces | None,
    number: int,
    v: int,
    u: int,
    start: Vec,
    x: float,
    view: projection.ImageProjection,
    pose: projection.Pose,
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
