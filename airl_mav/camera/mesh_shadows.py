"""Shadows of meshes on an image's points: parallel rays through their trees.

Rays from meshes begin slightly above the visible side; sides away from the sun need none.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from airl_mav.camera.bvh import STACK, Meshes, material_row
from airl_mav.camera.gloss import Gloss, let_through
from airl_mav.camera.mesh_rays import stopped_by
from airl_mav.camera.mesh_triangles import Faces
from airl_mav.camera.meshes import inverse_of, seen_from
from airl_mav.camera.primitives import OBSTACLE, SKY, Ids, Line, Lines
from airl_mav.camera.projection import Bent, Pose, View, dot, ray_of
from airl_mav.camera.shading import F32, ZERO, Plane
from airl_mav.camera.shadows import along32, ray32, shadow_rectangle, start32, widened
from airl_mav.core.kernels import large_borrowing_kernel, large_kernel
from airl_mav.vehicle.rotation import Vec

ABOVE_M: Final = 5e-4
"""So far above the surface that is seen, and no nearer to its own, a ray begins [m]."""

_WIDER_M: Final = 1e-4
"""The box around a mesh is so much larger, where what is worked out is rounded to float32 [m]."""


@large_kernel
def shade_by_meshes(
    lit: Plane,
    far: Plane,
    ids: Ids,
    faces: Faces,
    corners: NDArray[np.float64],
    lines: Lines,
    xs: Line,
    bent: Bent | None,
    view: View,
    axes: Pose,
    camera: Vec,
    meshes: Meshes,
    to_sun: Vec,
    gloss: Gloss | None,
) -> None:
    """Put the points that meshes hide from the sun into shadow.

    `gloss` has the surfaces' transmission; None: opaque. `faces` (n, m) are the meshes' visible
    triangles; the rest as of `shadows.shade_by_obstacle`.
    """
    waiting, maybe = np.empty(STACK, np.int32), np.empty(len(xs), np.bool_)
    for k in range(len(meshes.root)):
        through = let_through(gloss, material_row(meshes, k))
        _shade_by_mesh(
            lit, far, ids, faces, corners, lines, xs, bent, view, axes, camera, meshes, k, to_sun,
            through, waiting, maybe,
        )  # fmt: skip


@large_borrowing_kernel
def _shade_by_mesh(
    lit: Plane,
    far: Plane,
    ids: Ids,
    faces: Faces,
    corners: NDArray[np.float64],
    lines: Lines,
    xs: Line,
    bent: Bent | None,
    view: View,
    axes: Pose,
    camera: Vec,
    meshes: Meshes,
    k: int,
    to_sun: Vec,
    through: np.float32,
    waiting: NDArray[np.int32],
    maybe: NDArray[np.bool_],
) -> None:
    """Put the points that mesh k hides into shadow but a share `through`; `maybe` is a buffer."""
    bvh, root, scale = meshes.bvh, meshes.root[k], meshes.pose[k, 4]
    cos, sin = meshes.pose[k, 2], meshes.pose[k, 3]
    pose = seen_from(axes, camera, meshes.pose, k)
    sun = (cos * to_sun[0] + sin * to_sun[1], cos * to_sun[1] - sin * to_sun[0], to_sun[2])
    box = bvh.boxes[root]
    half = (float(box[3]), float(box[4]), float(box[5]))
    c = pose.center
    middle = (c[0] + box[0], c[1] + box[1], c[2] + box[2])
    top, bottom, left, end = 0, len(lines), 0, len(xs)
    per = 1.0 / scale
    if bent is None and not view.cylindrical:
        # In units of the mesh, as all that follows.
        floor = -(middle[2] + per * camera[2])
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
    # First which points may be hidden, in float32 and so many at a time.
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
            maybe[u] = reached & (lit_row[u] > ZERO)
        for u in range(end - left):
            if not maybe[u]:
                continue
            t = per * far_row[u]
            ahead, y = lines[v, 0], lines[v, 1]
            begin = (ahead * f[0] + y * d[0], ahead * f[1] + y * d[1], ahead * f[2] + y * d[2])
            ray = ray_of(pose, bent, v, left + u, begin, x_row[u])
            # From the mesh's origin.
            at = (t * ray[0] - c[0], t * ray[1] - c[1], t * ray[2] - c[2])
            if ids_row[u] == own:
                i = faces[v, left + u]
                normal = (bvh.normals[i, 0], bvh.normals[i, 1], bvh.normals[i, 2])
                side = -above if dot(normal, ray) > 0.0 else above
                if side * dot(normal, sun) <= 0.0:
                    continue
                at = (at[0] + side * normal[0], at[1] + side * normal[1], at[2] + side * normal[2])
            last = stopped_by(bvh, root, at, sun, inverse, above, last, waiting)
            if last >= 0:
                lit_row[u] *= through
