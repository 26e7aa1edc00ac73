"""Single rays through an arena: the first hit, and the sunlight at a point.

Images are drawn body by body (`raycast`, `shadows`), all rays of the camera at once. This module
handles the few rays with other origins: reflections, and transmission through glass. Computes in
float64; a ray is a unit vector.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from airl_mav.arena.finishes import OBSTACLE as OBSTACLE_ROW
from airl_mav.arena.finishes import WALLS as WALLS_ROW
from airl_mav.camera import primitives
from airl_mav.camera.bvh import Meshes, is_owned, material_row
from airl_mav.camera.meshes import distance_to, inverse_of, stopped_by
from airl_mav.camera.projection import Scene, dot
from airl_mav.core.kernels import borrowing_kernel, kernel, large_borrowing_kernel
from airl_mav.vehicle.rotation import Vec

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
