"""Randomized appearance of arenas against closed forms; the geometry is unaffected."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from pydantic import TypeAdapter
from scipy.integrate import quad

from airl_mav.addons.colour.appearance import FLOOR, OBSTACLE, TEXTURES, WALLS, linear_of, srgb_of
from airl_mav.addons.colour.profile import MATERIALS
from airl_mav.arena.generate import generate, local_bounds
from airl_mav.arena.geometry import Arena, Obstacles
from airl_mav.core.plugins import GENERATORS
from airl_mav.profiles.arena import ArenaSpec
from airl_mav.profiles.loading import load_profile, profile_digest

RICH: dict[str, Any] = {
    "floor": {"materials": ["grass", "checker"]},
    "walls": {"materials": ["brick", "wall_colour"], "brightness": [0.5, 1.5]},
    "static": {"materials": ["concrete", "foliage"], "brightness": [0.5, 1.5], "tint": 0.3},
    "sun": {"azimuth_deg": [-90, 90], "elevation_deg": [10, 80], "irradiance": [0, 2]},
    "sky": {"irradiance": [0.1, 0.9]},
    "fog": {"extinction_1_m": [0.0, 0.1]},
}


def shipped(name: str) -> ArenaSpec:
    return load_profile("arenas", name, ArenaSpec)


def with_look(spec: ArenaSpec, **appearance: Any) -> ArenaSpec:
    return ArenaSpec.model_validate({**spec.model_dump(), "appearance": appearance})


def make(spec: ArenaSpec, seed: int) -> Arena:
    return generate(spec, seed, name="some", vehicle_width_m=0.55)


def flat(drawn: Any) -> np.ndarray:
    """All numbers of a drawn appearance."""
    parts = [*vars(drawn.finish).values(), *vars(drawn.light).values()]
    return np.concatenate([np.ravel(part).astype(float) for part in parts])


@pytest.mark.parametrize("name", ["static-obstacles", "dynamic-obstacles", "dense-obstacles"])
def test_the_geometry_of_a_seed_knows_nothing_of_the_look(name: str) -> None:
    spec = shipped(name)
    for seed in range(6):
        plain, rich = make(spec, seed), make(with_look(spec, **RICH), seed)
        for field in ("shape", "center", "half_size", "yaw"):
            a, b = getattr(plain.obstacles, field), getattr(rich.obstacles, field)
            np.testing.assert_array_equal(a, b)
        np.testing.assert_array_equal(plain.goal, rich.goal)
        for ours, theirs in zip(plain.tours, rich.tours, strict=True):
            np.testing.assert_array_equal(ours.points, theirs.points)


def test_an_arena_that_says_nothing_of_its_look_has_the_digest_of_before() -> None:
    """Policy cards and runs name arenas by their digest."""
    spec = shipped("static-obstacles")
    assert "appearance" not in spec.model_dump()
    assert profile_digest(spec).startswith("12c7b67d17faa430")
    rich = with_look(spec, **RICH)
    assert profile_digest(rich) != profile_digest(spec)
    assert ArenaSpec.model_validate_json(rich.model_dump_json()) == rich


def test_same_seed_same_look_and_a_period_shares_it() -> None:
    spec = with_look(shipped("static-obstacles"), **RICH, period=3)
    np.testing.assert_array_equal(flat(make(spec, 7).look), flat(make(spec, 7).look))
    # The numbers of obstacles have a period of four seeds; 8 begins one of each.
    lights = [make(spec, seed).look.light for seed in (6, 8, 9)]
    np.testing.assert_array_equal(lights[0].to_sun, lights[1].to_sun)
    assert lights[0].extinction == lights[1].extinction != lights[2].extinction


def test_a_knob_and_the_number_of_obstacles_leave_the_other_draws_alone() -> None:
    spec = shipped("static-obstacles")
    few = make(with_look(spec.model_copy(update={"count_period": 1}), **RICH), 5).look
    other = {**RICH, "floor": {"materials": ["plaster"]}, "fog": {"extinction_1_m": [0.5, 0.9]}}
    changed = make(with_look(spec, **other), 5).look
    shared = min(len(few.finish.texture), len(changed.finish.texture))
    assert shared > OBSTACLE + 3
    for field in ("texture", "albedo", "size_m", "offset"):
        a, b = getattr(few.finish, field), getattr(changed.finish, field)
        np.testing.assert_array_equal(a[WALLS:shared], b[WALLS:shared])
    np.testing.assert_array_equal(few.light.to_sun, changed.light.to_sun)
    np.testing.assert_array_equal(few.light.zenith, changed.light.zenith)
    assert few.light.extinction != changed.light.extinction


def test_a_share_of_the_looks_has_fog_and_that_of_the_same_density() -> None:
    spec = shipped("static-obstacles")

    def extinctions(share: float) -> NDArray[np.float64]:
        fog = {"extinction_1_m": [0.02, 0.1], "share": share}
        foggy = with_look(spec, **{**RICH, "fog": fog})
        return np.array([make(foggy, 4 * seed).look.light.extinction for seed in range(200)])

    always, half = extinctions(1.0), extinctions(0.5)
    assert always.min() > 0.0
    np.testing.assert_array_equal(half[half > 0.0], always[half > 0.0])
    # 200 draws of one half: 100 of them give or take 3.3 standard deviations.
    assert 76 < np.count_nonzero(half) < 124
    assert not extinctions(0.0).any()


def test_draws_are_within_their_bounds_and_use_them() -> None:
    spec = with_look(shipped("static-obstacles"), **RICH)
    looks = [make(spec, seed).look for seed in range(120)]
    to_sun = np.array([look.light.to_sun for look in looks])
    np.testing.assert_allclose(np.linalg.norm(to_sun, axis=1), 1.0)
    elevation = np.degrees(np.arcsin(-to_sun[:, 2]))
    azimuth = np.degrees(np.arctan2(to_sun[:, 1], to_sun[:, 0]))
    fog = np.array([look.light.extinction for look in looks])
    for values, low, high in ((elevation, 10, 80), (azimuth, -90, 90), (fog, 0.0, 0.1)):
        assert low <= values.min() < low + 0.1 * (high - low)
        assert high - 0.1 * (high - low) < values.max() <= high
    floors = {TEXTURES[look.finish.texture[FLOOR]] for look in looks}
    assert floors == {"noise", "checker"}
    assert {TEXTURES[look.finish.texture[WALLS]] for look in looks} == {"brick", "plain"}
    albedo = np.concatenate([look.finish.albedo[OBSTACLE:] for look in looks])
    assert albedo.min() >= 0.0
    assert albedo.max() <= 1.0


def test_the_walls_material_is_the_wall_colour() -> None:
    look = make(shipped("static-obstacles"), 0).look
    # sRGB 153 is 0.3185 of linear light (IEC 61966-2-1), by hand: ((0.6 + 0.055) / 1.055) ** 2.4.
    np.testing.assert_allclose(look.finish.albedo[WALLS, 0], [0.318547, 0, 0], atol=1e-6)


@pytest.mark.parametrize("part", ["sun", "sky"])
def test_irradiance_is_luminance(part: str) -> None:
    colours = {"sun": {"colour": [200, 90, 20]}, "sky": {"zenith": [20, 60, 200]}}[part]
    look = {part: {**colours, "irradiance": [0.6, 0.6]}}
    light = make(with_look(shipped("no-obstacles"), **look), 1).look.light
    weights = np.array([0.2126, 0.7152, 0.0722])
    assert getattr(light, part) @ weights == pytest.approx(0.6)


def test_sky_irradiance_is_the_integral_of_its_radiance() -> None:
    light = make(with_look(shipped("no-obstacles"), **RICH), 1).look.light
    for channel in range(3):

        def falls(elevation: float, channel: int = channel) -> float:
            sine = math.sin(elevation)
            radiance = light.horizon[channel] + sine * (
                light.zenith[channel] - light.horizon[channel]
            )
            return float(radiance * sine * math.cos(elevation) * 2.0)

        assert light.sky[channel] == pytest.approx(quad(falls, 0.0, math.pi / 2)[0])


def test_srgb_is_the_standards() -> None:
    """Fixed points of IEC 61966-2-1; mid-grey 188 is half of the light."""
    assert round(255.0 * float(srgb_of(np.array(0.5)))) == 188
    assert round(255.0 * float(srgb_of(np.array(0.0031308)))) == 10
    codes = np.arange(256) / 255.0
    np.testing.assert_allclose(srgb_of(linear_of(codes)), codes, atol=1e-7)


def test_materials_of_the_users_go_before_shipped_ones() -> None:
    own = {"materials": {"brick": {"albedo": [255, 255, 255]}}, "floor": {"materials": ["brick"]}}
    look = make(with_look(shipped("no-obstacles"), **own), 0).look
    np.testing.assert_allclose(look.finish.albedo[FLOOR], 1.0)
    assert MATERIALS["brick"].texture == "brick"


def test_a_generator_of_the_users_gets_the_look_of_its_profile(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def empty(spec: ArenaSpec, seed: int, *, name: str, **_: object) -> Arena:
        none = Obstacles(np.zeros(0, np.int8), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))
        goal = np.array([10.0, 0.0])
        return Arena(name, seed, local_bounds(spec), spec.wall_colour, none, (), goal)

    def load_part(kind: object, name: str) -> Callable[..., Arena]:
        assert kind is GENERATORS
        return empty

    monkeypatch.setattr("airl_mav.core.plugins.load_part", load_part)
    spec = with_look(shipped("no-obstacles"), **RICH)
    spec = ArenaSpec.model_validate({**spec.model_dump(), "generator": "mine:empty"})
    assert make(spec, 3).appearance == spec.appearance


def test_the_view_is_told_the_look() -> None:
    arena = make(with_look(shipped("dynamic-obstacles"), **RICH), 3)
    told = TypeAdapter(Arena).validate_json(TypeAdapter(Arena).dump_json(arena))
    np.testing.assert_array_equal(flat(told.look), flat(arena.look))
