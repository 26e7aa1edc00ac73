"""Meshes in colour, where the image sees them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from airl_mav.camera import shading
from airl_mav.camera.bvh import Meshes, material_row
from airl_mav.camera.mesh_triangles import Faces
from airl_mav.camera.patterns import STEEP, on_triangle, texels2
from airl_mav.camera.primitives import OBSTACLE, Ids, Line, Lines, Rectangles, turned
from airl_mav.camera.projection import Bent, Pose
from airl_mav.camera.shadows import along32, ray32, start32
from airl_mav.camera.surfaces import span_of
from airl_mav.core.kernels import large_borrowing_kernel
from airl_mav.vehicle.rotation import Vec


@large_borrowing_kernel
def shade_meshes(
    out: shading.Packed,
    ids: Ids,
    far: shading.Plane,
    lit: shading.Plane,
    clear: shading.Plane,
    points: shading.Points,
    rectangles: Rectangles,
    meshes: Meshes,
    faces: Faces,
    lines: Lines,
    xs: Line,
    bent: Bent | None,
    axes: Pose,
    camera: Vec,
    texture: NDArray[np.int8],
    per_m: NDArray[np.float32],
    offset: NDArray[np.float32],
    albedo: NDArray[np.float32],
    light: shading.Lit,
    atlas: shading.Plane,
    pixel2: np.float32,
) -> None:
    """Shade the visible flat triangles of meshes, with a pattern along the nearest mesh axis.

    `out` (n,) packed colours are written. `far`, `lit`, `clear`, `points`, `light` and `atlas` are
    as of `shading.paint`, `rectangles`, `faces`, `lines`, `xs`, `bent`, `axes` and `camera` as of
    `raycast.draw_bodies`, the materials as of `colour.render_colour`; `pixel2` is the square of the
    side of a pixel at a depth of 1.
    """
    for k in range(len(meshes.first)):
        rectangle = rectangles[len(meshes.owner) + k, 0]
        surface = shading.surface_of(texture, per_m, offset, albedo, material_row(meshes, k))
        _shade_mesh(
            out, ids, far, lit, clear, points, rectangle, meshes, k, faces, lines, xs, bent, axes,
            camera, surface, light, atlas, pixel2,
        )  # fmt: skip


@large_borrowing_kernel
def _shade_mesh(
    out: shading.Packed,
    ids: Ids,
    far: shading.Plane,
    lit: shading.Plane,
    clear: shading.Plane,
    points: shading.Points,
    rectangle: NDArray[np.int32],
    meshes: Meshes,
    k: int,
    faces: Faces,
    lines: Lines,
    xs: Line,
    bent: Bent | None,
    axes: Pose,
    camera: Vec,
    surface: shading.Surface,
    light: shading.Lit,
    atlas: shading.Plane,
    pixel2: np.float32,
) -> None:
    """Shade what is seen of mesh k in a rectangle (4,) of the image."""
    cos, sin = meshes.pose[k, 2], meshes.pose[k, 3]
    offset = (
        meshes.pose[k, 0] - camera[0],
        meshes.pose[k, 1] - camera[1],
        meshes.pose[k, 5] - camera[2],
    )
    pose = turned(Pose(axes.forward, axes.across, axes.along, offset), cos, sin)
    c0, c1, c2 = (
        shading.F32(pose.center[0]),
        shading.F32(pose.center[1]),
        shading.F32(pose.center[2]),
    )
    r = along32(pose)
    s0 = shading.F32(cos * light.to_sun[0] + sin * light.to_sun[1])
    s1 = shading.F32(cos * light.to_sun[1] - sin * light.to_sun[0])
    s2 = light.to_sun[2]
    texel, per_m = texels2(surface, pixel2), surface.per_m
    begin_u, begin_v = surface.offset[0], surface.offset[1]
    normals = meshes.bvh.normals
    own = shading.I32(OBSTACLE + meshes.first[k])
    for v in range(rectangle[0], rectangle[1]):
        line = v * len(xs)
        low, high = line + rectangle[2], line + rectangle[3]
        left, end = span_of(ids, line, line + len(xs), low, high, own, own)
        if end == 0:
            continue
        start = start32(pose, lines[v, 0], lines[v, 1])
        for at in range(left, end):
            u = at - left
            if ids[at] != own:
                # It is not painted; its place must only be one of the pattern.
                points.place[u] = shading.I32(1)
                continue
            t, i = far[at], faces[at]
            n, e, d = ray32(pose, r, bent, v, at - line, start, shading.F32(xs[at - line]))
            n0, n1, n2 = normals[i, 0], normals[i, 1], normals[i, 2]
            normal = n0 * n + n1 * e + n2 * d
            # The side that is seen faces the camera.
            side = -shading.ONE if normal > shading.ZERO else shading.ONE
            a, b, c = t * n - c0, t * e - c1, t * d - c2
            across, along = on_triangle(a, b, c, n0, n1, n2)
            texels = texel * t * t / max(abs(normal), STEEP)
            points.place[u] = shading.texel_at(
                across * per_m + begin_u, along * per_m + begin_v, texels
            )
            points.facing[u] = max(side * (n0 * s0 + n1 * s1 + n2 * s2), shading.ZERO)
            points.up[u] = -side * n2
        shading.paint(out, ids, lit, clear, left, end, own, own, points, surface, light, atlas)
