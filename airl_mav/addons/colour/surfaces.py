"""Shading of sky, floor, walls, obstacles and meshes in colour images.

Images are shaded in blocks of consecutive lines: pattern coordinates and light, then texels, then
colours.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from airl_mav.addons.colour import shading
from airl_mav.addons.colour.appearance import FLOOR as FLOOR_ROW
from airl_mav.addons.colour.appearance import OBSTACLE as OBSTACLE_ROW
from airl_mav.addons.colour.appearance import WALLS as WALLS_ROW
from airl_mav.addons.colour.shading import (
    F32,
    I32,
    LEAST,
    ONE,
    ZERO,
    Canvas,
    Lit,
    PixelRays,
    SceneLook,
    material_row,
    packed,
    paint,
    surface_of,
    texel_at,
)
from airl_mav.addons.colour.shadows import along32, ray32, start32, widened
from airl_mav.camera import primitives
from airl_mav.camera.bvh import Meshes
from airl_mav.camera.meshes import Faces
from airl_mav.camera.projection import MIN_DEPTH_M, Optics, Pose, ProjectedBody
from airl_mav.core.kernels import borrowing_kernel, large_borrowing_kernel
from airl_mav.vehicle.rotation import Vec

BLOCK: Final = 512
"""Pixels per shading block; keeps intermediate results in the processor cache."""

FOG_LAYER_M: Final = 100.0
"""Height of the fog above the floor, seen towards the sky [m]."""


@borrowing_kernel
def span_of(
    ids: primitives.Ids, low: int, high: int, left: int, end: int, first: np.int32, last: np.int32
) -> tuple[int, int]:
    """Return the part of left..end that sees surfaces first..last, in whole vectors."""
    seen, length = ids[left:end], I32(end - left)
    begin, stop = length, I32(0)
    # A branch-free reduction, so that the loop vectorizes.
    for u in range(end - left):
        here = (seen[u] >= first) & (seen[u] <= last)
        at = I32(u)
        begin = min(begin, at if here else length)
        stop = max(stop, I32(at + I32(1)) if here else I32(0))
    if stop == 0:
        return 0, 0
    return widened(left + int(begin), left + int(stop), low, high)


@borrowing_kernel
def write_rays(rays: PixelRays, optics: Optics) -> None:
    """Write the ray of every pixel of an image's lines."""
    axes, lines, xs = optics.axes, optics.lines, optics.xs
    r = along32(axes)
    n = len(xs)
    for v in range(len(lines)):
        start = start32(axes, lines[v, 0], lines[v, 1])
        north, east, down = (
            rays.north[v * n : v * n + n],
            rays.east[v * n : v * n + n],
            rays.down[v * n : v * n + n],
        )
        for u in range(n):
            north[u], east[u], down[u] = ray32(axes, r, optics.bent, v, u, start, F32(xs[u]))


@borrowing_kernel
def draw_sky(canvas: Canvas, camera: Vec, light: Lit) -> None:
    """Write sky and, below the horizon, ground as bright as the mean floor; or the ceiling."""
    out, ids, rays, points = canvas.out, canvas.ids, canvas.rays, canvas.points
    above = F32(max(-camera[2], MIN_DEPTH_M))
    zenith, horizon, ground = light.zenith, light.horizon, light.ground
    # Sky pixels have no surface, so the buffers of `Points` are free.
    rises, clear = points.up, points.pattern
    begin, stop = span_of(
        ids, 0, len(ids), 0, len(ids), I32(primitives.CEILING), I32(primitives.SKY)
    )
    for left in range(begin, stop, BLOCK):
        end = min(left + BLOCK, stop)
        row, norths, easts, downs = (
            out[left:end],
            rays.north[left:end],
            rays.east[left:end],
            rays.down[left:end],
        )
        for u in range(end - left):
            n, e, d = norths[u], easts[u], downs[u]
            rises[u] = -d / np.sqrt(n * n + e * e + d * d)
            clear[u] = ONE
        if light.extinction > 0.0:
            for u in range(end - left):
                thick = F32(FOG_LAYER_M) if rises[u] > ZERO else above
                clear[u] = math.exp(-light.extinction * thick / max(abs(rises[u]), LEAST))
        for u in range(end - left):
            rise, through = rises[u], clear[u]
            share = through * max(rise, ZERO)
            red = share * (zenith[0] - horizon[0])
            green = share * (zenith[1] - horizon[1])
            blue = share * (zenith[2] - horizon[2])
            # Below the horizon the ground has one colour.
            red = red if rise >= ZERO else through * (ground[0] - horizon[0])
            green = green if rise >= ZERO else through * (ground[1] - horizon[1])
            blue = blue if rise >= ZERO else through * (ground[2] - horizon[2])
            row[u] = packed(horizon[0] + red, horizon[1] + green, horizon[2] + blue)


