"""Arenas as scenes of Mitsuba 3, a path tracer: the reference of the colour images, without fog.

Adds ambient occlusion and colour bleeding, which the ray caster only averages below a ceiling.
Mitsuba only has pinholes.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from airl_mav.addons.colour import appearance
from airl_mav.addons.colour.shading import GLASS, GLOSSY, INDEX, METAL, is_smooth
from airl_mav.addons.colour.textures import mean_of, periods, texels
from airl_mav.arena import geometry, triangles
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.camera.render import RANGE_M
from airl_mav.core import frames

mi: Any = pytest.importorskip("mitsuba")

Floats = NDArray[np.float64]

VARIANT = "scalar_rgb"
"""Mitsuba variant; requires neither compiler nor GPU."""

MOST_BOUNCES = 8

_SKY_ROWS = 256


def path_traced(
    arena: geometry.Arena,
    centers: Floats,
    camera: Intrinsics,
    position: Floats,
    quaternion: Floats,
    *,
    samples: int,
) -> NDArray[np.uint8]:
    """Return the sRGB image of an arena, with `samples` paths a pixel."""
    assert arena.look.light.extinction == 0.0
    assert camera.model.planar
    mi.set_variant(VARIANT)
    # Only `volpath` lets sunlight through glass.
    glass = bool((arena.look.finish.surface == GLASS).any())
    integrator = {"type": "volpath" if glass else "path", "max_depth": MOST_BOUNCES}
    bodies = _lights(arena.look.light) | _bodies(arena, centers)
    scene = mi.load_dict({"type": "scene", "integrator": integrator, **bodies})
    sensor = mi.load_dict(_sensor(frames.quat_to_matrix(quaternion).T, position, camera, samples))
    light = np.array(mi.render(scene, sensor=sensor, seed=0))[..., :3]
    encoded: NDArray[np.uint8] = np.rint(255.0 * appearance.srgb_of(light)).astype(np.uint8)
    return encoded


def _sensor(axes: Floats, position: Floats, camera: Intrinsics, samples: int) -> dict[str, Any]:
    """Return a pinhole camera; axes (3, 3) forward, right, down."""
    forward, right, down = axes
    # Mitsuba's camera looks along +z; x points to the left of the image, y up.
    pose = np.eye(4)
    pose[:3, :4] = np.column_stack([-right, -down, forward, position])
    return {
        "type": "perspective",
        "fov_axis": "x",
        "fov": math.degrees(camera.horizontal_fov_rad),
        "near_clip": 0.001,
        "far_clip": 2.0 * RANGE_M,
        "to_world": mi.ScalarTransform4f(pose),
        "film": {
            "type": "hdrfilm",
            "width": camera.width,
            "height": camera.height,
            "rfilter": {"type": "box"},
            "pixel_format": "rgb",
        },
        "sampler": {"type": "independent", "sample_count": samples},
    }


def _lights(light: appearance.Light) -> dict[str, Any]:
    """Return sun and sky. A white surface reflects 1 / pi of its irradiance in each direction."""
    # Sine of each row's elevation; 0 below the horizon.
    sine = np.sin((0.5 - (np.arange(_SKY_ROWS) + 0.5) / _SKY_ROWS) * math.pi).clip(0.0)
    rows = light.horizon + sine[:, None] * (light.zenith - light.horizon)
    sky = np.repeat(rows[:, None], 2 * _SKY_ROWS, axis=1).astype(np.float32)
    # The map's pole is +y; up is -z here.
    turn = np.array([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]], np.float64)
    lights: dict[str, Any] = {
        "sky": {
            "type": "envmap",
            "bitmap": mi.Bitmap(sky),
            "to_world": mi.ScalarTransform4f(turn),
        }
    }
    if light.sun.any():
        lights["sun"] = {
            "type": "directional",
            # Mitsuba expects the direction of the light's travel.
            "direction": (-light.to_sun).tolist(),
            "irradiance": {"type": "rgb", "value": (math.pi * light.sun).tolist()},
        }
    return lights


def _bodies(arena: geometry.Arena, centers: Floats) -> dict[str, Any]:
    b, finish, o = arena.bounds, arena.look.finish, arena.obstacles
    north, east = 0.5 * (b.north_min + b.north_max), 0.5 * (b.east_min + b.east_max)
    half_n, half_e, half_h = b.north_max - north, b.east_max - east, 0.5 * b.height
    x, y, z = np.eye(3)
    made = [
        # Across is east, along (down in the pattern's image) is south.
        _face(finish, appearance.FLOOR, np.array([north, east, 0.0]), half_e * y, -half_n * x),
        _ground(finish),
    ]
    for side in (-1.0, 1.0):
        at = np.array([north + side * half_n, east, -half_h])
        made.append(_face(finish, appearance.WALLS, at, half_e * y, half_h * z))
        at = np.array([north, east + side * half_e, -half_h])
        made.append(_face(finish, appearance.WALLS, at, half_n * x, half_h * z))
    if b.ceiling:
        made.append(_ceiling(arena.look.light, np.array([north, east, -b.height]), half_n, half_e))
    if arena.ground is not None:
        made.append(_hills(finish, arena.ground))
    for each in arena.meshes:
        made.append(_mesh(finish, appearance.OBSTACLE + each.first, each))
    for i in range(len(o)):
        if arena.mesh_of(i) is not None:
            continue
        row, half, at = appearance.OBSTACLE + i, o.half_size[i], centers[i]
        if o.shape[i] == geometry.Shape.BOX:
            made += _box(finish, row, at, half, float(o.yaw[i]))
        elif o.shape[i] == geometry.Shape.CYLINDER:
            made += _cylinder(finish, row, at, half)
        else:
            made.append(_sphere(finish, row, at, float(half[0])))
    return {f"body_{k}": body for k, body in enumerate(made)}


def _face(
    finish: appearance.Finish,
    row: int,
    center: Floats,
    across: Floats,
    along: Floats,
    origin: Floats | None = None,
) -> dict[str, Any]:
    """Return a rectangle. Its pattern starts at the world's origin, or at `origin`."""
    pose = np.eye(4)
    pose[:3, :4] = np.column_stack([across, along, np.cross(across, along), center])
    pose[:3, 2] /= np.linalg.norm(pose[:3, 2])
    width, height = float(np.linalg.norm(across)), float(np.linalg.norm(along))
    middle = center if origin is None else center - origin
    first = middle @ across / width - width, middle @ along / height - height
    per_m = _per_m(finish, row)
    size, begin = (2.0 * width * per_m, 2.0 * height * per_m), finish.offset[row]
    start = (float(first[0] * per_m + begin[0]), float(first[1] * per_m + begin[1]))
    bsdf = _material(finish, row, size, start)
    return {"type": "rectangle", "to_world": mi.ScalarTransform4f(pose), "bsdf": bsdf}


