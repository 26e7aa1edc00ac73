"""Colour image of an arena: bodies of `raycast`, then shadows, then what each body looks like.

One ray a pixel. Like depth it is drawn obstacle by obstacle: each shades the pixels of its
rectangles that see it. Depth, light and colour of the lines are planes of 32 bits, so that every
loop along a line vectorises.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from airl_mav.arena.appearance import FLOOR as FLOOR_ROW
from airl_mav.arena.appearance import OBSTACLE as OBSTACLE_ROW
from airl_mav.arena.appearance import WALLS as WALLS_ROW
from airl_mav.camera import surfaces
from airl_mav.camera.bvh import Meshes, count_of, is_owned, raised
from airl_mav.camera.gloss import Gloss, let_through
from airl_mav.camera.mesh_shadows import shade_by_meshes
from airl_mav.camera.mesh_surfaces import shade_meshes
from airl_mav.camera.mesh_triangles import Faces
from airl_mav.camera.primitives import FLOOR, GROUND, OBSTACLE, SKY, Ids, Rectangles
from airl_mav.camera.projection import MIN_DEPTH_M, Bent, Pose, View
from airl_mav.camera.ray_ends import Look
from airl_mav.camera.raycast import aim, blank, draw_bodies, invert
from airl_mav.camera.reflections import draw_reflections
from airl_mav.camera.shading import F32, ZERO, Lit, Packed, Plane, Points, Rays, surface_of
from airl_mav.camera.shadows import CORNERS, shade_by_obstacle, shade_by_walls
from airl_mav.core.kernels import borrowing_kernel, kernel
from airl_mav.vehicle.rotation import Quat, Vec

U32 = np.uint32

RANGE_M: Final = 10_000.0
"""How far a colour camera sees [m]: beyond every arena."""


class Work(NamedTuple):
    """Room to work in for images of n lines of m pixels; nothing in it outlasts a call."""

    lines: NDArray[np.float64]  # (n, 2)
    xs: NDArray[np.float64]  # (m,)
    far: Plane  # (n, m)
    ids: Ids  # (n, m)
    lit: Plane  # (n, m)
    clear: Plane  # (n, m)
    out: Packed  # (n m,)
    rays: Rays
    points: Points
    corners: NDArray[np.float64]  # (CORNERS, 3)

    @classmethod
    def of(cls, width: int, height: int, cylindrical: bool) -> Work:
        """Return the room for images of a size; lines are rows, or columns of a cylinder."""
        n, m = (width, height) if cylindrical else (height, width)
        block = max(surfaces.BLOCK, m)

        def floats(*shape: int) -> Plane:
            return np.zeros(shape, np.float32)

        return cls(
            np.zeros((n, 2)),
            np.zeros(m),
            floats(n, m),
            np.zeros((n, m), np.int32),
            floats(n, m),
            floats(n, m),
            np.zeros(n * m, np.int32),
            Rays(floats(n * m), floats(n * m), floats(n * m)),
            Points(np.zeros(block, np.int32), *(floats(block) for _ in range(5))),
            np.zeros((CORNERS, 3)),
        )


@kernel
def render_colour(
    rgb: NDArray[np.uint8],
    depth: Plane,
    seen: Ids,
    work: Work,
    position: Vec | NDArray[np.float64],
    quaternion: Quat | NDArray[np.float64],
    focal: float,
    cx: float,
    cy: float,
    cylindrical: bool,
    bounds: NDArray[np.float64],
    shape: NDArray[np.int8],
    center: NDArray[np.float64],
    half_size: NDArray[np.float64],
    yaw: NDArray[np.float64],
    meshes: Meshes | None,
    texture: NDArray[np.int8],
    per_m: NDArray[np.float32],
    offset: NDArray[np.float32],
    albedo: NDArray[np.float32],
    gloss: Gloss | None,
    lights: NDArray[np.float32],
    atlas: Plane,
    bent: Bent | None,
) -> None:
    """Render the colour image of an arena; arguments not listed as of `render_depth`.

    `rgb` (height, width, 3) sRGB, `depth` (height, width) unlimited [m], 0 = no surface, and `seen`
    are written; the image is black from inside an obstacle. `seen` is CEILING, SKY, ... of
    `primitives`, FLOOR also for hills, OBSTACLE + the number of an obstacle or of a mesh's first.
    `texture` (2 + n,), `offset` (2 + n, 2) and `albedo` (2 + n, 2, 3) are those of `Finish`,
    `per_m` (2 + n,) periods of the pattern per metre, `atlas` is `textures.atlas()`. `gloss`
    describes surfaces that are not matt; None costs nothing. `lights` (7, 3): direction of the sun,
    its irradiance, that of the sky, the floor's mean radiosity, zenith, horizon, and the fog's
    extinction [1/m] in the first column.
    """
    camera = raised(meshes, position)
    lines, xs = work.lines, work.xs
    view, axes = aim(lines, xs, quaternion, focal, cx, cy, cylindrical, RANGE_M)
    far, ids = (work.far, work.ids) if cylindrical else (depth, seen)
    rectangles = np.zeros((len(shape) + count_of(meshes), 3, 4), np.int32)
    faces = None if meshes is None else np.empty(far.shape, np.int32)
    inside = draw_bodies(
        far, ids, rectangles, lines, xs, bent, view, axes, camera, bounds, shape, center, half_size,
        yaw, meshes, faces,
    )  # fmt: skip
    if inside >= 0:
        _show_inside(rgb, depth, seen, inside, bent)
        return
    invert(far)
    _show(
        rgb, far, ids, rectangles, faces, work, bent, view, axes, camera, bounds, shape, center,
        half_size, yaw, meshes, texture, per_m, offset, albedo, gloss, lights, atlas,
    )  # fmt: skip
    if cylindrical:
        depth[:, :] = far.T
        seen[:, :] = ids.T


@borrowing_kernel
def _show_inside(
    rgb: NDArray[np.uint8], depth: Plane, seen: Ids, inside: int, bent: Bent | None
) -> None:
    """Write what is seen from inside an obstacle."""
    rgb[:, :, :] = 0
    depth[:, :] = MIN_DEPTH_M
    seen[:, :] = OBSTACLE + inside
    if bent is not None:
        blank(depth, bent)
        for v in range(depth.shape[0]):
            for u in range(depth.shape[1]):
                seen[v, u] = seen[v, u] if depth[v, u] > ZERO else SKY


@borrowing_kernel
def _show(
    rgb: NDArray[np.uint8],
    far: Plane,
    ids: Ids,
    rectangles: Rectangles,
    faces: Faces | None,
    work: Work,
    bent: Bent | None,
    view: View,
    axes: Pose,
    camera: Vec,
    bounds: NDArray[np.float64],
    shape: NDArray[np.int8],
    center: NDArray[np.float64],
    half_size: NDArray[np.float64],
    yaw: NDArray[np.float64],
    meshes: Meshes | None,
    texture: NDArray[np.int8],
    per_m: NDArray[np.float32],
    offset: NDArray[np.float32],
    albedo: NDArray[np.float32],
    gloss: Gloss | None,
    lights: NDArray[np.float32],
    atlas: Plane,
) -> None:
    """Write the colours of what `draw_bodies` has drawn; arguments as of `render_colour`.

    `far` (n, m) is depth [m], `ids` what each pixel sees (hills become floor), `rectangles`
    (obstacles + meshes, 3, 4) where bodies were drawn, `faces` (n, m) the meshes' triangles,
    `camera` (3,) NED [m] above the ground.
    """
    lines, xs = work.lines, work.xs
    light = _lit(lights)
    lit, clear, out, points, rays = work.lit, work.clear, work.out, work.points, work.rays
    surfaces.write_rays(rays, lines, xs, bent, axes)
    to_sun = (float(lights[0, 0]), float(lights[0, 1]), float(lights[0, 2]))
    count = ids.size
    all_ids, all_far = ids.reshape(count), far.reshape(count)
    all_lit, all_clear = lit.reshape(count), clear.reshape(count)
    extinction = float(light.extinction)
    through = let_through(gloss, WALLS_ROW)
    shade_by_walls(all_lit, all_clear, all_far, rays, camera, bounds, to_sun, extinction, through)
    sunny = max(max(light.sun[0], light.sun[1]), light.sun[2]) > ZERO
    for i in range(len(shape)):
        if sunny:
            if is_owned(meshes, i):
                continue
            world, half = _placed(axes, camera, center, half_size, i)
            shade_by_obstacle(
                lit, far, ids, work.corners, i, lines, xs, bent, view, world, camera, shape[i],
                half, yaw[i], to_sun, let_through(gloss, OBSTACLE_ROW + i),
            )  # fmt: skip
    if meshes is not None and faces is not None and sunny:
        shade_by_meshes(
            lit, far, ids, faces, work.corners, lines, xs, bent, view, axes, camera, meshes, to_sun,
            gloss,
        )  # fmt: skip
    surfaces.draw_sky(out, all_ids, points, rays, camera, light)
    pixel2 = F32(1.0 / (view.focal * view.focal))
    floor = surface_of(texture, per_m, offset, albedo, FLOOR_ROW)
    walls = surface_of(texture, per_m, offset, albedo, WALLS_ROW)
    surfaces.shade_floor(
        out, all_ids, all_far, all_lit, all_clear, points, rays, camera, floor, light, atlas, pixel2
    )
    surfaces.shade_walls(
        out, all_ids, all_far, all_lit, all_clear, points, rays, camera, walls, light, atlas, pixel2
    )
    if meshes is not None and faces is not None:
        shade_meshes(
            out, all_ids, all_far, all_lit, all_clear, points, rectangles, meshes,
            faces.reshape(count), lines, xs, bent, axes, camera, texture, per_m, offset, albedo,
            light, atlas, pixel2,
        )  # fmt: skip
    for i in range(len(shape)):
        if is_owned(meshes, i):
            continue
        world, half = _placed(axes, camera, center, half_size, i)
        surface = surface_of(texture, per_m, offset, albedo, OBSTACLE_ROW + i)
        for k in range(3 if view.cylindrical else 1):
            surfaces.shade_obstacle(
                out, all_ids, all_far, all_lit, all_clear, points, rectangles[i, k], i, lines, xs,
                bent, world, shape[i], half, yaw[i], surface, light, atlas, pixel2,
            )  # fmt: skip
    if gloss is not None:
        look = Look(texture, per_m, offset, albedo, gloss, light, atlas, pixel2)
        draw_reflections(
            out, all_ids, rays, camera, bounds, shape, center, half_size, yaw, meshes, look
        )
    if bent is not None:
        _blacken(out, bent)
    unpack(rgb, out, view.cylindrical)
    _tell_ground(all_ids, meshes)


@borrowing_kernel
def _tell_ground(ids: Ids, meshes: Meshes | None) -> None:
    """Write the floor's number (n,) where hills are seen."""
    if meshes is None:
        return
    for at in range(len(ids)):
        ids[at] = FLOOR if ids[at] == GROUND else ids[at]