@borrowing_kernel
def shade_floor(canvas: Canvas, look: SceneLook, camera: Vec) -> None:
    """Shade the floor. Its pattern begins at the start position."""
    floor, rays, points = surface_of(look, FLOOR_ROW), canvas.rays, canvas.points
    ids, far, light, pixel2 = canvas.ids, canvas.far, look.light, look.pixel2
    at0, at1 = F32(camera[0]), F32(camera[1])
    sun_up = -light.to_sun[2]
    # t times the downward slope of the ray is the camera's height.
    texel = shading.texels2(floor, pixel2) / F32(max(-camera[2], MIN_DEPTH_M))
    own = I32(primitives.FLOOR)
    begin, stop = span_of(ids, 0, len(ids), 0, len(ids), own, own)
    for left in range(begin, stop, BLOCK):
        end = min(left + BLOCK, stop)
        depths, norths, easts = far[left:end], rays.north[left:end], rays.east[left:end]
        for u in range(end - left):
            t = depths[u]
            across = (at1 + t * easts[u]) * floor.per_m + floor.offset[0]
            along = floor.offset[1] - (at0 + t * norths[u]) * floor.per_m
            points.place[u] = texel_at(across, along, texel * t * t * t)
            points.facing[u] = sun_up
            points.up[u] = ONE
        paint(canvas, look, floor, left, end, own, own)


@borrowing_kernel
def shade_walls(canvas: Canvas, look: SceneLook, camera: Vec) -> None:
    """Shade the walls. Their pattern begins at the foot, north and east of the start."""
    walls, rays, points = surface_of(look, WALLS_ROW), canvas.rays, canvas.points
    ids, far, light, pixel2 = canvas.ids, canvas.far, look.light, look.pixel2
    at0, at1, at2 = F32(camera[0]), F32(camera[1]), F32(camera[2])
    sun0, sun1 = light.to_sun[0], light.to_sun[1]
    texel = shading.texels2(walls, pixel2)
    first, last = I32(primitives.WALL_NORTH_SOUTH), I32(primitives.WALL_EAST_WEST)
    begin, stop = span_of(ids, 0, len(ids), 0, len(ids), first, last)
    for left in range(begin, stop, BLOCK):
        end = min(left + BLOCK, stop)
        seen, depths = ids[left:end], far[left:end]
        norths, easts, downs = rays.north[left:end], rays.east[left:end], rays.down[left:end]
        for u in range(end - left):
            t, n, e, d = depths[u], norths[u], easts[u], downs[u]
            north = seen[u] == first
            normal, to_sun = (n if north else e), (sun0 if north else sun1)
            # Walls are thin: the side facing the camera decides the light.
            to_sun = -to_sun if normal > ZERO else to_sun
            across = (at1 + t * e if north else at0 + t * n) * walls.per_m + walls.offset[0]
            along = (at2 + t * d) * walls.per_m + walls.offset[1]
            texels = texel * t * t / max(abs(normal), shading.STEEP)
            points.place[u] = texel_at(across, along, texels)
            points.facing[u] = max(to_sun, ZERO)
            points.up[u] = ZERO
        paint(canvas, look, walls, left, end, first, last)