def _ceiling(
    light: appearance.Light, center: Floats, half_n: float, half_e: float
) -> dict[str, Any]:
    """Return a ceiling that emits light downwards and reflects nothing."""
    pose = np.diag([half_n, half_e, 1.0, 1.0])
    pose[:3, 3] = center
    return {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f(pose),
        "bsdf": _diffuse(np.zeros(3)),
        "emitter": {"type": "area", "radiance": {"type": "rgb", "value": light.zenith.tolist()}},
    }


def _ground(finish: appearance.Finish) -> dict[str, Any]:
    """Return the ground beyond the walls, slightly below the floor, with its mean albedo."""
    dark, bright = finish.albedo[appearance.FLOOR]
    mean = dark + mean_of(finish, appearance.FLOOR) * (bright - dark)
    pose = np.diag([RANGE_M, RANGE_M, 1.0, 1.0])
    # Down is positive, so the floor covers it.
    pose[2, 3] = 0.01
    return {"type": "disk", "to_world": mi.ScalarTransform4f(pose), "bsdf": _diffuse(mean)}


def _box(
    finish: appearance.Finish, row: int, center: Floats, half: Floats, yaw: float
) -> list[dict[str, Any]]:
    cos, sin = math.cos(yaw), math.sin(yaw)
    axes = np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])
    a, b, c = half[:, None] * axes
    faces = [(a, b, c), (b, a, c), (c, a, b)]
    return [
        _face(finish, row, center + side * out, across, along, origin=center)
        for out, across, along in faces
        for side in (-1.0, 1.0)
    ]


def _cylinder(
    finish: appearance.Finish, row: int, center: Floats, half: Floats
) -> list[dict[str, Any]]:
    radius, height, per_m = float(half[0]), float(half[2]), _per_m(finish, row)
    begin = finish.offset[row]
    # The second texture coordinate runs from end to end, here from the top down.
    bsdf = _material(
        finish,
        row,
        (_around(finish, row, radius), 2.0 * height * per_m),
        (begin[0], begin[1] - height * per_m),
    )
    ends = [(center + np.array([0.0, 0.0, side * height])).tolist() for side in (-1.0, 1.0)]
    side = {"type": "cylinder", "p0": ends[0], "p1": ends[1], "radius": radius, "bsdf": bsdf}
    dark, bright = finish.albedo[row]
    mean = _reflecting(finish, row, _rgb(dark + mean_of(finish, row) * (bright - dark)))
    caps = []
    for end in ends:
        pose = np.diag([radius, radius, 1.0, 1.0])
        pose[:3, 3] = end
        caps.append({"type": "disk", "to_world": mi.ScalarTransform4f(pose), "bsdf": mean})
    return [side, *caps]


def _sphere(finish: appearance.Finish, row: int, center: Floats, radius: float) -> dict[str, Any]:
    around, begin = _around(finish, row, radius), finish.offset[row]
    # The second texture coordinate runs from the pole at +z down to the opposite pole.
    bsdf = _material(finish, row, (around, -0.5 * around), (begin[0], begin[1] + 0.25 * around))
    return {"type": "sphere", "center": center.tolist(), "radius": radius, "bsdf": bsdf}


