"""Projection of bodies into the image: rectangles or spans of pixels that bound each body.

An image consists of lines: rows of a pinhole, columns of a cylinder. Along each line a pixel's ray
is start + x along, affine in x, so both are drawn by the same loops.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.core.kernels import borrowing_kernel, kernel
from airl_mav.profiles.projections import Distortion, distorted, sees_to
from airl_mav.vehicle.rotation import Vec

MIN_DEPTH_M: Final = 0.001
"""Minimum depth of a return [m]; nearer points read this value, so Z16 never rounds them to 0."""

_WIDE: Final = 1e9  # slope of a ray (almost) in the image plane

Image = NDArray[np.float32]
Line = NDArray[np.float64]
Lines = NDArray[np.float64]
"""(n, 2) components of a line's first ray on the forward axis and the axis across."""

Rectangle = tuple[int, int, int, int]
"""Lines [first, last), pixels of each [begin, end)."""

Span = tuple[float, float, int, int]
"""Lines first..last, before clipping to the image, and pixels of each [begin, end)."""


class ImageProjection(NamedTuple):
    """Projection constants and range of an image."""

    focal: float
    line_centre: float
    pixel_centre: float
    """Pixel of the optical axis on each line."""
    s_min: float  # inverse of the range
    cylindrical: bool


class Pose(NamedTuple):
    """Camera axes, and a body's centre relative to the camera, in the body's axes."""

    forward: Vec
    across: Vec
    """Direction from line to line: down of a pinhole, right of a cylinder."""
    along: Vec
    """Direction along a line: right of a pinhole, down of a cylinder."""
    center: Vec


class Bent(NamedTuple):
    """Unit rays of a tabled projection in `Pose`'s axes; zero outside the field of view."""

    forward: NDArray[np.float64]  # (n, m)
    across: NDArray[np.float64]  # (n, m)
    along: NDArray[np.float64]  # (n, m)
    distortion: Distortion
    sees_to: float
    """Maximum visible angle from the optical axis [rad]."""
    whole: bool
    """True if every body may appear anywhere in the image: the projection has no other bound."""


class LensConstants(NamedTuple):
    """Constants of a camera; a tuple, because compiled loops require one."""

    focal: float
    """Focal length [px] of a pinhole, columns per angle [px/rad] of a cylinder."""
    cx: float
    """Column of the optical axis [px]; pixel centres are at whole numbers."""
    cy: float
    """Row of the optical axis [px]."""
    range_m: float
    """Maximum depth of a return [m]."""
    cylindrical: bool = False
    """True if the image is cylindrical."""
    bent: Bent | None = None
    """Rays of a tabled projection; None = affine along the lines of the image."""


class Optics(NamedTuple):
    """Rays of an image, line by line, and the camera as their origin."""

    lines: Lines
    xs: Line  # (m,) component of each ray of a line on the axis along
    bent: Bent | None  # a fisheye's rays
    lens: ImageProjection
    axes: Pose
    """Camera axes; the centre is unused."""
    camera: Vec
    """Position NED, above the ground [m]."""


class Scene(NamedTuple):
    """Room and the n obstacles of an arena for kernels; fields of `Bounds` and `Obstacles`."""

    bounds: NDArray[np.float64]  # (6,) `Bounds.as_array()`
    shape: NDArray[np.int8]  # (n,)
    center: NDArray[np.float64]  # (n, 3)
    half_size: NDArray[np.float64]  # (n, 3)
    yaw: NDArray[np.float64]  # (n,)


class ProjectedBody(NamedTuple):
    """Obstacle in the world's axes or in its body axes."""

    number: int
    shape: int
    half: Vec
    """Half extents [m]; for spheres and cylinders the radius comes first."""
    yaw: float
    pose: Pose
    """Camera axes, and the centre relative to the camera."""


_distorted = kernel(distorted)


@borrowing_kernel
def ray_of(pose: Pose, bent: Bent | None, v: int, u: int, start: Vec, x: float) -> Vec:
    """Return the ray of pixel u on line v, with the line's `start` and the pixel's offset x."""
    r = pose.along
    if bent is None:
        return start[0] + x * r[0], start[1] + x * r[1], start[2] + x * r[2]
    f, d = pose.forward, pose.across
    i, j, k = bent.forward[v, u], bent.across[v, u], bent.along[v, u]
    return (
        i * f[0] + j * d[0] + k * r[0],
        i * f[1] + j * d[1] + k * r[1],
        i * f[2] + j * d[2] + k * r[2],
    )


