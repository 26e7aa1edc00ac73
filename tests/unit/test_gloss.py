"""Varnish, metal, mirrors and glass beside closed forms, integrals and mirrored cameras."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import quad

from airl_mav.addons.colour.appearance import linear_of
from airl_mav.addons.colour.batch import ColourImages, Looks
from airl_mav.addons.colour.picture import ColourArrays, Picture, render_picture
from airl_mav.addons.colour.profile import Appearance, Material
from airl_mav.addons.colour.shading import (
    MATT,
    SAMPLES,
    VARNISH_ADMITS,
    Gloss,
    facet,
    facet_gives,
    fresnel,
    highlight,
    mirrored,
    pane_reflects,
    spread,
)
from airl_mav.arena.generate import generate
from airl_mav.arena.geometry import Arena, Bounds, Obstacles, Shape
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.camera.render import camera_pose
from airl_mav.core.frames import quat_from_euler
from airl_mav.envs.arena_batch import batch_of
from airl_mav.envs.mesh_batch import MeshesSeen
from airl_mav.profiles.arena import ArenaSpec
from airl_mav.profiles.loading import load_profile
from tests.learning.test_fleet_meshes import MOUNT, scattered
from tests.support.meshes import kept, ring, scene_of, triangles

UP = (0.0, 0.0, -1.0)
CAMERA = Intrinsics.from_fov(64, 48, math.pi / 2)
SHINY = ("mirror", "glass", "lacquer", "brushed-steel", "brick")


def clear(**more: Any) -> dict[str, Any]:
    """An appearance of which each draw is known."""
    grey = [200, 200, 200]
    return {
        "materials": {
            "dark": {"albedo": [0, 0, 0]},
            "pale": {"albedo": [188, 188, 188]},
            "clear": {"albedo": [255, 255, 255], "surface": "glass"},
            "silver": {"albedo": [255, 255, 255], "surface": "metal"},
            "varnish": {"albedo": [0, 0, 0], "surface": "glossy"},
        },
        "walls": {"materials": ["brick"]},
        "floor": {"materials": ["pale"]},
        "sky": {"irradiance": [0.4, 0.4], "zenith": grey, "horizon": grey},
        "sun": {
            "azimuth_deg": [180, 180],
            "elevation_deg": [45, 45],
            "irradiance": [0.6, 0.6],
            "colour": [255, 255, 255],
        },
        **more,
    }


def box(at: tuple[float, float, float], half: tuple[float, float, float]) -> Obstacles:
    return Obstacles(np.array([Shape.BOX], np.int8), np.array([at]), np.array([half]), np.zeros(1))


def scene(obstacles: Obstacles, **look: Any) -> Arena:
    bounds = Bounds(-20.0, 20.0, -20.0, 20.0, 5.0)
    appearance = Appearance.model_validate(clear(**look))
    return Arena("some", 0, bounds, (153, 0, 0), obstacles, (), np.zeros(2), appearance)


def see(
    world: Arena, at: tuple[float, float, float], yaw: float = 0.0, pitch: float = 0.0
) -> Picture:
    attitude = quat_from_euler(0.0, pitch, yaw)
    return render_picture(world, world.obstacles.center, CAMERA, np.array(at), attitude)


def test_fresnels_equations() -> None:
    assert fresnel(1.0) == pytest.approx(((1.5 - 1.0) / (1.5 + 1.0)) ** 2)
    assert fresnel(0.0) == pytest.approx(1.0)
    # At Brewster's angle only one polarisation is reflected.
    brewster = math.cos(math.atan(1.5))
    assert fresnel(brewster) == pytest.approx(0.5 * ((1.5**2 - 1.0) / (1.5**2 + 1.0)) ** 2)
    mean, _ = quad(lambda cosine: 2.0 * cosine * fresnel(cosine), 0.0, 1.0)
    assert pytest.approx(1.0 - mean, abs=1e-6) == VARNISH_ADMITS


def test_a_pane_reflects_all_that_goes_to_and_fro() -> None:
    once = fresnel(0.6)
    series = once + sum((1.0 - once) ** 2 * once ** (2 * k + 1) for k in range(50))
    assert pane_reflects(0.6) == pytest.approx(series)


@pytest.mark.parametrize("alpha", [0.1, 0.3, 0.6])
@pytest.mark.parametrize("cosine", [0.95, 0.6, 0.3])
def test_sampled_facets_reflect_what_highlights_add_up_to(alpha: float, cosine: float) -> None:
    """A white sky seen in rough metal: the sun from everywhere, and the mean of the samples."""
    ray = (math.sqrt(1.0 - cosine * cosine), 0.0, cosine)
    # Suns evenly over the half of all directions above the surface.
    n = 200
    z, turn = np.meshgrid((np.arange(n) + 0.5) / n, (np.arange(2 * n) + 0.5) * math.pi / n)
    level = np.sqrt(1.0 - z * z)
    suns = np.stack([level * np.cos(turn), level * np.sin(turn), -z], axis=-1).reshape(-1, 3)
    whole = np.mean([highlight(alpha, UP, ray, tuple(sun))[0] for sun in suns.tolist()]) * 2.0

    def reflected(points: list[tuple[float, float]]) -> float:
        return float(
            np.mean(
                [
                    facet_gives(alpha, UP, mirrored(ray, facet(alpha, UP, ray, u, v)))
                    for u, v in points
                ]
            )
        )

    fine = ((np.arange(100) + 0.5) / 100).tolist()
    assert reflected([(u, v) for u in fine for v in fine]) == pytest.approx(whole, abs=0.003)
    assert reflected([spread(k) for k in range(SAMPLES)]) == pytest.approx(whole, abs=0.06)
    assert whole < 1.0


def test_facets_are_unit_vectors_that_are_seen() -> None:
    rng = np.random.default_rng(3)
    for _ in range(200):
        normal, ray = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
        ray = ray if normal @ ray < 0.0 else -ray
        for k in range(SAMPLES):
            found = np.array(facet(0.4, tuple(normal), tuple(ray), *spread(k)))
            assert np.linalg.norm(found) == pytest.approx(1.0)
            assert found @ normal >= 0.0
            assert found @ ray <= 1e-9


def test_all_matt_costs_nothing() -> None:
    world = scene(box((5.0, 0.0, -2.0), (1.0, 1.0, 2.0)), static={"materials": ["brick"]})
    assert Gloss.of(world.look.finish) is None


@pytest.mark.nightly
def test_a_mirror_shows_what_a_mirrored_camera_sees() -> None:
    """The south face of a box, 6 m ahead: left and right change places, and nothing else."""
    there = box((7.0, 0.0, -2.5), (1.0, 8.0, 2.5))
    mirror = scene(there, static={"materials": ["silver"], "brightness": [1, 1], "tint": 0})
    seen = see(mirror, (0.0, 0.0, -2.5))
    shown = seen.seen == 4
    assert shown.sum() > 500
    # Without the box, or it would hide the scene from behind it, and shade it.
    nothing = scene(box((0.0, 15.0, 3.0), (0.1, 0.1, 0.1)))
    behind = see(nothing, (12.0, 0.0, -2.5), yaw=math.pi)
    expected = behind.rgb[:, ::-1]
    # The box throws its shadow to the north, away from the mirrored scene.
    apart = np.abs(seen.rgb.astype(int) - expected)[shown]
    assert np.mean(apart.max(axis=-1) <= 1) > 0.99


@pytest.mark.nightly
def test_varnish_reflects_by_fresnels_share() -> None:
    """A black varnished wall of a box mirrors a sky of one radiance."""
    there = box((6.0, 0.0, -2.5), (1.0, 8.0, 2.5))
    black = scene(
        there,
        static={"materials": ["varnish"]},
        walls={"materials": ["dark"]},
        floor={"materials": ["dark"]},
    )
    # From below, steeply upwards: the mirrored rays leave over the walls.
    seen = see(black, (4.0, 0.0, -0.5), pitch=0.9)
    rows, columns = np.nonzero(seen.seen == 4)
    radiance = 0.4
    checked = 0
    for v, u in zip(rows.tolist(), columns.tolist(), strict=True):
        x, y = (u - CAMERA.cx) / CAMERA.focal, (v - CAMERA.cy) / CAMERA.focal
        north = math.cos(0.9) + y * math.sin(0.9)
        up = math.sin(0.9) - y * math.cos(0.9)
        length = math.sqrt(1.0 + x * x + y * y)
        if up / length < 0.6:
            continue
        share = fresnel(north / length)
        light = float(linear_of(seen.rgb[v, u, :1] / 255.0)[0])
        assert light == pytest.approx(share * radiance, abs=0.004)
        checked += 1
    assert checked > 100


@pytest.mark.nightly
def test_glass_lets_the_sun_through() -> None:
    """The floor in the shadow of clear glass gets what two panes let through."""
    there = box((0.0, 0.0, -2.0), (1.0, 6.0, 2.0))
    floors = []
    for material in ("clear", "dark"):
        world = scene(there, static={"materials": [material], "brightness": [1, 1], "tint": 0})
        # Straight down onto the shadow, which lies to the north.
        picture = see(world, (3.0, 0.0, -4.0), pitch=-math.pi / 2)
        assert picture.seen[24, 32] == 1
        floors.append(float(linear_of(picture.rgb[24, 32, :1] / 255.0)[0]))
    albedo = float(linear_of(np.array(188.0 / 255.0)))
    direct, open_sky = 0.6 * math.sin(math.pi / 4), 0.4
    through = (1.0 - pane_reflects(1.0)) ** 2
    assert floors[0] == pytest.approx(albedo * (open_sky + through * direct), abs=0.004)
    assert floors[1] == pytest.approx(albedo * open_sky, abs=0.004)


@pytest.mark.nightly
def test_what_is_behind_clear_glass_is_seen_through_both_panes() -> None:
    there = box((5.0, 0.0, -2.5), (0.5, 8.0, 2.5))
    look = {"sun": clear()["sun"] | {"irradiance": [0, 0]}, "walls": {"materials": ["pale"]}}
    glass = scene(there, static={"materials": ["clear"], "brightness": [1, 1], "tint": 0}, **look)
    without = scene(box((0.0, 15.0, 3.0), (0.1, 0.1, 0.1)), **look)
    at = (0.0, 0.0, -2.5)
    seen, bare = see(glass, at), see(without, at)
    assert seen.seen[24, 32] == 4
    assert bare.seen[24, 32] in (2, 3)
    behind, front = (linear_of(p.rgb[24, 32] / 255.0) for p in (bare, seen))
    # Both panes mirror the other walls, which are as bright as this one.
    back = pane_reflects(1.0)
    inner = (1.0 - back) ** 2 / (1.0 - back**2)
    np.testing.assert_allclose(front, behind * (inner + back + back * inner), rtol=0.03)
    assert (front > (1.0 - back) ** 2 * behind).all()


@pytest.mark.nightly
def test_rays_between_mirrors_end() -> None:
    """Mirrors that stand in each other, seen from everywhere: no ray runs away, none is lost."""
    spec = load_profile("arenas", "dense-obstacles", ArenaSpec)
    look = Appearance.model_validate(
        {"static": {"materials": ["mirror", "glass"]}, "walls": {"materials": ["mirror"]},
         "floor": {"materials": ["wet-asphalt"]}}
    )  # fmt: skip
    spec = spec.model_copy(update={"appearance": look})
    rng = np.random.default_rng(1)
    looked = 0
    for seed in range(10):
        world = generate(spec, seed, name="dense", vehicle_width_m=0.55)
        at = rng.uniform([0, -15, -4.0], [30, 15, -0.5])
        roll, pitch = rng.normal(0.0, 0.3, 2)
        attitude = quat_from_euler(roll, pitch, rng.uniform(-3.0, 3.0))
        picture = render_picture(world, world.centers_at(0), CAMERA, at, attitude)
        if (picture.depth_m > 0.01).all(where=picture.depth_m > 0.0):  # Not within an obstacle.
            assert picture.rgb.std() > 5.0
            looked += 1
    assert looked > 4


def shiny_worlds() -> list[Arena]:
    spec = load_profile("arenas", "dynamic-obstacles", ArenaSpec)
    shining = Appearance.model_validate(
        {"static": {"materials": list(SHINY)}, "moving": {"materials": ["lacquer"]},
         "fog": {"extinction_1_m": [0.02, 0.02]}}
    )  # fmt: skip
    matt, shiny = spec, spec.model_copy(update={"appearance": shining})
    return [
        generate(each, seed, name="some", vehicle_width_m=0.55)
        for seed, each in enumerate((matt, shiny, shiny, matt, shiny))
    ]


def test_the_twin_has_the_surfaces_of_the_rehearsal() -> None:
    """In each slot, whichever arena it had before."""
    worlds = shiny_worlds()
    looks, n = Looks(len(worlds)), len(worlds)
    for order in (range(n), reversed(range(n))):
        for i in order:
            looks.put(i, worlds[n - 1 - i])
            looks.put(i, worlds[i])
        assert looks.gloss is not None
        for i, world in enumerate(worlds):
            known = ColourArrays.of(world.look)
            rows = len(known.texture)
            if known.gloss is None:
                assert (looks.gloss.surface[i, :rows] == MATT).all()
                assert (looks.gloss.lets[i, :rows] == 0.0).all()
            else:
                for name, theirs in known.gloss._asdict().items():
                    np.testing.assert_array_equal(getattr(looks.gloss, name)[i, :rows], theirs)
            for name in ("texture", "per_m", "offset", "albedo"):
                theirs = getattr(known, name)
                np.testing.assert_array_equal(getattr(looks.batch, name)[i, :rows], theirs)
            np.testing.assert_array_equal(looks.batch.lights[i], known.lights)


# In every run: the rows of the twin, above, and its images of matt surfaces in test_colour_env.py.
@pytest.mark.nightly
@pytest.mark.timeout(600)  # Compiles kernels.
def test_the_twins_images_are_those_of_the_rehearsal() -> None:
    worlds = shiny_worlds()
    n = len(worlds)
    looks, meshes, fleet = Looks(n), MeshesSeen(n), scattered(n)
    assert looks.gloss is None
    for order in (range(n), reversed(range(n))):
        for i in order:
            looks.put(i, worlds[i])
        assert looks.gloss is not None
        twin, out = ColourImages(CAMERA, MOUNT, looks, meshes), np.zeros((n, 48, 64, 3), np.uint8)
        twin.render(fleet, batch_of(worlds), np.ones(n, np.bool_), out)
        for i, world in enumerate(worlds):
            pose = camera_pose(fleet.position[i], fleet.quaternion[i], MOUNT)
            expected = render_picture(world, world.centers_at(0), CAMERA, *pose).rgb
            assert np.array_equal(out[i], expected)


@pytest.mark.nightly
def test_meshes_mirror_and_are_mirrored(tmp_path: Any) -> None:
    file = kept(triangles(ring()), tmp_path / "ring.npz")
    world = scene_of(file, [(5.0, -1.0, 0.6, 2.0), (7.0, 3.0, -1.0, 1.4), (4.0, 1.5, 2.0, 0.9)])
    pictures: list[NDArray[np.uint8]] = []
    for material in ("brick", "mirror"):
        look = Appearance.model_validate({"static": {"materials": [material]}})
        world.__dict__.pop("look", None)
        shown = Arena(**{**_fields(world), "appearance": look})
        picture = render_picture(
            shown, shown.obstacles.center, CAMERA, np.array([0.0, 0.0, -2.0]), np.eye(4)[0]
        )
        pictures.append(picture.rgb)
        on_mesh = picture.seen >= 4
    assert on_mesh.sum() > 100
    apart = np.abs(pictures[0].astype(int) - pictures[1]).max(axis=-1)
    assert (apart[on_mesh] > 10).mean() > 0.8


def _fields(world: Arena) -> dict[str, Any]:
    return {name: getattr(world, name) for name in world.__dataclass_fields__}


@pytest.mark.parametrize("surface", ["matt", "glass"])
def test_roughness_is_of_varnish_and_metal(surface: str) -> None:
    told = f"roughness = 0.2: accepted: 0 with surface = '{surface}'"
    with pytest.raises(ValueError, match=told):
        Material.model_validate({"albedo": [1, 2, 3], "surface": surface, "roughness": 0.2})
