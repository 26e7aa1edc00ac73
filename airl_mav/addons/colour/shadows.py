"""Shadows of the sun in an image.

Shadows are drawn body by body: an obstacle's shadow touches only the projected rectangle of its
shadow volume, the body extruded along the light to the floor. A convex body's dark side faces away
from the sun, so bodies are not tested against themselves and need no shadow bias. Meshes cast
shadows by parallel rays through their trees.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from airl_mav.addons.colour.shading import (
    F32,
    ONE,
    ZERO,
    Canvas,
    Gloss,
    Plane,
    Vec32,
    let_through,
    material_row,
)
from airl_mav.camera.bvh import STACK, Meshes
from airl_mav.camera.meshes import Faces, inverse_of, seen_from, stopped_by
from airl_mav.camera.primitives import BOX, CYLINDER, OBSTACLE, SKY, Ids, turned
from airl_mav.camera.projection import (
    Bent,
    ImageProjection,
    Optics,
    Pose,
    ProjectedBody,
    Rectangle,
    dot,
    is_pinhole,
    ray_of,
)
from airl_mav.core.kernels import borrowing_kernel, kernel, large_borrowing_kernel, large_kernel
from airl_mav.vehicle.rotation import Vec

_NEAR_M: Final = 0.01
"""Near clipping distance of a shadow volume from the image plane [m]."""

_STEP_M: Final = F32(1e-3)
"""Distance below which a point in front of a wall, towards the sun, lies on it [m]."""

VECTOR: Final = 16
"""Pixels per vector operation."""

CORNERS: Final = 16
"""Number of corners of a shadow volume: the body's box, then its projection onto the floor."""


ABOVE_M: Final = 5e-4
"""Offset of a ray's start above the surface, and minimum distance of hits [m]."""

_WIDER_M: Final = 1e-4
"""Margin of the box around a mesh against rounding to float32 [m]."""


@kernel
def sized(value: float) -> float:
    """Return a component of a direction, limited away from 0 for use as a divisor."""
    least = 1e-6
    return max(value, least) if value >= 0.0 else min(value, -least)


@kernel
def widened(left: int, end: int, low: int, high: int) -> tuple[int, int]:
    """Return the pixels left..end, extended within low..high to whole vectors.

    A vectorized loop runs its remainder one by one. Vectors begin at the first pixel: a few pixels
    across an aligned boundary would need two.
    """
    whole = end - left + (left - end) % VECTOR
    first = max(min(left, high - whole), low)
    return first, min(first + whole, high)


@borrowing_kernel
def shade_by_walls(
    canvas: Canvas,
    camera: Vec,
    bounds: NDArray[np.float64],
    to_sun: Vec,
    extinction: float,
    through: np.float32,
) -> None:
    """Write the sunlight `lit` past the walls, and the fog's transmission `clear`.

    `extinction` is the fog's [1/m], `through` the transmission of the walls, 0 except for glass.
    """
    lit, clear, far, rays = canvas.lit, canvas.clear, canvas.far, canvas.rays
    north, east, up = sized(to_sun[0]), sized(to_sun[1]), F32(-to_sun[2])
    # From the camera to the walls on the sun's side.
    edge_n = F32((bounds[1] if north > 0.0 else bounds[0]) - camera[0])
    edge_e = F32((bounds[3] if east > 0.0 else bounds[2]) - camera[1])
    per_n, per_e = F32(1.0 / north), F32(1.0 / east)
    above, height = F32(-camera[2]), F32(bounds[4])
    for u in range(len(far)):
        t = far[u]
        n, e, d = t * rays.north[u], t * rays.east[u], t * rays.down[u]
        # Distance to the first wall towards the sun, and the height above the floor there.
        run = min((edge_n - n) * per_n, (edge_e - e) * per_e)
        over = above - d + run * up
        lit[u] = through if (run > _STEP_M and over < height) else ONE
        clear[u] = ONE
    if extinction > 0.0:
        for u in range(len(far)):
            t = far[u]
            n, e, d = t * rays.north[u], t * rays.east[u], t * rays.down[u]
            clear[u] = math.exp(-extinction * math.sqrt(n * n + e * e + d * d))


@kernel
def start32(axes: Pose, ahead: float, y: float) -> Vec32:
    """Return a line's ray at x = 0."""
    f, d = axes.forward, axes.across
    return (
        F32(ahead * f[0] + y * d[0]),
        F32(ahead * f[1] + y * d[1]),
        F32(ahead * f[2] + y * d[2]),
    )


@kernel
def along32(pose: Pose) -> Vec32:
    """Return the axis along a line in float32."""
    r = pose.along
    return F32(r[0]), F32(r[1]), F32(r[2])


