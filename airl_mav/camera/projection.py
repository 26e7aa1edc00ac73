"""Where a body falls in the image: the pixel rectangle that bounds its projection."""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from airl_mav.core.kernels import kernel
from airl_mav.vehicle.rotation import Vec

MIN_DEPTH_M: Final = 0.001
"""Least depth of a return [m]: what is nearer reads as this, so that Z16 never rounds it to 0."""

_WIDE: Final = 1e9  # slope of a ray (almost) in the image plane

Image = NDArray[np.float32]
Rectangle = tuple[int, int, int, int]
"""Rows [top, bottom), columns [left, end)."""


class View(NamedTuple):
    """What a pixel looks along, and how far."""

    focal: float
    cx: float
    cy: float
    s_min: float  # inverse of the range


class Pose(NamedTuple):
    """Camera axes, and a body's centre from the camera, along the body's own axes."""

    forward: Vec
    right: Vec
    down: Vec
    center: Vec


@kernel
def dot(a: Vec, b: Vec) -> float:
    """Return the scalar product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@kernel
def _span(forward: float, lateral: float, radius: float) -> tuple[float, float]:
    """Return the slopes lateral / forward of the tangents from the origin to a circle.

    The circle reaches in front of the image plane (forward > -radius).
    """
    square = forward * forward + lateral * lateral - radius * radius
    if square <= 0.0:
        return -_WIDE, _WIDE
    # The centre's direction, turned by -/+ the half angle under which the circle is seen.
    k = math.sqrt(square)
    low, high = forward * k + lateral * radius, forward * k - lateral * radius
    return (
        (lateral * k - forward * radius) / low if low > 0.0 else -_WIDE,
        (lateral * k + forward * radius) / high if high > 0.0 else _WIDE,
    )


@kernel
def _pixels(low: float, high: float, focal: float, c: float, n: int) -> tuple[int, int]:
    """Return the pixels [first, last) of a row or column of n that slopes low..high fall on."""
    first = min(max(math.floor(c + focal * low), 0.0), float(n))
    last = min(max(math.ceil(c + focal * high) + 1.0, 0.0), float(n))
    return int(first), int(last)


@kernel
def bounding_rectangle(out: Image, view: View, pose: Pose, half: Vec, sphere: bool) -> Rectangle:
    """Return the pixels that can see a body; empty when none can.

    Args:
        out: The image.
        view: The camera.
        pose: The camera's axes along the body's, and the body's centre.
        half: Half extents of the body's bounding box along its own axes [m].
        sphere: The body is a sphere of radius half[0].
    """
    f, r, d, c = pose.forward, pose.right, pose.down, pose.center
    z, x, y = dot(f, c), dot(r, c), dot(d, c)
    if sphere:
        reach = radius = half[0]
    else:
        reach = abs(half[0] * f[0]) + abs(half[1] * f[1]) + abs(half[2] * f[2])
        radius = math.sqrt(dot(half, half))
    if z + reach <= 0.0 or (z - reach) * view.s_min > 1.0:
        return 0, 0, 0, 0
    if sphere or z - reach < MIN_DEPTH_M:
        left, right = _span(z, x, radius)
        top, bottom = _span(z, y, radius)
    else:
        left, right, top, bottom = _WIDE, -_WIDE, _WIDE, -_WIDE
        for corner in range(8):
            i = half[0] if corner & 1 else -half[0]
            j = half[1] if corner & 2 else -half[1]
            k = half[2] if corner & 4 else -half[2]
            g = 1.0 / (z + i * f[0] + j * f[1] + k * f[2])
            across = (x + i * r[0] + j * r[1] + k * r[2]) * g
            along = (y + i * d[0] + j * d[1] + k * d[2]) * g
            left, right = min(left, across), max(right, across)
            top, bottom = min(top, along), max(bottom, along)
    u0, u1 = _pixels(left, right, view.focal, view.cx, out.shape[1])
    v0, v1 = _pixels(top, bottom, view.focal, view.cy, out.shape[0])
    return v0, v1, u0, u1