@kernel
def dot(a: Vec, b: Vec) -> float:
    """Return the scalar product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@kernel
def _span(forward: float, lateral: float, radius: float) -> tuple[float, float]:
    """Return the slopes lateral / forward of tangents to a circle at least partly in front."""
    square = forward * forward + lateral * lateral - radius * radius
    if square <= 0.0:
        return -_WIDE, _WIDE
    # Direction of the centre, rotated by -/+ the circle's apparent half angle.
    k = math.sqrt(square)
    low, high = forward * k + lateral * radius, forward * k - lateral * radius
    return (
        (lateral * k - forward * radius) / low if low > 0.0 else -_WIDE,
        (lateral * k + forward * radius) / high if high > 0.0 else _WIDE,
    )


@kernel
def _pixels(low: float, high: float, n: int) -> tuple[int, int]:
    """Return the range [first, last) of n pixels between two coordinates."""
    first = min(max(math.floor(low), 0.0), float(n))
    last = min(max(math.ceil(high) + 1.0, 0.0), float(n))
    return int(first), int(last)


@kernel
def _reach(axis: Vec, half: Vec, sphere: bool) -> float:
    """Return the half extent of a body along an axis."""
    if sphere:
        return half[0]
    return abs(half[0] * axis[0]) + abs(half[1] * axis[1]) + abs(half[2] * axis[2])


@borrowing_kernel
def is_pinhole(bent: Bent | None, view: ImageProjection) -> bool:
    """Return True if an image is a pinhole's."""
    return not view.cylindrical if bent is None else False


@borrowing_kernel
def rectangle_of(
    out: Image, bent: Bent | None, view: ImageProjection, pose: Pose, half: Vec, sphere: bool
) -> Rectangle:
    """Return the pixels of a pinhole or fisheye that can see a body; see `pinhole_rectangle`."""
    if bent is None:
        return pinhole_rectangle(out, view, pose, half, sphere)
    return fisheye_rectangle(out, view, bent, pose, half, sphere)


@borrowing_kernel
def pinhole_rectangle(
    out: Image, view: ImageProjection, pose: Pose, half: Vec, sphere: bool
) -> Rectangle:
    """Return the pixels of a pinhole that can see a body; empty if invisible.

    `pose` contains the camera's axes in the body's frame and the body's centre, `half` the half
    extents of its box [m]. A `sphere` has the radius half[0].
    """
    f, r, d, c = pose.forward, pose.along, pose.across, pose.center
    z, x, y = dot(f, c), dot(r, c), dot(d, c)
    reach = _reach(f, half, sphere)
    radius = half[0] if sphere else math.sqrt(dot(half, half))
    # Behind the camera, or beyond the range.
    if z + reach <= 0.0 or (z - reach) * view.s_min > 1.0:
        return 0, 0, 0, 0
    # Corners at or behind the image plane have no projection: use the enclosing sphere.
    if sphere or z - reach < MIN_DEPTH_M:
        left, right = _span(z, x, radius)
        top, bottom = _span(z, y, radius)
    else:
        # All corners are in front of the camera, so their projections bound the body.
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
    u_centre, v_centre = view.pixel_centre, view.line_centre
    u0, u1 = _pixels(u_centre + view.focal * left, u_centre + view.focal * right, out.shape[1])
    v0, v1 = _pixels(v_centre + view.focal * top, v_centre + view.focal * bottom, out.shape[0])
    return v0, v1, u0, u1


@borrowing_kernel
def cylinder_span(out: Image, view: ImageProjection, pose: Pose, half: Vec, sphere: bool) -> Span:
    """Return the pixels of a cylinder that can see a body; arguments as in `pinhole_rectangle`.

    Lines are columns around the body's bearing, to which `cut` adds full turns.
    """
    f, r, d, c = pose.forward, pose.across, pose.along, pose.center
    z, x, y = dot(f, c), dot(r, c), dot(d, c)
    bearing, distance = math.atan2(x, z), math.hypot(x, z)
    cos, sin = math.cos(bearing), math.sin(bearing)
    towards = (cos * f[0] + sin * r[0], cos * f[1] + sin * r[1], cos * f[2] + sin * r[2])
    sideways = (cos * r[0] - sin * f[0], cos * r[1] - sin * f[1], cos * r[2] - sin * f[2])
    reach, lateral = _reach(towards, half, sphere), _reach(sideways, half, sphere)
    vertical = _reach(d, half, sphere)
    near = distance - reach
    if near * view.s_min > 1.0:
        return 0.0, 0.0, 0, 0
    if near < MIN_DEPTH_M:
        # The body may cross the cylinder's axis: above, below or around the camera.
        return 0.0, float(out.shape[0]), 0, out.shape[1]
    # A box is bounded by its full width at its minimum distance.
    half_angle = math.asin(lateral / distance) if sphere else math.atan2(lateral, near)
    far = math.hypot(distance + reach, lateral)
    top, bottom = y - vertical, y + vertical
    # An edge off the axis is steepest at the minimum distance, otherwise at the maximum.
    top = top / near if top < 0.0 else top / far
    bottom = bottom / near if bottom > 0.0 else bottom / far
    centre = view.line_centre + view.focal * bearing
    v0, v1 = _pixels(
        view.pixel_centre + view.focal * top, view.pixel_centre + view.focal * bottom, out.shape[1]
    )
    return centre - view.focal * half_angle, centre + view.focal * half_angle, v0, v1