@borrowing_kernel
def _blacken(out: Packed, bent: Bent) -> None:
    """Write black where a fisheye's pixels see nothing at all."""
    n, m = bent.forward.shape
    for v in range(n):
        for u in range(m):
            i, j, k = bent.forward[v, u], bent.across[v, u], bent.along[v, u]
            if i == 0.0 and j == 0.0 and k == 0.0:
                out[v * m + u] = np.int32(0)


@borrowing_kernel
def _placed(
    axes: Pose, camera: Vec, center: NDArray[np.float64], half_size: NDArray[np.float64], i: int
) -> tuple[Pose, Vec]:
    """Return the camera's axes with an obstacle's centre from the camera, and its half size."""
    offset = (center[i, 0] - camera[0], center[i, 1] - camera[1], center[i, 2] - camera[2])
    half = (half_size[i, 0], half_size[i, 1], half_size[i, 2])
    return Pose(axes.forward, axes.across, axes.along, offset), half


@borrowing_kernel
def _lit(lights: NDArray[np.float32]) -> Lit:
    """Return the light of its array."""
    return Lit(
        (lights[0, 0], lights[0, 1], lights[0, 2]),
        (lights[1, 0], lights[1, 1], lights[1, 2]),
        (lights[2, 0], lights[2, 1], lights[2, 2]),
        (lights[3, 0], lights[3, 1], lights[3, 2]),
        (lights[4, 0], lights[4, 1], lights[4, 2]),
        (lights[5, 0], lights[5, 1], lights[5, 2]),
        lights[6, 0],
    )


