"""Which pixels of an image may see a box, or a triangle, of a mesh."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from airl_mav.camera.projection import Image, Pose, Rectangle, Span, View, cut, cylinder_span, dot
from airl_mav.core.kernels import borrowing_kernel, kernel
from airl_mav.vehicle.rotation import Vec

_MARGIN_PX: Final = 1e-6
"""Rounding of a place in the image is far below this."""

NEAR: Final = 1e-4
"""Corners nearer to the image plane than this are not projected, in units of the mesh."""

NOWHERE: Final = (0, 0, 0, 0)


@borrowing_kernel
def part_of(
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
        return near, NOWHERE
    x, y, wide, high = dot(r, middle), dot(d, middle), _reach(r, half), _reach(d, half)
    return near, between(view, near, far, x - wide, x + wide, y - high, y + high, outer)


@borrowing_kernel
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
def between(
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
    """Return how far a box reaches from its centre along an axis, either way."""
    return abs(half[0] * axis[0]) + abs(half[1] * axis[1]) + abs(half[2] * axis[2])


@kernel
def pixels(
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