def _mesh(finish: appearance.Finish, row: int, placed: geometry.PlacedMesh) -> Any:
    """Return a mesh of flat triangles. Its pattern matches `surfaces.shade_meshes`."""
    vertices, faces = triangles.standing(placed)
    corners = placed.scale * triangles.triangles_of(placed.file).corners.astype(np.float64)
    return _triangles(finish, row, corners, vertices[faces])


def _hills(finish: appearance.Finish, ground: geometry.Ground) -> Any:
    """Return hills with the floor's pattern: across is east, along is south."""
    corners = ground.points[ground.faces]
    own = corners[..., [1, 0, 2]] * (1.0, -1.0, 1.0)
    return _triangles(finish, appearance.FLOOR, own, corners)


def _triangles(finish: appearance.Finish, row: int, corners: Floats, placed: Floats) -> Any:
    """Return flat triangles with a pattern as in `surfaces.shade_meshes`.

    `corners` (m, 3, 3) are along the mesh's axes, `placed` (m, 3, 3) NED [m]; `row` is the
    material.
    """
    normals = np.abs(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    q0, q1, q2 = normals.T[..., None]
    level = q2 >= np.maximum(q0, q1)
    across = np.where(level | (q1 > q0), corners[..., 0], corners[..., 1])
    along = np.where(level, corners[..., 1], corners[..., 2])
    # Both are in periods, so the texture needs no transform.
    places = _per_m(finish, row) * np.stack([across, along], axis=-1) + finish.offset[row]
    properties = mi.Properties()
    properties["mesh_bsdf"] = mi.load_dict(_material(finish, row, (1.0, 1.0), (0.0, 0.0)))
    count = len(corners)
    # Vertices are not shared, because each triangle has its own texture coordinates.
    mesh = mi.Mesh("mesh", 3 * count, count, has_vertex_texcoords=True, props=properties)
    data = mi.traverse(mesh)
    data["vertex_positions"] = placed.astype(np.float32).ravel()
    data["vertex_texcoords"] = places.astype(np.float32).ravel()
    data["faces"] = np.arange(3 * count, dtype=np.uint32)
    data.update()
    return mesh


def _per_m(finish: appearance.Finish, row: int) -> float:
    """Return the periods of a pattern per metre."""
    return 1.0 / float((finish.size_m * periods(finish))[row])


def _around(finish: appearance.Finish, row: int, radius: float) -> float:
    """Return the periods of a pattern around a body."""
    return max(round(2.0 * math.pi * radius * _per_m(finish, row)), 1.0)


def _diffuse(albedo: Floats) -> dict[str, Any]:
    return _two_sided({"type": "diffuse", "reflectance": _rgb(albedo)})


def _rgb(albedo: Floats) -> dict[str, Any]:
    return {"type": "rgb", "value": albedo.tolist()}


def _two_sided(bsdf: dict[str, Any]) -> dict[str, Any]:
    return {"type": "twosided", "bsdf": bsdf}


def _reflecting(finish: appearance.Finish, row: int, albedo: dict[str, Any]) -> dict[str, Any]:
    """Return a material with an albedo, optionally a texture; optical model as in `gloss`."""
    surface, alpha = finish.surface[row], float(finish.roughness[row] ** 2)
    if surface == GLASS:
        # The dielectric already has two sides.
        return {"type": "thindielectric", "int_ior": INDEX, "specular_transmittance": albedo}
    rough = {} if is_smooth(alpha) else {"distribution": "ggx", "alpha": alpha}
    if surface == METAL:
        kind = "roughconductor" if rough else "conductor"
        return _two_sided(
            {"type": kind, "material": "none", "specular_reflectance": albedo, **rough}
        )
    if surface == GLOSSY:
        kind = "roughplastic" if rough else "plastic"
        return _two_sided({"type": kind, "int_ior": INDEX, "diffuse_reflectance": albedo, **rough})
    return _two_sided({"type": "diffuse", "reflectance": albedo})


def _material(
    finish: appearance.Finish,
    row: int,
    size: tuple[float, float],
    start: tuple[float, float],
) -> dict[str, Any]:
    """Return a material with a pattern from `start` over `size`, both in periods."""
    dark, bright = finish.albedo[row]
    if appearance.TEXTURES.index("plain") == finish.texture[row]:
        return _reflecting(finish, row, _rgb(dark))
    mixed = (dark + texels(finish, row) * (bright - dark)).astype(np.float32)
    place = np.eye(4)
    place[0, 0], place[1, 1], place[0, 3], place[1, 3] = *size, *start
    texture = {
        "type": "bitmap",
        "bitmap": mi.Bitmap(mixed),
        # Albedos are linear, so Mitsuba must not convert them from sRGB.
        "raw": True,
        "filter_type": "nearest",
        "to_uv": mi.ScalarTransform4f(place),
    }
    return _reflecting(finish, row, texture)
