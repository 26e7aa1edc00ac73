"""The colour kernel beside Mitsuba 3, a path tracer: same bodies, albedos, sun and sky."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation

from airl_mav.addons.colour.picture import antialiased, render_picture
from airl_mav.addons.colour.profile import Appearance
from airl_mav.arena.generate import generate
from airl_mav.arena.geometry import Arena
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.core.frames import quat_from_euler
from airl_mav.profiles.arena import ArenaSpec
from airl_mav.profiles.loading import load_profile
from tests.support.meshes import kept, ring, scene_of, triangles
from tests.support.mitsuba_scene import path_traced

LIGHT: dict[str, Any] = {
    "sun": {"azimuth_deg": [200, 200], "elevation_deg": [42, 42], "irradiance": [0.6, 0.6]},
    "sky": {
        "irradiance": [0.4, 0.4],
        "zenith": [200, 200, 200],
        "horizon": [200, 200, 200],
    },
}
"""A sky of one radiance, and a sun."""

PLAIN = {
    "materials": {"mat": {"albedo": [180, 150, 120]}, "earth": {"albedo": [120, 125, 110]}},
    "floor": {"materials": ["earth"]},
    "static": {"materials": ["mat"], "brightness": [0.6, 1.2], "tint": 0.3},
}

CAMERA = Intrinsics.from_fov(96, 64, 1.5)


def arena(name: str, seed: int, **appearance: Any) -> Arena:
    spec = load_profile("arenas", name, ArenaSpec)
    spec = ArenaSpec.model_validate({**spec.model_dump(), "appearance": appearance})
    return generate(spec, seed, name=name, vehicle_width_m=0.55)


def edges(seen: NDArray[np.int32], width: int = 1) -> NDArray[np.bool_]:
    """Return pixels beside an edge of the segmentation: Mitsuba averages over a pixel."""
    found = np.zeros(seen.shape, bool)
    for axis in (0, 1):
        step = np.diff(seen, axis=axis) != 0
        found |= np.concatenate([step, np.zeros_like(step.take([0], axis))], axis)
        found |= np.concatenate([np.zeros_like(step.take([0], axis)), step], axis)
    widened: NDArray[np.bool_] = binary_dilation(found, iterations=width)
    return widened


def difference(
    scene: Arena,
    position: tuple[float, float, float],
    yaw: float,
    *,
    rays: int = 1,
    camera: Intrinsics = CAMERA,
) -> tuple[float, float]:
    """Return the mean absolute difference away from edges and overall, in shares of full scale.

    `rays`: rays per pixel along each axis, of this project's renderer.
    """
    attitude = quat_from_euler(0.03, -0.08, yaw)
    centers = scene.centers_at(0)
    place = np.array(position)
    ours = render_picture(scene, centers, camera, place, attitude)
    theirs = path_traced(scene, centers, camera, place, attitude, samples=48)
    rgb = antialiased(scene, centers, camera, place, attitude, rays)
    apart = np.abs(rgb.astype(float) - theirs) / 255.0
    inner = ~edges(ours.seen)
    assert inner.mean() > 0.4
    return float(apart[inner].mean()), float(apart.mean())


VIEWS = [
    ((0.0, 0.0, -2.5), 0.0),
    ((20.0, 5.0, -3.0), 2.2),
    ((35.0, -10.0, -1.5), math.pi),
    ((10.0, 0.0, -12.0), 0.4),
]


@pytest.mark.parametrize(("position", "yaw"), VIEWS)
def test_plain_materials_are_within_three_percent(
    position: tuple[float, float, float], yaw: float
) -> None:
    inner, _ = difference(arena("dense-obstacles", 3, **LIGHT, **PLAIN), position, yaw)
    assert inner < 0.03


@pytest.mark.nightly
def test_textures_lie_where_they_do_in_the_reference() -> None:
    """Bricks on every obstacle, checks on the floor, by bitmaps of the same patterns."""
    textured = {
        "floor": {"materials": ["checker"]},
        "materials": {"checker": {
            "albedo": [90, 90, 90], "albedo_2": [180, 180, 180], "texture": "checker",
            "size_m": 1.0,
        }},
        "static": {"materials": ["brick"]},
        "walls": {"materials": ["brick"]},
    }  # fmt: skip
    scene = arena("dense-obstacles", 3, **LIGHT, **textured)
    inner, whole = difference(scene, (6.0, -6.0, -3.0), 0.3, rays=4)
    assert inner < 0.03
    assert whole < 0.03
    # Patterns that begin elsewhere are far off: the limits above can fail.
    moved, centers = arena("dense-obstacles", 4, **LIGHT, **textured), scene.centers_at(0)
    place, attitude = np.array([6.0, -6.0, -3.0]), quat_from_euler(0.03, -0.08, 0.3)
    theirs = path_traced(scene, centers, CAMERA, place, attitude, samples=16)
    scene.__dict__["look"] = moved.look
    other = antialiased(scene, centers, CAMERA, place, attitude, 4)
    assert float(np.abs(other.astype(float) - theirs).mean()) / 255.0 > 0.05


def test_a_blue_sky_is_theirs() -> None:
    """Radiance from horizon to zenith, and the resulting light on plain surfaces."""
    inner, _ = difference(arena("static-obstacles", 7, **PLAIN), (0.0, 0.0, -2.5), 0.2)
    assert inner < 0.03


INDOORS = [
    (1, (0.0, 0.0, -2.5), 0.0),
    pytest.param(3, (10.0, 5.0, -1.5), -1.0, marks=pytest.mark.nightly),
    pytest.param(4, (20.0, -5.0, -3.0), 3.0, marks=pytest.mark.nightly),
    (5, (15.0, 8.0, -2.0), 1.0),
]


@pytest.mark.nightly
@pytest.mark.parametrize(("seed", "position", "yaw"), INDOORS)
def test_rooms_below_a_ceiling_are_within_three_percent(
    seed: int, position: tuple[float, float, float], yaw: float
) -> None:
    """The same ceiling lights both; only Mitsuba follows its light from wall to wall."""
    scene = generate(
        load_profile("arenas", "rooms", ArenaSpec), seed, name="rooms", vehicle_width_m=0.55
    )
    inner, _ = difference(scene, position, yaw, rays=4)
    assert inner < 0.03
    # As much light as the whole ceiling would give is too much: the means are worth something.
    look = scene.look
    assert look.light.inside is not None
    scene.__dict__["look"] = replace(look, light=replace(look.light, inside=None))
    assert difference(scene, position, yaw, rays=4)[0] > 1.3 * inner


@pytest.mark.nightly
@pytest.mark.parametrize("material", [pytest.param("plaster", marks=pytest.mark.nightly), "brick"])
def test_meshes_are_theirs(material: str, tmp_path: Path) -> None:
    """Triangles with their shadows, and with bricks as they lie on them."""
    file = kept(triangles(ring()), tmp_path / "ring.npz")
    scene = scene_of(file, [(5.0, -1.0, 0.6, 2.0), (7.0, 3.0, -1.0, 1.4), (4.0, 1.5, 2.0, 0.9)])
    plain = {**LIGHT, **PLAIN, "static": {"materials": [material], "brightness": [0.8, 0.8]}}
    scene = replace(scene, appearance=Appearance.model_validate(plain))
    inner, _ = difference(scene, (0.0, 0.0, -2.0), 0.0, rays=4)
    assert inner < 0.03
    # Its boxes alone are far off: the limit above can fail.
    place, attitude = np.array([0.0, 0.0, -2.0]), quat_from_euler(0.03, -0.08, 0.0)
    centers, boxes = scene.obstacles.center, replace(scene, meshes=())
    theirs = path_traced(scene, centers, CAMERA, place, attitude, samples=16)
    ours = antialiased(boxes, centers, CAMERA, place, attitude, 4)
    shown = render_picture(scene, centers, CAMERA, place, attitude).seen >= 4
    assert float(np.abs(ours.astype(float) - theirs)[shown].mean()) / 255.0 > 0.1


SHINY: dict[str, dict[str, Any]] = {
    "mirror": {"albedo": [242, 242, 240], "surface": "metal"},
    "metal": {"albedo": [200, 200, 190], "surface": "metal", "roughness": 0.6},
    "varnish": {"albedo": [15, 15, 18], "surface": "glossy"},
    "lacquer": {"albedo": [30, 5, 5], "surface": "glossy", "roughness": 0.15},
    "glass": {"albedo": [250, 253, 250], "surface": "glass"},
}


@pytest.mark.nightly
@pytest.mark.parametrize("surface", list(SHINY))
def test_what_is_mirrored_and_seen_through_glass_is_theirs(surface: str) -> None:
    """Every obstacle of one material; a matt one of its colour is farther off."""
    look = {"sun": LIGHT["sun"], "materials": {"own": SHINY[surface]},
            "walls": {"materials": ["plaster"]}, "floor": {"materials": ["concrete"]},
            "static": {"materials": ["own"], "brightness": [1, 1], "tint": 0}}  # fmt: skip
    scene = arena("dense-obstacles", 3, **look)
    place, attitude = np.array([0.0, 0.0, -2.5]), quat_from_euler(0.03, -0.08, 0.0)
    centers = scene.centers_at(0)
    theirs = path_traced(scene, centers, CAMERA, place, attitude, samples=64)
    ours = antialiased(scene, centers, CAMERA, place, attitude, 4)
    picture = render_picture(scene, centers, CAMERA, place, attitude)
    shown = (picture.seen >= 4) & ~edges(picture.seen)
    assert shown.sum() > 500
    apart = float(np.abs(ours.astype(float) - theirs)[shown].mean()) / 255.0
    assert apart < 0.03
    plain = {**SHINY[surface]}
    plain.pop("surface")
    plain.pop("roughness", None)
    scene = arena("dense-obstacles", 3, **{**look, "materials": {"own": plain}})
    matt = antialiased(scene, centers, CAMERA, place, attitude, 4)
    off = float(np.abs(matt.astype(float) - theirs)[shown].mean()) / 255.0
    assert off > 1.5 * apart, (off, apart)


@pytest.mark.nightly
@pytest.mark.timeout(600)  # Compiles kernels, on a busy machine for minutes.
@pytest.mark.parametrize("material", [pytest.param("earth", marks=pytest.mark.nightly), "grass"])
def test_hills_are_theirs(material: str) -> None:
    """Triangles above the floor in its material, with a continuous pattern."""
    scene = arena("hills", 3, **{**LIGHT, **PLAIN, "floor": {"materials": [material]}})
    inner, _ = difference(scene, (-2.0, 0.0, -4.0), 0.2, rays=4)
    assert inner < 0.03
    # A flat floor is far off: the limit above can fail.
    place, attitude = np.array([-2.0, 0.0, -4.0]), quat_from_euler(0.03, -0.08, 0.2)
    centers, flat = scene.obstacles.center, replace(scene, ground=None)
    theirs = path_traced(scene, centers, CAMERA, place, attitude, samples=16)
    ours = antialiased(flat, centers, CAMERA, place, attitude, 4)
    assert float(np.abs(ours.astype(float) - theirs).mean()) / 255.0 > 0.02
