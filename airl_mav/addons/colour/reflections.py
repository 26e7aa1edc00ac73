"""Ray tracing of reflection and transmission by surfaces that are not matt.

Pixels of varnish, metal or glass are rendered again. A tree of rays starts at the camera: varnish,
metal and glass mirror them, glass also transmits them, until all hits are matt or contribute too
little. A rough surface directly visible to the camera mirrors `shading.SAMPLES` directions. Rough
surfaces in reflections count as smooth, except for the sun's highlight, which has a closed form.
Matt surfaces are shaded as in `shading.paint`, with a shadow ray to the sun.

Images are drawn body by body (`raycast`, `shadows`), all rays of the camera at once; these few rays
have other origins. Computes in float64; a ray is a unit vector.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from airl_mav.addons.colour import shading
from airl_mav.addons.colour.appearance import FLOOR as FLOOR_ROW
from airl_mav.addons.colour.appearance import OBSTACLE as OBSTACLE_ROW
from airl_mav.addons.colour.appearance import WALLS as WALLS_ROW
from airl_mav.addons.colour.shading import material_row
from airl_mav.addons.colour.shadows import ABOVE_M
from airl_mav.addons.colour.surfaces import FOG_LAYER_M
from airl_mav.camera import primitives
from airl_mav.camera.bvh import STACK, Meshes, is_owned
from airl_mav.camera.meshes import distance_to, inverse_of, stopped_by
from airl_mav.camera.projection import Scene, dot
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
    ids: primitives.Ids,
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
        if (
            seen in (primitives.SKY, primitives.CEILING)
            or look.gloss.surface[row_of(seen)] == shading.MATT
        ):
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
        if met.seen == primitives.SKY:
            _add(colour, share, sky_at(light, ray, origin[2]), 1.0)
            continue
        # Beer's law: fog adds the horizon's light and attenuates the rest.
        if light.extinction > shading.ZERO:
            clear = math.exp(-float(light.extinction) * met.distance)
            _add(colour, share, light.horizon, 1.0 - clear)
            share = _scaled(share, clear)
        if met.seen == primitives.CEILING:
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
        if kind == shading.GLASS:
            tops = _pass(tree, tops, seen)
            continue
        arrives = 0.0
        if _shines(light) and dot(seen.normal, _sun(light)) > 0.0:
            # A mesh may shade itself, so its ray starts above the surface; `own` excludes convex
            # bodies.
            begin = advanced(seen.at, seen.normal, ABOVE_M) if met.mesh >= 0 else seen.at
            arrives = sunlight(bodies, meshes, look.gloss.lets, met.seen, begin, _sun(light), nodes)
        if kind != shading.METAL:
            _scatter(colour, seen, kind, light, arrives)
        if kind != shading.MATT:
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
    back = shading.pane_reflects(seen.cosine)
    away = shading.mirrored(seen.ray, seen.normal)
    tops = _grown(tree, tops, seen, away, _scaled(seen.share, back), 0.0)
    onwards = _times(_scaled(seen.share, 1.0 - back), seen.albedo)
    return _grown(tree, tops, seen, seen.ray, onwards, 0.0)


@large_borrowing_kernel
def _scatter(
    colour: NDArray[np.float64], seen: RayHit, kind: int, light: shading.Lit, arrives: float
) -> None:
    """Add the matt scattering of a bare or varnished surface; `arrives` = share of sunlight."""
    facing, enters, sun_enters = max(dot(seen.normal, _sun(light)), 0.0), 1.0, 1.0
    if kind == shading.GLOSSY:
        # Internal reflections return all scattered light, so diffuse light is as bright as without
        # varnish. Sunlight is therefore relative to the mean over all directions, and the
        # transmission towards the eye equals the transmission from there.
        enters = 1.0 - shading.fresnel(seen.cosine)
        sun_enters = (1.0 - shading.fresnel(min(facing, 1.0))) / shading.VARNISH_ADMITS
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
    if arrives == 0.0 or shading.is_smooth(seen.alpha):
        return
    alpha = max(seen.alpha, seen.blur)
    value, cosine = shading.highlight(alpha, seen.normal, seen.ray, _sun(light))
    if kind == shading.METAL:
        _add(colour, _times(seen.share, seen.albedo), light.sun, arrives * value)
    else:
        back = shading.fresnel(min(max(cosine, 0.0), 1.0))
        _add(colour, seen.share, light.sun, arrives * value * back)


@large_borrowing_kernel
def _mirror(tree: NDArray[np.float64], tops: int, seen: RayHit, kind: int) -> int:
    """Push the mirrored rays of metal or varnish; return the number of pending rays."""
    # Only the first hit is sampled, because the rays multiply at each further hit.
    many = 1 if seen.depth > 0 or shading.is_smooth(seen.alpha) else shading.SAMPLES
    for number in range(many):
        u, v = shading.spread(number)
        shine = seen.normal if many == 1 else shading.facet(seen.alpha, seen.normal, seen.ray, u, v)
        away = shading.mirrored(seen.ray, shine)
        gives = 1.0 if many == 1 else shading.facet_gives(seen.alpha, seen.normal, away) / many
        share = _scaled(seen.share, gives)
        if kind == shading.METAL:
            share = _times(share, seen.albedo)
        else:
            share = _scaled(share, shading.fresnel(min(max(-dot(shine, seen.ray), 0.0), 1.0)))
        tops = _grown(tree, tops, seen, away, share, 0.0 if many == 1 else seen.alpha)
    return tops


# --- shading at the end of a ray


@kernel
def row_of(seen: int) -> int:
    """Return the row of `Finish` for a segmentation number, neither ceiling nor sky."""
    if seen >= primitives.OBSTACLE:
        return OBSTACLE_ROW + seen - primitives.OBSTACLE
    return FLOOR_ROW if seen in (primitives.FLOOR, primitives.GROUND) else WALLS_ROW


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
            across, along = shading.on_box(a, b, c, place.side == 2, place.side == 0)
        else:
            per_turn, in_periods = shading.periods_around(radius, per_m), True
            if shape == primitives.CYLINDER:
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


LEAST_M: Final = 1e-4
"""Minimum hit distance [m]; excludes the surface at the ray's origin."""


