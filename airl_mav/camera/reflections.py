"""Ray tracing of reflection and transmission by surfaces that are not matt.

Pixels of varnish, metal or glass are rendered again. A tree of rays starts at the camera: varnish,
metal and glass mirror them, glass also transmits them, until all hits are matt or contribute too
little. A rough surface directly visible to the camera mirrors `gloss.SAMPLES` directions. Rough
surfaces in reflections count as smooth, except for the sun's highlight, which has a closed form.
Matt surfaces are shaded as in `shading.paint`, with a shadow ray to the sun.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from airl_mav.arena.finishes import FLOOR as FLOOR_ROW
from airl_mav.arena.finishes import OBSTACLE as OBSTACLE_ROW
from airl_mav.arena.finishes import WALLS as WALLS_ROW
from airl_mav.camera import gloss, shading
from airl_mav.camera.bvh import STACK, Meshes
from airl_mav.camera.primitives import (
    BOX,
    CEILING,
    CYLINDER,
    FLOOR,
    GROUND,
    OBSTACLE,
    SKY,
    WALL_NORTH_SOUTH,
    Ids,
)
from airl_mav.camera.projection import Scene, dot
from airl_mav.camera.scene_rays import (
    Bodies,
    Met,
    SurfacePoint,
    advanced,
    bodies_of,
    meet,
    place_of,
    sunlight,
)
from airl_mav.camera.shadows import ABOVE_M
from airl_mav.camera.surfaces import FOG_LAYER_M
from airl_mav.core.kernels import borrowing_kernel, kernel, large_borrowing_kernel, large_kernel
from airl_mav.vehicle.rotation import Vec

MOST_RAYS: Final = 64
"""Maximum number of rays per pixel."""

_COUNTS: Final = 1.0 / 256.0
"""Minimum contribution of a ray; weaker rays are dropped."""

_WAITING: Final = 48
"""Maximum number of pending rays per pixel: `SAMPLES`, plus one per traced ray."""

_RAY: Final = 12
"""Number of values per pending ray: origin, direction, share of red, green and blue, path length,
depth in the tree, `RayHit.blur`."""


class RayHit(NamedTuple):
    """Hit of a ray, and its contribution to the pixel."""

    ray: Vec
    share: Vec
    """Contribution of red, green and blue."""
    way: float
    """Path length from the camera [m]."""
    depth: int
    """Depth in the tree; 0 for the camera's ray."""
    at: Vec
    """Position NED [m]."""
    normal: Vec
    """Unit vector NED on the visible side."""
    albedo: Vec
    cosine: float
    """Cosine of the angle between ray and normal, 0 to 1."""
    alpha: float
    blur: float
    """`alpha` of the roughest surface that mirrored the ray; 0 = no rough surface."""


@large_kernel
def draw_reflections(
    out: shading.Packed,
    ids: Ids,
    rays: shading.PixelRays,
    camera: Vec,
    scene: Scene,
    meshes: Meshes | None,
    look: shading.SceneLook,
) -> None:
    """Redraw the pixels of surfaces that are not matt.

    `out` (n,) are packed colours, `ids` (n,) the segmentation, `rays` the pixels' rays, `camera`
    (3,) NED [m].
    """
    tree, nodes = np.empty((_WAITING, _RAY)), np.empty(STACK, np.int32)
    colour, bodies = np.empty(3), bodies_of(scene)
    for u in range(len(out)):
        seen = ids[u]
        # Sky and ceiling have no material.
        if seen in (SKY, CEILING) or look.gloss.surface[row_of(seen)] == gloss.MATT:
            continue
        n, e, d = float(rays.north[u]), float(rays.east[u]), float(rays.down[u])
        per = 1.0 / math.sqrt(n * n + e * e + d * d)
        # Per path length along oblique rays; `SceneLook.pixel2` is per depth.
        pixel2 = shading.F32(look.pixel2 * per * per * per)
        _wait(tree, 0, camera, (per * n, per * e, per * d), (1.0, 1.0, 1.0), 0.0, 0, 0.0)
        _follow(colour, tree, nodes, bodies, meshes, look, pixel2)
        out[u] = shading.packed(
            shading.F32(colour[0]), shading.F32(colour[1]), shading.F32(colour[2])
        )


@borrowing_kernel
def _wait(
    tree: NDArray[np.float64],
    at: int,
    origin: Vec,
    ray: Vec,
    share: Vec,
    way: float,
    depth: int,
    blur: float,
) -> None:
    """Push a pending ray."""
    for k in range(3):
        tree[at, k], tree[at, 3 + k], tree[at, 6 + k] = origin[k], ray[k], share[k]
    tree[at, 9], tree[at, 10], tree[at, 11] = way, depth, blur


@borrowing_kernel
def _grown(
    tree: NDArray[np.float64], tops: int, seen: RayHit, ray: Vec, share: Vec, blur: float
) -> int:
    """Push a ray with a sufficient contribution; return the number of pending rays."""
    # A full stack drops rays too.
    if max(max(share[0], share[1]), share[2]) < _COUNTS or tops == _WAITING:
        return tops
    _wait(tree, tops, seen.at, ray, share, seen.way, seen.depth + 1, max(seen.blur, blur))
    return tops + 1