@borrowing_kernel
def ray32(
    pose: Pose, along: Vec32, bent: Bent | None, v: int, u: int, start: Vec32, x: np.float32
) -> Vec32:
    """Return the ray of pixel u on line v in float32; see `projection.ray_of`."""
    if bent is None:
        return start[0] + x * along[0], start[1] + x * along[1], start[2] + x * along[2]
    n, e, d = ray_of(pose, bent, v, u, (0.0, 0.0, 0.0), 0.0)
    return F32(n), F32(e), F32(d)


class Shaded(NamedTuple):
    """Image during shadow rendering, line by line."""

    lit: Plane  # (n, m) written
    far: Plane  # (n, m) depth [m]
    ids: Ids  # (n, m) segmentation
    corners: NDArray[np.float64]  # (CORNERS, 3) a buffer


@borrowing_kernel
def shade_by_obstacle(
    image: Shaded, optics: Optics, body: ProjectedBody, to_sun: Vec, through: np.float32
) -> None:
    """Multiply `lit` by `through` where an obstacle hides the sun (unit vector NED)."""
    lit, far, ids, corners = image
    lines, xs, bent, view = optics.lines, optics.xs, optics.bent, optics.lens
    shape, half, world = body.shape, body.half, body.pose
    level = math.sqrt(to_sun[0] * to_sun[0] + to_sun[1] * to_sun[1])
    # A box keeps its axes; a round body turns to the sun's azimuth.
    cos, sin = 1.0, 0.0
    if shape == BOX:
        cos, sin = math.cos(body.yaw), math.sin(body.yaw)
    elif level > 0.0:
        cos, sin = to_sun[0] / level, to_sun[1] / level
    pose = turned(world, cos, sin)
    sun = (cos * to_sun[0] + sin * to_sun[1], cos * to_sun[1] - sin * to_sun[0], to_sun[2])
    top, bottom, left, end = 0, len(lines), 0, len(xs)
    # Only a pinhole bounds the shadow by a rectangle; other images test every pixel.
    if is_pinhole(bent, view):
        floor = -(world.center[2] + optics.camera[2])
        top, bottom, left, end = shadow_rectangle(
            corners, len(lines), len(xs), view, pose, half, sun, floor
        )
    if top >= bottom or left >= end:
        return
    left, end = widened(left, end, 0, len(xs))
    f, c, along = pose, pose.center, along32(pose)
    c0, c1, c2 = F32(c[0]), F32(c[1]), F32(c[2])
    s0, s1, s2 = F32(sun[0]), F32(sun[1]), F32(sun[2])
    # Slab test along the sun: inverse direction, and half thickness along it.
    i0, i1, i2 = F32(1.0 / sized(sun[0])), F32(1.0 / sized(sun[1])), F32(1.0 / sized(sun[2]))
    w0, w1, w2 = F32(half[0]) * abs(i0), F32(half[1]) * abs(i1), F32(half[2]) * abs(i2)
    square, per_level = F32(half[0] * half[0]), F32(1.0 / max(level, 1e-6))
    own = np.int32(OBSTACLE + body.number)
    for v in range(top, bottom):
        start = start32(f, lines[v, 0], lines[v, 1])
        far_row, ids_row, lit_row = far[v, left:end], ids[v, left:end], lit[v, left:end]
        x_row = xs[left:end]
        if shape == BOX:
            for u in range(end - left):
                t = far_row[u]
                n, e, s = ray32(f, along, bent, v, left + u, start, F32(x_row[u]))
                a = (c0 - t * n) * i0
                b = (c1 - t * e) * i1
                d = (c2 - t * s) * i2
                enter = max(max(a - w0, b - w1), d - w2)
                leave = min(min(a + w0, b + w1), d + w2)
                hidden = (leave >= max(enter, ZERO)) & (ids_row[u] != own)
                lit_row[u] = through * lit_row[u] if hidden else lit_row[u]
        elif shape == CYLINDER:
            for u in range(end - left):
                t = far_row[u]
                n, e, s = ray32(f, along, bent, v, left + u, start, F32(x_row[u]))
                # The first axis points to the sun's azimuth, so seen from above the light is along
                # it.
                a = c0 - t * n
                b = c1 - t * e
                d = (c2 - t * s) * i2
                rest = square - b * b
                chord = np.sqrt(max(rest, ZERO))
                enter = max((a - chord) * per_level, d - w2)
                leave = min((a + chord) * per_level, d + w2)
                stopped = (leave >= max(enter, ZERO)) & (rest > ZERO)
                hidden = stopped & (ids_row[u] != own)
                lit_row[u] = through * lit_row[u] if hidden else lit_row[u]
        else:
            for u in range(end - left):
                t = far_row[u]
                n, e, s = ray32(f, along, bent, v, left + u, start, F32(x_row[u]))
                a = c0 - t * n
                b = c1 - t * e
                d = c2 - t * s
                # Distance of the line to the sun from the centre, which must lie towards the sun.
                toward = a * s0 + b * s1 + d * s2
                apart = a * a + b * b + d * d - toward * toward
                hidden = (apart < square) & (toward > ZERO) & (ids_row[u] != own)
                lit_row[u] = through * lit_row[u] if hidden else lit_row[u]