class Bodies(NamedTuple):
    """Obstacles and room of an arena, as arguments of `render_depth`; see `bodies_of`."""

    bounds: NDArray[np.float64]  # (6,)
    shape: NDArray[np.int8]  # (n,)
    center: NDArray[np.float64]  # (n, 3)
    half_size: NDArray[np.float64]  # (n, 3)
    turn: NDArray[np.float64]  # (n, 2) cosine and sine of the heading of its axes
    reach: NDArray[np.float64]  # (n,) square of the radius of a sphere around each [m²]


class Met(NamedTuple):
    """First hit of a ray."""

    distance: float
    """Distance along the ray [m]; infinite without a hit."""
    seen: int
    """SKY, FLOOR, ... of `primitives`; for a mesh the number of its first obstacle, or GROUND."""
    mesh: int
    """Index of the mesh; -1 = not a mesh."""
    face: int
    """Index of the mesh's triangle."""


class SurfacePoint(NamedTuple):
    """Point on a body in the body's axes."""

    at: Vec
    """Position from the body's centre or the mesh's origin [m]; on room and floor NED."""
    normal: Vec
    """Unit vector NED on the ray's side."""
    side: int
    """Face perpendicular to the body's first, second or vertical axis: 0, 1, 2; 3 = curved side."""


