"""What a single ray sees where it ends: the albedo of a surface, or the sky."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from airl_mav.arena.appearance import FLOOR as FLOOR_ROW
from airl_mav.arena.appearance import OBSTACLE as OBSTACLE_ROW
from airl_mav.arena.appearance import WALLS as WALLS_ROW
from airl_mav.camera import patterns, primitives
from airl_mav.camera.bvh import Meshes
from airl_mav.camera.gloss import Gloss
from airl_mav.camera.projection import dot
from airl_mav.camera.scene_rays import Bodies, Met, Place
from airl_mav.camera.shading import F32, ZERO, Lit, Plane, surface_of, texel_at
from airl_mav.camera.surfaces import FOG_LAYER_M
from airl_mav.core.kernels import kernel, large_borrowing_kernel
from airl_mav.vehicle.rotation import Vec


@kernel
def row_of(seen: int) -> int:
    """Return the row of `Finish` of what is seen: neither ceiling nor sky."""
    if seen >= primitives.OBSTACLE:
        return OBSTACLE_ROW + seen - primitives.OBSTACLE
    return FLOOR_ROW if seen in (primitives.FLOOR, primitives.GROUND) else WALLS_ROW


class Look(NamedTuple):
    """How an arena looks, as `colour.render_colour` takes it; and how wide pixels are."""

    texture: NDArray[np.int8]  # (2 + n,)
    per_m: NDArray[np.float32]  # (2 + n,)
    offset: NDArray[np.float32]  # (2 + n, 2)
    albedo: NDArray[np.float32]  # (2 + n, 2, 3)
    gloss: Gloss
    light: Lit
    atlas: Plane
    pixel2: np.float32
    """Square of the side of a pixel at a depth of 1."""


@large_borrowing_kernel
def albedo_at(
    look: Look,
    row: int,
    bodies: Bodies,
    met: Met,
    place: Place,
    meshes: Meshes | None,
    ray: Vec,
    way: float,
    pixel2: np.float32,
) -> Vec:
    """Return the linear RGB albedo of a surface where a ray meets it."""
    surface = surface_of(look.texture, look.per_m, look.offset, look.albedo, row)
    a, b, c = F32(place.at[0]), F32(place.at[1]), F32(place.at[2])
    per_m, per_turn = surface.per_m, F32(0.0)
    across, along, in_periods = ZERO, ZERO, False
    if met.mesh >= 0:
        if meshes is not None:
            n = meshes.bvh.normals[met.face]
            across, along = patterns.on_triangle(a, b, c, n[0], n[1], n[2])
    elif met.seen == primitives.FLOOR:
        across, along = b, -a
    elif met.seen < primitives.OBSTACLE:
        across, along = (b if met.seen == primitives.WALL_NORTH_SOUTH else a), c
    else:
        shape, radius = (
            bodies.shape[met.seen - primitives.OBSTACLE],
            bodies.half_size[met.seen - primitives.OBSTACLE, 0],
        )
        if shape == primitives.BOX:
            across, along = patterns.on_box(a, b, c, place.side == 2, place.side == 0)
        else:
            per_turn, in_periods = patterns.periods_around(radius, per_m), True
            if shape == primitives.CYLINDER:
                across, along = patterns.on_cylinder(a, b, c, place.side == 2, per_m, per_turn)
            else:
                across, along = patterns.on_sphere(a, b, c, per_turn)
    if not in_periods:
        across, along = across * per_m, along * per_m
    steep = max(F32(-dot(place.normal, ray)), patterns.STEEP)
    texels = patterns.texels2(surface, pixel2) * F32(way) * F32(way) / steep
    at = texel_at(across + surface.offset[0], along + surface.offset[1], texels)
    red = look.atlas[np.uint64(surface.base + at)]
    green, blue = red, red
    if surface.step != 0:
        green = look.atlas[np.uint64(surface.base + surface.step + at)]
        blue = look.atlas[np.uint64(surface.base + 2 * surface.step + at)]
    dark, more = surface.albedo, surface.more
    return (
        float(dark[0] + more[0] * red),
        float(dark[1] + more[1] * green),
        float(dark[2] + more[2] * blue),
    )


@kernel
def sky_at(light: Lit, ray: Vec, down: float) -> Vec:
    """Return linear RGB of the sky, or of the ground below the horizon, as `draw_sky`."""
    rise, through = -ray[2], 1.0
    if light.extinction > 0.0:
        thick = FOG_LAYER_M if rise > 0.0 else max(-down, 1e-3)
        through = math.exp(-float(light.extinction) * thick / max(abs(rise), 1e-6))
    horizon = (float(light.horizon[0]), float(light.horizon[1]), float(light.horizon[2]))
    end = light.zenith if rise >= 0.0 else light.ground
    share = through * (rise if rise >= 0.0 else 1.0)
    return (
        horizon[0] + share * (float(end[0]) - horizon[0]),
        horizon[1] + share * (float(end[1]) - horizon[1]),
        horizon[2] + share * (float(end[2]) - horizon[2]),
    )