@borrowing_kernel
def shadow_rectangle(
    corners: NDArray[np.float64],
    n_lines: int,
    n_pixels: int,
    view: ImageProjection,
    pose: Pose,
    half: Vec,
    sun: Vec,
    floor: float,
) -> Rectangle:
    """Return the pixels of a pinhole covered by an obstacle's shadow volume.

    `pose` contains the camera's axes in the body's frame and the body's centre relative to the
    camera, `half` the half extents of its box [m], `sun` the unit vector in the body's axes,
    `floor` the depth of the floor below its centre [m]; `corners` (CORNERS, 3) is a buffer.
    """
    c = pose.center
    nearest, farthest = math.inf, -math.inf
    for k in range(8):
        i = half[0] if k & 1 else -half[0]
        j = half[1] if k & 2 else -half[1]
        m = half[2] if k & 4 else -half[2]
        # `sun` points up, so the factor is negative: away from the sun.
        fall = max(floor - m, 0.0) / sun[2]
        for down in range(2):
            if down:
                i, j, m = i + fall * sun[0], j + fall * sun[1], m + fall * sun[2]
            p = (c[0] + i, c[1] + j, c[2] + m)
            z = dot(pose.forward, p)
            at = k + 8 * down
            corners[at, 0], corners[at, 1], corners[at, 2] = (
                z,
                dot(pose.along, p),
                dot(pose.across, p),
            )
            nearest, farthest = min(nearest, z), max(farthest, z)
    if farthest <= _NEAR_M:
        return 0, 0, 0, 0
    low_x, high_x, low_y, high_y = math.inf, -math.inf, math.inf, -math.inf
    for k in range(CORNERS):
        z = corners[k, 0]
        if z >= _NEAR_M:
            x, y = corners[k, 1] / z, corners[k, 2] / z
            low_x, high_x = min(low_x, x), max(high_x, x)
            low_y, high_y = min(low_y, y), max(high_y, y)
    if nearest < _NEAR_M:
        # The volume crosses the image plane: clip its edges. The corners of an edge differ in one
        # bit; bit 3 is the extrusion along the light.
        for k in range(CORNERS):
            for bit in range(4):
                m = k ^ (1 << bit)
                z, other = corners[k, 0], corners[m, 0]
                if z >= _NEAR_M > other:
                    share = (z - _NEAR_M) / (z - other)
                    x = (corners[k, 1] + share * (corners[m, 1] - corners[k, 1])) / _NEAR_M
                    y = (corners[k, 2] + share * (corners[m, 2] - corners[k, 2])) / _NEAR_M
                    low_x, high_x = min(low_x, x), max(high_x, x)
                    low_y, high_y = min(low_y, y), max(high_y, y)
    return (
        _first(view.line_centre + view.focal * low_y, n_lines),
        _last(view.line_centre + view.focal * high_y, n_lines),
        _first(view.pixel_centre + view.focal * low_x, n_pixels),
        _last(view.pixel_centre + view.focal * high_x, n_pixels),
    )


@kernel
def _first(low: float, n: int) -> int:
    """Return the first of n pixels of a range that starts at a coordinate."""
    return int(min(max(math.floor(low), 0.0), float(n)))


@kernel
def _last(high: float, n: int) -> int:
    """Return the end of the pixels of a range that ends at a coordinate."""
    return int(min(max(math.ceil(high) + 1.0, 0.0), float(n)))


@large_kernel
def shade_by_meshes(
    image: Shaded, optics: Optics, meshes: Meshes, faces: Faces, to_sun: Vec, gloss: Gloss | None
) -> None:
    """Put the points that meshes hide from the sun into shadow.

    Rays from meshes begin slightly above the visible side. Sides away from the sun need none.
    `faces` (n, m) are the meshes' visible triangles; `gloss` contains the surfaces' transmission,
    None = opaque.
    """
    waiting, maybe = np.empty(STACK, np.int32), np.empty(len(optics.xs), np.bool_)
    for k in range(len(meshes.root)):
        through = let_through(gloss, material_row(meshes, k))
        _shade_by_mesh(image, optics, meshes, k, faces, to_sun, through, waiting, maybe)