@kernel
def bodies_of(scene: Scene) -> Bodies:
    """Return the bodies of an arena, with values precomputed for all rays."""
    bounds, shape, center, half_size, yaw = scene
    n = len(shape)
    turn, reach = np.empty((n, 2)), np.empty(n)
    for i in range(n):
        turn[i, 0], turn[i, 1] = 1.0, 0.0
        a, b, c = half_size[i, 0], half_size[i, 1], half_size[i, 2]
        if shape[i] == primitives.BOX:
            turn[i, 0], turn[i, 1] = math.cos(yaw[i]), math.sin(yaw[i])
            reach[i] = a * a + b * b + c * c
        else:
            reach[i] = a * a + c * c if shape[i] == primitives.CYLINDER else a * a
    return Bodies(bounds, shape, center, half_size, turn, reach)


@kernel
def advanced(origin: Vec, ray: Vec, distance: float) -> Vec:
    """Return the point at a distance along a ray."""
    return (
        origin[0] + distance * ray[0],
        origin[1] + distance * ray[1],
        origin[2] + distance * ray[2],
    )


@large_borrowing_kernel
def _span(bodies: Bodies, i: int, origin: Vec, ray: Vec) -> tuple[float, float]:
    """Return a ray's entry and exit distance through an obstacle; exit < entry is a miss."""
    center, half = bodies.center[i], bodies.half_size[i]
    away = (origin[0] - center[0], origin[1] - center[1], origin[2] - center[2])
    # Early exit: most rays miss the bounding sphere.
    apart, ahead = dot(away, away) - bodies.reach[i], dot(away, ray)
    if apart > 0.0 and (ahead > 0.0 or ahead * ahead < apart):
        return math.inf, -math.inf
    cos, sin = bodies.turn[i, 0], bodies.turn[i, 1]
    o, d = primitives.turn_axes(away, cos, sin), primitives.turn_axes(ray, cos, sin)
    if bodies.shape[i] == primitives.BOX:
        i0, i1, i2 = inverse_of(d[0]), inverse_of(d[1]), inverse_of(d[2])
        a, b, c = -o[0] * i0, -o[1] * i1, -o[2] * i2
        w0, w1, w2 = half[0] * abs(i0), half[1] * abs(i1), half[2] * abs(i2)
        return max(max(a - w0, b - w1), c - w2), min(min(a + w0, b + w1), c + w2)
    if bodies.shape[i] == primitives.CYLINDER:
        level = max(d[0] * d[0] + d[1] * d[1], 1e-18)
        toward = -(o[0] * d[0] + o[1] * d[1])
        rest = level * (half[0] * half[0] - o[0] * o[0] - o[1] * o[1]) + toward * toward
        if rest <= 0.0:
            return math.inf, -math.inf
        root, i2 = math.sqrt(rest), inverse_of(d[2])
        c, w2 = -o[2] * i2, half[2] * abs(i2)
        return max((toward - root) / level, c - w2), min((toward + root) / level, c + w2)
    toward = -dot(o, d)
    rest = half[0] * half[0] - dot(o, o) + toward * toward
    if rest <= 0.0:
        return math.inf, -math.inf
    root = math.sqrt(rest)
    return toward - root, toward + root


@borrowing_kernel
def _room(bounds: NDArray[np.float64], origin: Vec, ray: Vec) -> tuple[float, int]:
    """Return a ray's first hit of floor, walls and ceiling: distance and number."""
    best, seen = math.inf, primitives.SKY
    for side in range(4):
        axis = side // 2
        t = (bounds[side] - origin[axis]) * inverse_of(ray[axis])
        if t <= LEAST_M or t >= best:
            continue
        p = advanced(origin, ray, t)
        other = 1 - axis
        inside = bounds[2 * other] <= p[other] <= bounds[2 * other + 1]
        if inside and -bounds[4] <= p[2] <= 0.0:
            best, seen = t, primitives.WALL_NORTH_SOUTH if axis == 0 else primitives.WALL_EAST_WEST
    for lid in range(2 if bounds[5] > 0.0 else 1):
        t = ((-bounds[4] if lid else 0.0) - origin[2]) * inverse_of(ray[2])
        if t <= LEAST_M or t >= best:
            continue
        p = advanced(origin, ray, t)
        if bounds[0] <= p[0] <= bounds[1] and bounds[2] <= p[1] <= bounds[3]:
            best, seen = t, primitives.CEILING if lid else primitives.FLOOR
    return best, seen