@kernel
def _times(a: Vec, b: Vec) -> Vec:
    return (a[0] * b[0], a[1] * b[1], a[2] * b[2])


@kernel
def _scaled(a: Vec, by: float) -> Vec:
    return (by * a[0], by * a[1], by * a[2])


@borrowing_kernel
def _add(colour: NDArray[np.float64], share: Vec, light: Vec | shading.Vec32, by: float) -> None:
    """Add a share of light, times a factor, to a colour (3,)."""
    for k in range(3):
        colour[k] += by * share[k] * light[k]


@large_borrowing_kernel
def _follow(
    colour: NDArray[np.float64],
    tree: NDArray[np.float64],
    nodes: NDArray[np.int32],
    bodies: Bodies,
    meshes: Meshes | None,
    look: shading.SceneLook,
    pixel2: np.float32,
) -> None:
    """Write the linear RGB (3,) of a tree's first ray; `nodes` (STACK,) is a buffer."""
    colour[:] = 0.0
    tops, followed, light = 1, 0, look.light
    # The limit bounds the time for a pixel between mirrors.
    while tops > 0 and followed < MOST_RAYS:
        tops -= 1
        followed += 1
        origin = (tree[tops, 0], tree[tops, 1], tree[tops, 2])
        ray = (tree[tops, 3], tree[tops, 4], tree[tops, 5])
        share = (tree[tops, 6], tree[tops, 7], tree[tops, 8])
        way, depth, blur = tree[tops, 9], int(tree[tops, 10]), tree[tops, 11]
        met = meet(bodies, meshes, origin, ray, nodes)
        if met.seen == SKY:
            _add(colour, share, sky_at(light, ray, origin[2]), 1.0)
            continue
        # Beer's law: fog adds the horizon's light and attenuates the rest.
        if light.extinction > shading.ZERO:
            clear = math.exp(-float(light.extinction) * met.distance)
            _add(colour, share, light.horizon, 1.0 - clear)
            share = _scaled(share, clear)
        if met.seen == CEILING:
            _add(colour, share, light.zenith, 1.0)
            continue
        row = row_of(met.seen)
        kind = look.gloss.surface[row]
        place = place_of(bodies, meshes, met, origin, ray)
        way += met.distance
        albedo = albedo_at(look, row, bodies, met, place, meshes, ray, way, pixel2)
        seen = RayHit(
            ray, share, way, depth, advanced(origin, ray, met.distance), place.normal, albedo,
            min(max(-dot(place.normal, ray), 0.0), 1.0), float(look.gloss.alpha[row]), blur,
        )  # fmt: skip
        if kind == gloss.GLASS:
            tops = _pass(tree, tops, seen)
            continue
        arrives = 0.0
        if _shines(light) and dot(seen.normal, _sun(light)) > 0.0:
            # A mesh may shade itself, so its ray starts above the surface; `own` excludes convex
            # bodies.
            begin = advanced(seen.at, seen.normal, ABOVE_M) if met.mesh >= 0 else seen.at
            arrives = sunlight(bodies, meshes, look.gloss.lets, met.seen, begin, _sun(light), nodes)
        if kind != gloss.METAL:
            _scatter(colour, seen, kind, light, arrives)
        if kind != gloss.MATT:
            _shine(colour, seen, kind, light, arrives)
            tops = _mirror(tree, tops, seen, kind)


@kernel
def _sun(light: shading.Lit) -> Vec:
    """Return the unit vector towards the sun."""
    return (float(light.to_sun[0]), float(light.to_sun[1]), float(light.to_sun[2]))


@kernel
def _shines(light: shading.Lit) -> bool:
    """Return True if the sun has any irradiance."""
    return bool(max(max(light.sun[0], light.sun[1]), light.sun[2]) > shading.ZERO)


@large_borrowing_kernel
def _pass(tree: NDArray[np.float64], tops: int, seen: RayHit) -> int:
    """Push the transmitted and the reflected ray of a pane; return the number of pending rays."""
    back = gloss.pane_reflects(seen.cosine)
    away = gloss.mirrored(seen.ray, seen.normal)
    tops = _grown(tree, tops, seen, away, _scaled(seen.share, back), 0.0)
    onwards = _times(_scaled(seen.share, 1.0 - back), seen.albedo)
    return _grown(tree, tops, seen, seen.ray, onwards, 0.0)


@large_borrowing_kernel
def _scatter(
    colour: NDArray[np.float64], seen: RayHit, kind: int, light: shading.Lit, arrives: float
) -> None:
    """Add the matt scattering of a bare or varnished surface; `arrives` = share of sunlight."""
    facing, enters, sun_enters = max(dot(seen.normal, _sun(light)), 0.0), 1.0, 1.0
    if kind == gloss.GLOSSY:
        # Internal reflections return all scattered light, so diffuse light is as bright as without
        # varnish. Sunlight is therefore relative to the mean over all directions, and the
        # transmission towards the eye equals the transmission from there.
        enters = 1.0 - gloss.fresnel(seen.cosine)
        sun_enters = (1.0 - gloss.fresnel(min(facing, 1.0))) / gloss.VARNISH_ADMITS
    direct, rise = shading.F32(arrives * facing * sun_enters), shading.F32(-seen.normal[2])
    for k in range(3):
        bright = shading.irradiance(light, k, direct, rise)
        colour[k] += seen.share[k] * enters * seen.albedo[k] * bright


