"""Rasterization of a mesh's triangle into part of an image, and its intersection with a ray.

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

from airl_mav.camera.primitives import Ids
from airl_mav.camera.projection import (
    Image,
    ImageProjection,
    Line,
    Lines,
    Pose,
    Rectangle,
    Span,
    cut,
    cylinder_span,
    dot,
)
from airl_mav.core.kernels import borrowing_kernel, kernel
from airl_mav.vehicle.rotation import Vec

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
