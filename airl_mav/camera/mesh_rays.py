"""Single rays through the tree of a mesh: what stops one, and where one meets the mesh first."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from airl_mav.camera.bvh import Bvh
from airl_mav.camera.meshes import inverse_of
from airl_mav.core.kernels import borrowing_kernel
from airl_mav.vehicle.rotation import Vec


@borrowing_kernel
def _through(boxes: NDArray[np.float32], node: int, at: Vec, inverse: Vec) -> tuple[float, float]:
    """Return where a ray from `at`, of component inverses, enters and leaves a node's box.

    It misses the box if it leaves first.
    """
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

    Arguments as of `distance_to`; `inverse` (3,) is one over `sun`, and `last` the triangle that
    hid the previous point, tested first.
    """
    if last >= 0 and _stops(bvh.corners, last, at, sun, least):
        return last
    boxes, links = bvh.boxes, bvh.links
    tops, node = 0, root
    while True:
        enter, leave = _through(boxes, node, at, inverse)
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

    Distances are in units of the mesh, `at` (3,) from its origin; `waiting` (STACK,) is a buffer.
    """
    inverse = (inverse_of(way[0]), inverse_of(way[1]), inverse_of(way[2]))
    boxes, links = bvh.boxes, bvh.links
    tops, node, best, which = 0, root, most, -1
    while True:
        enter, leave = _through(boxes, node, at, inverse)
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
    """Return whether a ray hits a triangle, from either side, no nearer than `least`."""
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