@borrowing_kernel
def _from_mesh(meshes: Meshes, k: int, origin: Vec, ray: Vec) -> tuple[Vec, Vec]:
    """Return a ray relative to mesh k's origin, in its axes and units; directions have length 1."""
    cos, sin, per = meshes.pose[k, 2], meshes.pose[k, 3], 1.0 / meshes.pose[k, 4]
    offset = (
        per * (origin[0] - meshes.pose[k, 0]),
        per * (origin[1] - meshes.pose[k, 1]),
        per * (origin[2] - meshes.pose[k, 5]),
    )
    return primitives.turn_axes(offset, cos, sin), primitives.turn_axes(ray, cos, sin)


@large_borrowing_kernel
def meet(
    bodies: Bodies, meshes: Meshes | None, origin: Vec, ray: Vec, waiting: NDArray[np.int32]
) -> Met:
    """Return the first hit of a ray from `origin` NED [m]; `waiting` (STACK,) is a buffer."""
    best, seen = _room(bodies.bounds, origin, ray)
    mesh, face = -1, -1
    for i in range(len(bodies.shape)):
        if is_owned(meshes, i):
            continue
        enter, leave = _span(bodies, i, origin, ray)
        if leave < enter:
            continue
        # A ray that starts inside a body, as in glass, hits the far side.
        t = enter if enter > LEAST_M else leave
        if LEAST_M < t < best:
            best, seen = t, primitives.OBSTACLE + i
    if meshes is not None:
        for k in range(len(meshes.root)):
            scale = meshes.pose[k, 4]
            at, way = _from_mesh(meshes, k, origin, ray)
            t, which = distance_to(
                meshes.bvh, meshes.root[k], at, way, LEAST_M / scale, best / scale, waiting
            )
            if which >= 0:
                best, seen, mesh, face = t * scale, primitives.OBSTACLE + meshes.first[k], k, which
    return Met(best, seen, mesh, face)


@large_borrowing_kernel
def place_of(
    bodies: Bodies, meshes: Meshes | None, met: Met, origin: Vec, ray: Vec
) -> SurfacePoint:
    """Return the point where a ray hits a body; any body except ceiling and sky."""
    p = advanced(origin, ray, met.distance)
    if meshes is not None and met.mesh >= 0:
        return _on_mesh(meshes, met, p, ray)
    if met.seen >= primitives.OBSTACLE:
        return _on_obstacle(bodies, met.seen - primitives.OBSTACLE, p, ray)
    axis = (
        2 if met.seen == primitives.FLOOR else (0 if met.seen == primitives.WALL_NORTH_SOUTH else 1)
    )
    sign = -1.0 if ray[axis] > 0.0 else 1.0
    return SurfacePoint(p, _scaled_axis(axis, sign), axis)


@kernel
def _scaled_axis(axis: int, by: float) -> Vec:
    """Return the unit vector of an axis, times a factor."""
    return (
        by if axis == 0 else 0.0,
        by if axis == 1 else 0.0,
        by if axis == 2 else 0.0,
    )


@kernel
def _towards(normal: Vec, ray: Vec) -> Vec:
    """Return a normal, flipped to the ray's side."""
    sign = -1.0 if dot(normal, ray) > 0.0 else 1.0
    return (sign * normal[0], sign * normal[1], sign * normal[2])