@large_borrowing_kernel
def _shade_by_mesh(
    image: Shaded,
    optics: Optics,
    meshes: Meshes,
    k: int,
    faces: Faces,
    to_sun: Vec,
    through: np.float32,
    waiting: NDArray[np.int32],
    maybe: NDArray[np.bool_],
) -> None:
    """Multiply `lit` by `through` at points hidden by mesh k; `maybe` is a buffer."""
    lit, far, ids, corners = image
    lines, xs, bent, view = optics.lines, optics.xs, optics.bent, optics.lens
    bvh, root, scale = meshes.bvh, meshes.root[k], meshes.pose[k, 4]
    cos, sin = meshes.pose[k, 2], meshes.pose[k, 3]
    pose = seen_from(optics, meshes.pose, k)
    sun = (cos * to_sun[0] + sin * to_sun[1], cos * to_sun[1] - sin * to_sun[0], to_sun[2])
    box = bvh.boxes[root]
    half = (float(box[3]), float(box[4]), float(box[5]))
    c = pose.center
    middle = (c[0] + box[0], c[1] + box[1], c[2] + box[2])
    top, bottom, left, end = 0, len(lines), 0, len(xs)
    per = 1.0 / scale
    if is_pinhole(bent, view):
        # In units of the mesh, as below.
        floor = -(middle[2] + per * optics.camera[2])
        around = Pose(pose.forward, pose.across, pose.along, middle)
        top, bottom, left, end = shadow_rectangle(
            corners, len(lines), len(xs), view, around, half, sun, floor
        )
    if top >= bottom or left >= end:
        return
    left, end = widened(left, end, 0, len(xs))
    inverse = (inverse_of(sun[0]), inverse_of(sun[1]), inverse_of(sun[2]))
    own = np.int32(OBSTACLE + meshes.first[k])
    f, d, along = pose.forward, pose.across, along32(pose)
    above, last = per * ABOVE_M, -1
    # First find candidates by a vectorized float32 test.
    c0, c1, c2 = F32(middle[0]), F32(middle[1]), F32(middle[2])
    per32 = F32(per)
    i0, i1, i2 = F32(inverse[0]), F32(inverse[1]), F32(inverse[2])
    wide = per * _WIDER_M
    w0, w1, w2 = (
        F32((half[0] + wide) * abs(inverse[0])),
        F32((half[1] + wide) * abs(inverse[1])),
        F32((half[2] + wide) * abs(inverse[2])),
    )
    for v in range(top, bottom):
        start = start32(pose, lines[v, 0], lines[v, 1])
        far_row, ids_row, lit_row = far[v, left:end], ids[v, left:end], lit[v, left:end]
        x_row = xs[left:end]
        for u in range(end - left):
            t = per32 * far_row[u]
            n, m, s = ray32(pose, along, bent, v, left + u, start, F32(x_row[u]))
            a = (c0 - t * n) * i0
            b = (c1 - t * m) * i1
            e = (c2 - t * s) * i2
            enter = max(max(a - w0, b - w1), e - w2)
            leave = min(min(a + w0, b + w1), e + w2)
            reached = (leave >= max(enter, ZERO)) & (ids_row[u] != SKY)
            # Points in full shadow need no exact test.
            maybe[u] = reached & (lit_row[u] > ZERO)
        for u in range(end - left):
            if not maybe[u]:
                continue
            t = per * far_row[u]
            ahead, y = lines[v, 0], lines[v, 1]
            begin = (ahead * f[0] + y * d[0], ahead * f[1] + y * d[1], ahead * f[2] + y * d[2])
            ray = ray_of(pose, bent, v, left + u, begin, x_row[u])
            # Relative to the mesh's origin.
            at = (t * ray[0] - c[0], t * ray[1] - c[1], t * ray[2] - c[2])
            if ids_row[u] == own:
                # Start above the visible side; a side away from the sun is dark without a test.
                i = faces[v, left + u]
                normal = (bvh.normals[i, 0], bvh.normals[i, 1], bvh.normals[i, 2])
                side = -above if dot(normal, ray) > 0.0 else above
                if side * dot(normal, sun) <= 0.0:
                    continue
                at = (at[0] + side * normal[0], at[1] + side * normal[1], at[2] + side * normal[2])
            last = stopped_by(bvh, root, at, sun, inverse, above, last, waiting)
            if last >= 0:
                lit_row[u] *= through