@borrowing_kernel
def unpack(rgb: NDArray[np.uint8], out: Packed, cylindrical: bool) -> None:
    """Write the image of its packed pixels, line after line."""
    height, width, _ = rgb.shape
    if cylindrical:
        for v in range(height):
            for u in range(width):
                colour = out[u * height + v]
                rgb[v, u, 0] = colour & 255
                rgb[v, u, 1] = (colour >> 8) & 255
                rgb[v, u, 2] = (colour >> 16) & 255
        return
    count = height * width
    if count % 4 == 0:
        # Four pixels are three words: three stores in place of twelve.
        words, four = rgb.reshape(3 * count).view(np.uint32), out.view(np.uint32)
        for k in range(count // 4):
            p, q, r, s = four[4 * k], four[4 * k + 1], four[4 * k + 2], four[4 * k + 3]
            words[3 * k] = p | U32(q << U32(24))
            words[3 * k + 1] = U32(q >> U32(8)) | U32(r << U32(16))
            words[3 * k + 2] = U32(r >> U32(16)) | U32(s << U32(8))
        return
    pixels = rgb.reshape(count, 3)
    for u in range(count):
        colour = out[u]
        pixels[u, 0] = colour & 255
        pixels[u, 1] = (colour >> 8) & 255
        pixels[u, 2] = (colour >> 16) & 255
