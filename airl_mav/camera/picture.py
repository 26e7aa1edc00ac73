"""Rendering of a colour camera's view: colour, depth and segmentation from one pass."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from airl_mav.arena.finishes import FLOOR as FLOOR_ROW
from airl_mav.arena.finishes import Drawn, linear_of, srgb_of
from airl_mav.arena.geometry import Arena
from airl_mav.camera.bvh import meshes_of
from airl_mav.camera.colour import Work, render_colour
from airl_mav.camera.gloss import Gloss
from airl_mav.camera.intrinsics import Intrinsics, finer
from airl_mav.camera.projection import bent_of
from airl_mav.camera.render import pose_of
from airl_mav.camera.textures import atlas, mean_of, periods
from airl_mav.core.kernels import kernel
from airl_mav.vehicle.rotation import Quat, Vec

LUMA = (19595, 38470, 7471)
"""Weights of red, green and blue in grey, times 65536: 0.299, 0.587 and 0.114, the luma of ITU-R
BT.601. The integers equal Pillow's."""


class Picture(NamedTuple):
    """Colour, depth and segmentation of one exposure."""

    rgb: NDArray[np.uint8]  # (height, width, 3) sRGB
    depth_m: NDArray[np.float32]  # (height, width), 0 = no surface
    seen: NDArray[np.int32]  # (height, width) CEILING, SKY, ... of `primitives`, OBSTACLE + i


@dataclass(frozen=True)
class ColourArrays:
    """Appearance of an arena as arrays for `render_colour`."""

    texture: NDArray[np.int8]  # (m,)
    per_m: NDArray[np.float32]  # (m,) [1/m]
    offset: NDArray[np.float32]  # (m, 2)
    albedo: NDArray[np.float32]  # (m, 2, 3)
    gloss: Gloss | None
    lights: NDArray[np.float32]  # (7, 3)

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
            Gloss.of(finish),
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
    k, obstacles, look = intrinsics, arena.obstacles, ColourArrays.of(arena.look)
    shape = (k.height, k.width)
    lights = look.lights if gain == 1.0 else _brightened(look.lights, gain)
    picture = Picture(
        np.empty((*shape, 3), np.uint8), np.empty(shape, np.float32), np.empty(shape, np.int32)
    )
    render_colour(
        *picture,
        Work.of(k.width, k.height, k.cylindrical),
        *pose_of(position, quaternion),
        float(k.focal),
        float(k.cx),
        float(k.cy),
        k.cylindrical,
        arena.bounds.as_array(),
        obstacles.shape,
        centers,
        obstacles.half_size,
        obstacles.yaw,
        meshes_of(arena.meshes, len(obstacles), arena.ground),
        look.texture,
        look.per_m,
        look.offset,
        look.albedo,
        look.gloss,
        lights,
        atlas(arena.look.finish.images),
        bent_of(k),
    )
    return picture


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
