"""Rendering of a colour camera's view: colour, depth and segmentation from one pass.

Each pixel is sampled by one ray. As with depth, the image is drawn obstacle by obstacle: the bodies
of `raycast`, then shadows, then each obstacle shades its visible pixels within its rectangles.
Depth, light and colour are stored as planes of 32 bits, so that every loop along a line vectorizes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from airl_mav.addons.colour import shading, surfaces
from airl_mav.addons.colour.appearance import FLOOR as FLOOR_ROW
from airl_mav.addons.colour.appearance import OBSTACLE as OBSTACLE_ROW
from airl_mav.addons.colour.appearance import WALLS as WALLS_ROW
from airl_mav.addons.colour.appearance import Drawn, linear_of, srgb_of
from airl_mav.addons.colour.reflections import draw_reflections
from airl_mav.addons.colour.shadows import (
    CORNERS,
    Shaded,
    shade_by_meshes,
    shade_by_obstacle,
    shade_by_walls,
)
from airl_mav.addons.colour.textures import atlas, mean_of, periods
from airl_mav.arena.geometry import Arena
from airl_mav.camera import raycast
from airl_mav.camera.bvh import Meshes, count_of, is_owned, meshes_of, raised
from airl_mav.camera.intrinsics import Intrinsics, finer
from airl_mav.camera.meshes import Faces
from airl_mav.camera.primitives import FLOOR, GROUND, OBSTACLE, SKY, Ids, Rectangles
from airl_mav.camera.projection import MIN_DEPTH_M, Bent, LensConstants, Optics, Scene, lens_of
from airl_mav.camera.render import RANGE_M, pose_of, scene_of
from airl_mav.core.kernels import borrowing_kernel, kernel, large_kernel
from airl_mav.vehicle.rotation import Quat, Vec

LUMA = (19595, 38470, 7471)
"""Weights of red, green and blue in grey, times 65536: 0.299, 0.587 and 0.114, the luma of ITU-R
BT.601. The integers equal Pillow's."""


class Picture(NamedTuple):
    """Colour, depth and segmentation of one exposure."""

    rgb: NDArray[np.uint8]  # (height, width, 3) sRGB
    depth_m: NDArray[np.float32]  # (height, width), 0 = no surface
    seen: NDArray[np.int32]  # (height, width) CEILING, SKY, ... of `primitives`, OBSTACLE + i


class ColourArrays(NamedTuple):
    """Appearance of an arena for `render_colour`; rows as in `Finish`."""

    texture: NDArray[np.int8]  # (m,)
    per_m: NDArray[np.float32]  # (m,) periods of the pattern per metre [1/m]
    offset: NDArray[np.float32]  # (m, 2)
    albedo: NDArray[np.float32]  # (m, 2, 3)
    gloss: shading.Gloss | None
    """Properties of surfaces that are not matt; None = all are matt, at no cost."""
    lights: NDArray[np.float32]
    """(7, 3) direction of the sun, irradiance of sun and sky, the floor's mean radiosity, zenith,
    horizon, and the fog's extinction [1/m] in the first column."""

    @classmethod
    def of(cls, look: Drawn) -> ColourArrays:
        """Return the arrays of a rendered appearance."""
        finish, light = look.finish, look.light
        floor = finish.albedo[FLOOR_ROW]
        share = mean_of(finish, FLOOR_ROW)
        sky = light.sky
        # Down is positive, so -to_sun[2] is the cosine of sun and zenith.
        radiosity = (floor[0] + share * (floor[1] - floor[0])) * (sky - light.to_sun[2] * light.sun)
        if (inside := light.inside) is not None:
            # An upright surface then receives (sky + radiosity) / 2 = `inside.walls`.
            sky, radiosity = inside.floor, np.maximum(2.0 * inside.walls - inside.floor, 0.0)
        lights = [light.to_sun, light.sun, sky, radiosity, light.zenith, light.horizon]
        lights.append(np.array([light.extinction, 0.0, 0.0]))
        return cls(
            finish.texture,
            (1.0 / (finish.size_m * periods(finish))).astype(np.float32),
            finish.offset.astype(np.float32),
            finish.albedo.astype(np.float32),
            shading.Gloss.of(finish),
            np.array(lights, np.float32),
        )