@large_borrowing_kernel
def _shine(
    colour: NDArray[np.float64], seen: RayHit, kind: int, light: shading.Lit, arrives: float
) -> None:
    """Add the sun's highlight on a rough surface; mirrors show the sun directly.

    The mirror's roughness widens a reflected highlight, because eight rays would show it eight
    times (Kaplanyan and Dachsbacher, Path space regularization, 2013).
    """
    if arrives == 0.0 or gloss.is_smooth(seen.alpha):
        return
    alpha = max(seen.alpha, seen.blur)
    value, cosine = gloss.highlight(alpha, seen.normal, seen.ray, _sun(light))
    if kind == gloss.METAL:
        _add(colour, _times(seen.share, seen.albedo), light.sun, arrives * value)
    else:
        back = gloss.fresnel(min(max(cosine, 0.0), 1.0))
        _add(colour, seen.share, light.sun, arrives * value * back)


@large_borrowing_kernel
def _mirror(tree: NDArray[np.float64], tops: int, seen: RayHit, kind: int) -> int:
    """Push the mirrored rays of metal or varnish; return the number of pending rays."""
    # Only the first hit is sampled, because the rays multiply at each further hit.
    many = 1 if seen.depth > 0 or gloss.is_smooth(seen.alpha) else gloss.SAMPLES
    for number in range(many):
        u, v = gloss.spread(number)
        shine = seen.normal if many == 1 else gloss.facet(seen.alpha, seen.normal, seen.ray, u, v)
        away = gloss.mirrored(seen.ray, shine)
        gives = 1.0 if many == 1 else gloss.facet_gives(seen.alpha, seen.normal, away) / many
        share = _scaled(seen.share, gives)
        if kind == gloss.METAL:
            share = _times(share, seen.albedo)
        else:
            share = _scaled(share, gloss.fresnel(min(max(-dot(shine, seen.ray), 0.0), 1.0)))
        tops = _grown(tree, tops, seen, away, share, 0.0 if many == 1 else seen.alpha)
    return tops


# --- shading at the end of a ray


@kernel
def row_of(seen: int) -> int:
    """Return the row of `Finish` for a segmentation number, neither ceiling nor sky."""
    if seen >= OBSTACLE:
        return OBSTACLE_ROW + seen - OBSTACLE
    return FLOOR_ROW if seen in (FLOOR, GROUND) else WALLS_ROW


@large_borrowing_kernel
def albedo_at(
    look: shading.SceneLook,
    row: int,
    bodies: Bodies,
    met: Met,
    place: SurfacePoint,
    meshes: Meshes | None,
    ray: Vec,
    way: float,
    pixel2: np.float32,
) -> Vec:
    """Return the linear RGB albedo of a surface at a ray's hit."""
    surface = shading.surface_of(look, row)
    a, b, c = shading.F32(place.at[0]), shading.F32(place.at[1]), shading.F32(place.at[2])
    per_m, per_turn = surface.per_m, shading.F32(0.0)
    across, along, in_periods = shading.ZERO, shading.ZERO, False
    if met.mesh >= 0:
        if meshes is not None:
            n = meshes.bvh.normals[met.face]
            across, along = shading.on_triangle(a, b, c, n[0], n[1], n[2])
    elif met.seen == FLOOR:
        across, along = b, -a
    elif met.seen < OBSTACLE:
        across, along = (b if met.seen == WALL_NORTH_SOUTH else a), c
    else:
        shape, radius = (
            bodies.shape[met.seen - OBSTACLE],
            bodies.half_size[met.seen - OBSTACLE, 0],
        )
        if shape == BOX:
            across, along = shading.on_box(a, b, c, place.side == 2, place.side == 0)
        else:
            per_turn, in_periods = shading.periods_around(radius, per_m), True
            if shape == CYLINDER:
                across, along = shading.on_cylinder(a, b, c, place.side == 2, per_m, per_turn)
            else:
                across, along = shading.on_sphere(a, b, c, per_turn)
    if not in_periods:
        across, along = across * per_m, along * per_m
    # An oblique surface has more texels per pixel.
    steep = max(shading.F32(-dot(place.normal, ray)), shading.STEEP)
    texels = shading.texels2(surface, pixel2) * shading.F32(way) * shading.F32(way) / steep
    at = shading.texel_at(across + surface.offset[0], along + surface.offset[1], texels)
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
def sky_at(light: shading.Lit, ray: Vec, down: float) -> Vec:
    """Return linear RGB of the sky, or of the ground below the horizon, as `draw_sky`."""
    rise, through = -ray[2], 1.0
    # The path through fog ends at the top of the layer, or at the floor.
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