@borrowing_kernel
def shade_obstacle(
    canvas: Canvas,
    look: SceneLook,
    optics: Optics,
    body: ProjectedBody,
    rectangle: NDArray[np.int32],
) -> None:
    """Shade an obstacle in a rectangle of the image.

    A box's pattern begins in the middle of each face. A cylinder's pattern wraps around it in a
    whole number of periods, a sphere's follows longitude and latitude.
    """
    shape, half, light, points = body.shape, body.half, look.light, canvas.points
    ids, far, lines, xs = canvas.ids, canvas.far, optics.lines, optics.xs
    surface = surface_of(look, OBSTACLE_ROW + body.number)
    cos, sin = (math.cos(body.yaw), math.sin(body.yaw)) if shape == primitives.BOX else (1.0, 0.0)
    pose = primitives.turned(body.pose, cos, sin)
    c0, c1, c2 = F32(pose.center[0]), F32(pose.center[1]), F32(pose.center[2])
    r = along32(pose)
    s0 = F32(cos * light.to_sun[0] + sin * light.to_sun[1])
    s1 = F32(cos * light.to_sun[1] - sin * light.to_sun[0])
    s2 = light.to_sun[2]
    per0, per1, per2 = F32(1.0 / half[0]), F32(1.0 / half[1]), F32(1.0 / half[2])
    texel, radius = shading.texels2(surface, look.pixel2), F32(half[0])
    per_m, begin_u, begin_v = surface.per_m, surface.offset[0], surface.offset[1]
    per_turn = shading.periods_around(half[0], per_m)
    place, facing, ups = points.place, points.facing, points.up
    own = I32(primitives.OBSTACLE + body.number)
    for v in range(rectangle[0], rectangle[1]):
        line = v * len(xs)
        low, high = line + rectangle[2], line + rectangle[3]
        left, end = span_of(ids, line, line + len(xs), low, high, own, own)
        if end == 0:
            continue
        x_row, far_row = xs[left - line : end - line], far[left:end]
        start, first = start32(pose, lines[v, 0], lines[v, 1]), left - line
        if shape == primitives.BOX:
            for u in range(end - left):
                t = far_row[u]
                n, e, d = ray32(pose, r, optics.bent, v, first + u, start, F32(x_row[u]))
                a, b, c = t * n - c0, t * e - c1, t * d - c2
                # The face has the largest coordinate relative to the half size.
                qa, qb, qc = abs(a) * per0, abs(b) * per1, abs(c) * per2
                on_c = qc >= max(qa, qb)
                on_a = qa >= qb
                normal = d if on_c else (n if on_a else e)
                outward = c if on_c else (a if on_a else b)
                to_sun = s2 if on_c else (s0 if on_a else s1)
                to_sun = to_sun if outward > ZERO else -to_sun
                up = ONE if c < ZERO else -ONE
                across, along = shading.on_box(a, b, c, on_c, on_a)
                # A pixel covers more texels with the square of the depth, and on oblique faces.
                texels = texel * t * t / max(abs(normal), shading.STEEP)
                place[u] = texel_at(across * per_m + begin_u, along * per_m + begin_v, texels)
                facing[u] = max(to_sun, ZERO)
                ups[u] = up if on_c else ZERO
        elif shape == primitives.CYLINDER:
            for u in range(end - left):
                t = far_row[u]
                n, e, d = ray32(pose, r, optics.bent, v, first + u, start, F32(x_row[u]))
                a, b, c = t * n - c0, t * e - c1, t * d - c2
                cap = abs(c) * per2 * radius >= np.sqrt(a * a + b * b)
                normal = d if cap else (a * n + b * e) * per0
                vertical = s2 if c > ZERO else -s2
                to_sun = vertical if cap else (a * s0 + b * s1) * per0
                up = ONE if c < ZERO else -ONE
                across, along = shading.on_cylinder(a, b, c, cap, per_m, per_turn)
                texels = texel * t * t / max(abs(normal), shading.STEEP)
                place[u] = texel_at(across + begin_u, along + begin_v, texels)
                facing[u] = max(to_sun, ZERO)
                ups[u] = up if cap else ZERO
        else:
            for u in range(end - left):
                t = far_row[u]
                n, e, d = ray32(pose, r, optics.bent, v, first + u, start, F32(x_row[u]))
                a, b, c = t * n - c0, t * e - c1, t * d - c2
                normal = (a * n + b * e + c * d) * per0
                to_sun = (a * s0 + b * s1 + c * s2) * per0
                across, along = shading.on_sphere(a, b, c, per_turn)
                texels = texel * t * t / max(abs(normal), shading.STEEP)
                place[u] = texel_at(across + begin_u, along + begin_v, texels)
                facing[u] = max(to_sun, ZERO)
                ups[u] = min(max(-c * per0, -ONE), ONE)
        paint(canvas, look, surface, left, end, own, own)