def render_picture(
    arena: Arena,
    centers: NDArray[np.float64],
    intrinsics: Intrinsics,
    position: Vec | NDArray[np.float64],
    quaternion: Quat | NDArray[np.float64],
    gain: float = 1.0,
) -> Picture:
    """Return the picture of an arena, light times `gain`; arguments as in `render`."""
    k, look = intrinsics, ColourArrays.of(arena.look)
    if gain != 1.0:
        look = look._replace(lights=_brightened(look.lights, gain))
    shape = (k.height, k.width)
    picture = Picture(
        np.empty((*shape, 3), np.uint8), np.empty(shape, np.float32), np.empty(shape, np.int32)
    )
    render_colour(
        *picture,
        Work.of(k),
        *pose_of(position, quaternion),
        lens_of(k, RANGE_M),
        scene_of(arena, centers),
        meshes_of(arena.meshes, len(arena.obstacles), arena.ground),
        look,
        atlas(arena.look.finish.images),
    )
    return picture


def expose_colour(
    arena: Arena,
    centers: NDArray[np.float64],
    intrinsics: Intrinsics,
    position: Vec | NDArray[np.float64],
    quaternion: Quat | NDArray[np.float64],
    gain: float = 1.0,
) -> NDArray[np.uint8]:
    """Return the image (h, w, channels) of a colour camera; arguments as in `render_picture`."""
    rgb = render_picture(arena, centers, intrinsics, position, quaternion, gain).rgb
    return rgb if intrinsics.kind == "rgb" else grey(rgb)[..., None]


def _brightened(lights: NDArray[np.float32], gain: float) -> NDArray[np.float32]:
    """Return the lights (7, 3) of `ColourArrays` times a gain; direction and fog are unchanged."""
    brighter = lights.copy()
    brighter[1:6] *= np.float32(gain)
    return brighter