@borrowing_kernel
def _on_mesh(meshes: Meshes, met: Met, p: Vec, ray: Vec) -> SurfacePoint:
    """Return the point p on a mesh, with its normal."""
    k, n = met.mesh, meshes.bvh.normals[met.face]
    scale, cos, sin = meshes.pose[k, 4], meshes.pose[k, 2], meshes.pose[k, 3]
    at, _ = _from_mesh(meshes, k, p, ray)
    normal = primitives.turn_axes((float(n[0]), float(n[1]), float(n[2])), cos, -sin)
    return SurfacePoint((scale * at[0], scale * at[1], scale * at[2]), _towards(normal, ray), 3)


@borrowing_kernel
def _on_obstacle(bodies: Bodies, i: int, p: Vec, ray: Vec) -> SurfacePoint:
    """Return the point p on obstacle i, with its normal."""
    center, half = bodies.center[i], bodies.half_size[i]
    cos, sin = bodies.turn[i, 0], bodies.turn[i, 1]
    a, b, c = primitives.turn_axes((p[0] - center[0], p[1] - center[1], p[2] - center[2]), cos, sin)
    side = 3
    if bodies.shape[i] == primitives.BOX:
        # The face has the largest coordinate relative to the half size.
        qa, qb, qc = abs(a) / half[0], abs(b) / half[1], abs(c) / half[2]
        side = 2 if qc >= max(qa, qb) else (0 if qa >= qb else 1)
        outward = c if side == 2 else (a if side == 0 else b)
        normal = _scaled_axis(side, math.copysign(1.0, outward))
    elif bodies.shape[i] == primitives.CYLINDER and abs(c) / half[2] * half[0] >= math.hypot(a, b):
        side = 2
        normal = _scaled_axis(side, math.copysign(1.0, c))
    else:
        height = 0.0 if bodies.shape[i] == primitives.CYLINDER else c
        per = 1.0 / max(math.sqrt(a * a + b * b + height * height), 1e-9)
        normal = (per * a, per * b, per * height)
    # Inside glass the far side is visible from within.
    return SurfacePoint((a, b, c), _towards(primitives.turn_axes(normal, cos, -sin), ray), side)


@large_borrowing_kernel
def sunlight(
    bodies: Bodies,
    meshes: Meshes | None,
    lets: NDArray[np.float32],
    own: int,
    at: Vec,
    to_sun: Vec,
    waiting: NDArray[np.int32],
) -> float:
    """Return the share of the sun's light that reaches a point slightly off its surface.

    `lets` (2 + n,) is `Gloss.lets`, `own` the point's surface, as `Met.seen`: a convex body shades
    itself; `waiting` (STACK,) is a buffer.
    """
    share = 1.0
    bounds = bodies.bounds
    for side in range(4):
        axis = side // 2
        t = (bounds[side] - at[axis]) * inverse_of(to_sun[axis])
        # Excludes the wall that holds the point; the same distance as `shadows._STEP_M`.
        if t <= 1e-3:
            continue
        p = advanced(at, to_sun, t)
        other = 1 - axis
        if bounds[2 * other] <= p[other] <= bounds[2 * other + 1] and -bounds[4] <= p[2] <= 0.0:
            share *= lets[WALLS_ROW]
    for i in range(len(bodies.shape)):
        # An opaque body ends the search.
        if share == 0.0:
            return 0.0
        if is_owned(meshes, i) or own == primitives.OBSTACLE + i:
            continue
        enter, leave = _span(bodies, i, at, to_sun)
        if leave >= max(enter, 0.0):
            share *= lets[OBSTACLE_ROW + i]
    if meshes is not None:
        for k in range(len(meshes.root)):
            if share == 0.0:
                return 0.0
            place, way = _from_mesh(meshes, k, at, to_sun)
            least = LEAST_M / meshes.pose[k, 4]
            inverse = (inverse_of(way[0]), inverse_of(way[1]), inverse_of(way[2]))
            if stopped_by(meshes.bvh, meshes.root[k], place, way, inverse, least, -1, waiting) >= 0:
                share *= lets[material_row(meshes, k)]
    return share