@borrowing_kernel
def cut(out: Image, view: ImageProjection, span: Span, turns: int) -> Rectangle:
    """Return the part of a span inside the image after a number of full turns."""
    around = turns * 2.0 * math.pi * view.focal
    first, last = _pixels(span[0] + around, span[1] + around, out.shape[0])
    return first, last, span[2], span[3]


@borrowing_kernel
def fisheye_rectangle(
    out: Image, view: ImageProjection, bent: Bent, pose: Pose, half: Vec, sphere: bool
) -> Rectangle:
    """Return the pixels of a fisheye that can see a body; arguments as in `pinhole_rectangle`.

    They bound the ring segment of the sphere around the body.
    """
    f, r, d, c = pose.forward, pose.along, pose.across, pose.center
    z, x, y = dot(f, c), dot(r, c), dot(d, c)
    aside, distance = math.hypot(x, y), math.sqrt(dot(c, c))
    radius = half[0] if sphere else math.sqrt(dot(half, half))
    if (distance - radius) * view.s_min > 1.0:
        return 0, 0, 0, 0
    # The camera is inside the enclosing sphere.
    if distance <= radius or bent.whole:
        return 0, out.shape[0], 0, out.shape[1]
    off, spread = math.atan2(aside, z), math.asin(radius / distance)
    inner, outer = _way_out(view, bent, off - spread), _way_out(view, bent, off + spread)
    # A sphere across the optical axis covers a disk, any other one a ring sector.
    left, right, top, bottom = -outer, outer, -outer, outer
    if off > spread and off + spread < math.pi:
        # Half of the angle about the optical axis that the body covers.
        turn = math.asin(min(math.sin(spread) / math.sin(off), 1.0))
        plane = math.atan2(y, x)
        left, right = _reached(plane - turn, plane + turn, inner, outer)
        quarter = 0.5 * math.pi
        top, bottom = _reached(plane - turn - quarter, plane + turn - quarter, inner, outer)
    u_centre, v_centre = view.pixel_centre, view.line_centre
    u0, u1 = _pixels(u_centre + left, u_centre + right, out.shape[1])
    v0, v1 = _pixels(v_centre + top, v_centre + bottom, out.shape[0])
    return v0, v1, u0, u1


@borrowing_kernel
def _way_out(view: ImageProjection, bent: Bent, angle: float) -> float:
    """Return the distance of an angle from the middle of a fisheye's image [px], within its rim."""
    rim = bent.sees_to
    return view.focal * _distorted(min(max(angle, -rim), rim), bent.distortion)


@kernel
def _reached(first: float, last: float, inner: float, outer: float) -> tuple[float, float]:
    """Return the extent of a ring sector, between two angles, along the axis of angle 0."""
    turn = 2.0 * math.pi
    # Extremes of the cosine: at the ends, or 1 and -1 inside the interval.
    high = max(math.cos(first), math.cos(last))
    low = min(math.cos(first), math.cos(last))
    if math.floor(last / turn) >= math.ceil(first / turn):
        high = 1.0
    if math.floor(last / turn - 0.5) >= math.ceil(first / turn - 0.5):
        low = -1.0
    return (
        (outer if low < 0.0 else inner) * low,
        (outer if high > 0.0 else inner) * high,
    )


@lru_cache(maxsize=64)
def _bent_of(camera: Intrinsics) -> Bent:
    """Return the rays of a camera whose projection is tabled."""
    forward, right, down = np.ascontiguousarray(camera.rays)
    # Plain floats, so that only one variant is compiled.
    k1, k2, k3, k4 = (float(each) for each in camera.distortion)
    rim, whole = sees_to(camera.distortion), not camera.model.radial
    return Bent(forward, down, right, (k1, k2, k3, k4), rim, whole)


def lens_of(camera: Intrinsics, range_m: float) -> LensConstants:
    """Return the lens of a camera with a range [m], as an argument of kernels."""
    k, model = camera, camera.model
    # Plain floats, so that only one variant is compiled.
    constants = (float(k.focal), float(k.cx), float(k.cy), float(range_m))
    return LensConstants(*constants, model.cylindrical, _bent_of(k) if model.tabled else None)