def grey(rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return sRGB images (..., 3) as grey images (...): luma of the encoded values, rounded."""
    luma = np.empty(rgb.shape[:-1], np.uint8)
    write_grey(luma.reshape(-1), np.ascontiguousarray(rgb).reshape(-1, 3))
    return luma


@kernel
def write_grey(out: NDArray[np.uint8], rgb: NDArray[np.uint8]) -> None:
    """Write the luma (n,) of sRGB pixels (n, 3)."""
    red, green, blue = np.uint32(LUMA[0]), np.uint32(LUMA[1]), np.uint32(LUMA[2])
    # Half of 2^16 rounds the shifted sum to the nearest integer.
    half, shift = np.uint32(1 << 15), np.uint32(16)
    for u in range(len(out)):
        luma = np.uint32(rgb[u, 0]) * red + np.uint32(rgb[u, 1]) * green
        luma += np.uint32(rgb[u, 2]) * blue + half
        out[u] = np.uint8(luma >> shift)


def antialiased(
    arena: Arena,
    centers: NDArray[np.float64],
    intrinsics: Intrinsics,
    position: Vec | NDArray[np.float64],
    quaternion: Quat | NDArray[np.float64],
    side: int,
) -> NDArray[np.uint8]:
    """Return an sRGB image with side x side rays per pixel, for display; sensors use one ray."""
    k, fine = intrinsics, finer(intrinsics, side)
    codes = render_picture(arena, centers, fine, position, quaternion).rgb
    # The mean is taken of linear light, not of sRGB codes.
    light = linear_of(np.arange(256) / 255.0)[codes]
    mean = light.reshape(k.height, side, k.width, side, 3).mean(axis=(1, 3))
    rgb: NDArray[np.uint8] = np.rint(255.0 * srgb_of(mean)).astype(np.uint8)
    return rgb


U32 = np.uint32


class Work(NamedTuple):
    """Work buffers for images of n lines of m pixels; valid during one call only."""

    lines: NDArray[np.float64]  # (n, 2)
    xs: NDArray[np.float64]  # (m,)
    far: shading.Plane  # (n, m)
    ids: Ids  # (n, m)
    lit: shading.Plane  # (n, m)
    clear: shading.Plane  # (n, m)
    out: shading.Packed  # (n m,)
    rays: shading.PixelRays
    points: shading.Points
    corners: NDArray[np.float64]  # (CORNERS, 3)

    @classmethod
    def of(cls, k: Intrinsics) -> Work:
        """Return buffers for a camera's images; lines are rows, or columns of a cylinder."""
        n, m = (k.width, k.height) if k.model.cylindrical else (k.height, k.width)
        # A block has at least one whole line.
        block = max(surfaces.BLOCK, m)

        def floats(*shape: int) -> shading.Plane:
            return np.zeros(shape, np.float32)

        return cls(
            np.zeros((n, 2)),
            np.zeros(m),
            floats(n, m),
            np.zeros((n, m), np.int32),
            floats(n, m),
            floats(n, m),
            np.zeros(n * m, np.int32),
            shading.PixelRays(floats(n * m), floats(n * m), floats(n * m)),
            shading.Points(np.zeros(block, np.int32), *(floats(block) for _ in range(5))),
            np.zeros((CORNERS, 3)),
        )


@large_kernel
def render_colour(
    rgb: NDArray[np.uint8],
    depth: shading.Plane,
    seen: Ids,
    work: Work,
    position: Vec | NDArray[np.float64],
    quaternion: Quat | NDArray[np.float64],
    lens: LensConstants,
    scene: Scene,
    meshes: Meshes | None,
    colours: ColourArrays,
    atlas: shading.Plane,
) -> None:
    """Render the colour image of an arena; arguments not listed as in `render_depth`.

    The outputs are `rgb` (height, width, 3) sRGB, `depth` (height, width) unlimited [m], 0 = no
    surface, and `seen`. Inside an obstacle the image is black. `seen` is CEILING, SKY, ... of
    `primitives`, FLOOR also for hills, or OBSTACLE + the number of an obstacle or of a mesh's
    first. `atlas` is `textures.atlas()`.
    """
    camera = raised(meshes, position)
    lines, xs, bent, cylindrical = work.lines, work.xs, lens.bent, lens.cylindrical
    view, axes = raycast.aim(lines, xs, quaternion, lens)
    # A cylinder is drawn by columns into work buffers, and transposed at the end.
    far, ids = (work.far, work.ids) if cylindrical else (depth, seen)
    rectangles = np.zeros((len(scene.shape) + count_of(meshes), 3, 4), np.int32)
    faces = None if meshes is None else np.empty(far.shape, np.int32)
    optics = Optics(lines, xs, bent, view, axes, camera)
    inside = raycast.draw_bodies(far, ids, rectangles, optics, scene, meshes, faces)
    if inside >= 0:
        _show_inside(rgb, depth, seen, inside, bent)
        return
    raycast.invert(far)
    pixel2 = shading.F32(1.0 / (view.focal * view.focal))
    c, light = colours, _lit(colours.lights)
    look = shading.SceneLook(c.texture, c.per_m, c.offset, c.albedo, c.gloss, light, atlas, pixel2)  # type: ignore[arg-type]
    _show(rgb, far, ids, rectangles, faces, work, optics, scene, meshes, look, c.gloss)
    if cylindrical:
        raycast.write_transposed(depth, far)
        raycast.write_transposed(seen, ids)


@borrowing_kernel
def _show_inside(
    rgb: NDArray[np.uint8], depth: shading.Plane, seen: Ids, inside: int, bent: Bent | None
) -> None:
    """Write the image of a camera inside an obstacle."""
    rgb[:, :, :] = 0
    depth[:, :] = MIN_DEPTH_M
    seen[:, :] = OBSTACLE + inside
    if bent is not None:
        raycast.blank(depth, bent)
        for v in range(depth.shape[0]):
            for u in range(depth.shape[1]):
                seen[v, u] = seen[v, u] if depth[v, u] > shading.ZERO else SKY


@borrowing_kernel
def _show(
    rgb: NDArray[np.uint8],
    far: shading.Plane,
    ids: Ids,
    rectangles: Rectangles,
    faces: Faces | None,
    work: Work,
    optics: Optics,
    scene: Scene,
    meshes: Meshes | None,
    look: shading.SceneLook,
    gloss: shading.Gloss | None,
) -> None:
    """Write the colours of the bodies drawn by `draw_bodies`.

    `far` (n, m) is depth [m], `ids` the body of each pixel (hills become floor), `rectangles`
    (obstacles + meshes, 3, 4) the bodies' bounds, `faces` (n, m) the meshes' triangles. `gloss` is
    `look.gloss`.
    """
    camera, view, light, count = optics.camera, optics.lens, look.light, ids.size
    lit, out, rays = work.lit, work.out, work.rays
    canvas = shading.Canvas(
        out, ids.reshape(count), far.reshape(count), lit.reshape(count),
        work.clear.reshape(count), rays, work.points,
    )  # fmt: skip
    surfaces.write_rays(rays, optics)
    to_sun = (float(light.to_sun[0]), float(light.to_sun[1]), float(light.to_sun[2]))
    shade_by_walls(
        canvas,
        camera,
        scene.bounds,
        to_sun,
        float(light.extinction),
        shading.let_through(gloss, WALLS_ROW),
    )
    shadows = Shaded(lit, far, ids, work.corners)
    # Without sunlight `lit` has no effect, so bodies need no shadows.
    sunny = max(max(light.sun[0], light.sun[1]), light.sun[2]) > shading.ZERO
    for i in range(len(scene.shape)):
        if sunny:
            if is_owned(meshes, i):
                continue
            body = raycast.body_of(scene, optics.axes, camera, i)
            shade_by_obstacle(
                shadows, optics, body, to_sun, shading.let_through(gloss, OBSTACLE_ROW + i)
            )
    if meshes is not None and faces is not None and sunny:
        shade_by_meshes(shadows, optics, meshes, faces, to_sun, gloss)
    surfaces.draw_sky(canvas, camera, light)
    surfaces.shade_floor(canvas, look, camera)
    surfaces.shade_walls(canvas, look, camera)
    if meshes is not None and faces is not None:
        surfaces.shade_meshes(canvas, look, optics, rectangles, meshes, faces.reshape(count))
    for i in range(len(scene.shape)):
        if is_owned(meshes, i):
            continue
        body = raycast.body_of(scene, optics.axes, camera, i)
        # A cylinder may show a body at three turns, as in `raycast._draw_obstacle`.
        for k in range(3 if view.cylindrical else 1):
            surfaces.shade_obstacle(canvas, look, optics, body, rectangles[i, k])
    # Reflections replace the pixels of surfaces that are not matt.
    if gloss is not None:
        draw_reflections(out, canvas.ids, rays, camera, scene, meshes, look)
    _blacken(out, optics.bent)
    unpack(rgb, out, view.cylindrical)
    _tell_ground(canvas.ids, meshes)


@borrowing_kernel
def _tell_ground(ids: Ids, meshes: Meshes | None) -> None:
    """Write the floor's number (n,) where hills are seen."""
    if meshes is None:
        return
    for at in range(len(ids)):
        ids[at] = FLOOR if ids[at] == GROUND else ids[at]


@borrowing_kernel
def _blacken(out: shading.Packed, bent: Bent | None) -> None:
    """Write black into fisheye pixels outside the field of view."""
    if bent is None:
        return
    n, m = bent.forward.shape
    for v in range(n):
        for u in range(m):
            i, j, k = bent.forward[v, u], bent.across[v, u], bent.along[v, u]
            if i == 0.0 and j == 0.0 and k == 0.0:
                out[v * m + u] = np.int32(0)


@borrowing_kernel
def _lit(lights: NDArray[np.float32]) -> shading.Lit:
    """Return the light from its array."""
    return shading.Lit(
        (lights[0, 0], lights[0, 1], lights[0, 2]),
        (lights[1, 0], lights[1, 1], lights[1, 2]),
        (lights[2, 0], lights[2, 1], lights[2, 2]),
        (lights[3, 0], lights[3, 1], lights[3, 2]),
        (lights[4, 0], lights[4, 1], lights[4, 2]),
        (lights[5, 0], lights[5, 1], lights[5, 2]),
        lights[6, 0],
    )


@borrowing_kernel
def unpack(rgb: NDArray[np.uint8], out: shading.Packed, cylindrical: bool) -> None:
    """Write the image from its packed pixels, line by line."""
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