@large_borrowing_kernel
def shade_meshes(
    canvas: Canvas,
    look: SceneLook,
    optics: Optics,
    rectangles: primitives.Rectangles,
    meshes: Meshes,
    faces: Faces,
) -> None:
    """Shade the visible flat triangles of meshes, with a pattern along the nearest mesh axis."""
    for k in range(len(meshes.first)):
        rectangle = rectangles[len(meshes.owner) + k, 0]
        _shade_mesh(canvas, look, optics, rectangle, meshes, k, faces)


@large_borrowing_kernel
def _shade_mesh(
    canvas: Canvas,
    look: SceneLook,
    optics: Optics,
    rectangle: NDArray[np.int32],
    meshes: Meshes,
    k: int,
    faces: Faces,
) -> None:
    """Shade the visible part of mesh k in a rectangle (4,) of the image."""
    ids, far, points, light = canvas.ids, canvas.far, canvas.points, look.light
    lines, xs, axes, camera = optics.lines, optics.xs, optics.axes, optics.camera
    surface = surface_of(look, material_row(meshes, k))
    cos, sin = meshes.pose[k, 2], meshes.pose[k, 3]
    offset = (
        meshes.pose[k, 0] - camera[0],
        meshes.pose[k, 1] - camera[1],
        meshes.pose[k, 5] - camera[2],
    )
    pose = primitives.turned(Pose(axes.forward, axes.across, axes.along, offset), cos, sin)
    c0, c1, c2 = F32(pose.center[0]), F32(pose.center[1]), F32(pose.center[2])
    r = along32(pose)
    # The sun in the mesh's axes.
    s0 = F32(cos * light.to_sun[0] + sin * light.to_sun[1])
    s1 = F32(cos * light.to_sun[1] - sin * light.to_sun[0])
    s2 = light.to_sun[2]
    texel, per_m = shading.texels2(surface, look.pixel2), surface.per_m
    begin_u, begin_v = surface.offset[0], surface.offset[1]
    normals = meshes.bvh.normals
    own = I32(primitives.OBSTACLE + meshes.first[k])
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
                # Not painted; any valid index will do.
                points.place[u] = I32(1)
                continue
            t, i = far[at], faces[at]
            n, e, d = ray32(pose, r, optics.bent, v, at - line, start, F32(xs[at - line]))
            n0, n1, n2 = normals[i, 0], normals[i, 1], normals[i, 2]
            normal = n0 * n + n1 * e + n2 * d
            # The visible side faces the camera.
            side = -ONE if normal > ZERO else ONE
            a, b, c = t * n - c0, t * e - c1, t * d - c2
            across, along = shading.on_triangle(a, b, c, n0, n1, n2)
            texels = texel * t * t / max(abs(normal), shading.STEEP)
            points.place[u] = texel_at(across * per_m + begin_u, along * per_m + begin_v, texels)
            points.facing[u] = max(side * (n0 * s0 + n1 * s1 + n2 * s2), ZERO)
            points.up[u] = -side * n2
        paint(canvas, look, surface, left, end, own, own)
