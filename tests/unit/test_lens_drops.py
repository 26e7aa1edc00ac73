"""Rain on the lens: where it is, what it shows, and that twin and rehearsal have the same drops."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from airl_mav.arena.appearance import draw_appearance
from airl_mav.arena.generate import generate
from airl_mav.arena.geometry import Arena
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.camera.lens_drops import rained_on
from airl_mav.camera.picture import grey, render_picture
from airl_mav.camera.render import camera_pose
from airl_mav.envs.arenas import batch_of
from airl_mav.envs.colour_images import ColourImages, Looks
from airl_mav.envs.meshes import MeshesSeen
from airl_mav.profiles.appearance import Appearance
from airl_mav.profiles.arena import ArenaSpec
from airl_mav.profiles.loading import load_profile
from tests.learning.test_fleet_meshes import MOUNT, scattered

CAMERA = Intrinsics.from_fov(64, 48, 1.5)
WET: dict[str, Any] = {"drops": [10, 30], "size": [0.05, 0.2], "streak": [1, 3]}


def drops_of(seed: int, **rain: Any) -> NDArray[np.float32]:
    look = Appearance.model_validate({"rain": rain})
    return draw_appearance(look, seed, 3, 0, (153, 0, 0)).drops


def drop(x: float, y: float, size: float, streak: float = 1.0) -> NDArray[np.float32]:
    return np.array([[x, y, size, streak]], np.float32)


def test_draws_are_within_their_bounds_and_use_them() -> None:
    all_drops = [drops_of(seed, **WET) for seed in range(300)]
    counts = {len(each) for each in all_drops}
    assert (min(counts), max(counts)) == (10, 30)
    for column, (least, most) in enumerate(((0, 1), (0, 1), (0.05, 0.2), (1, 3))):
        found = np.concatenate(all_drops)[:, column]
        assert least <= found.min() < least + 0.05 * (most - least)
        assert most >= found.max() > most - 0.05 * (most - least)
    np.testing.assert_array_equal(drops_of(5, **WET), all_drops[5])


def test_a_share_of_the_looks_is_wet() -> None:
    wet = [len(drops_of(seed, **WET, share=0.3)) > 0 for seed in range(1000)]
    assert np.mean(wet) == pytest.approx(0.3, abs=0.05)


def test_rain_leaves_the_other_draws_alone() -> None:
    dry = draw_appearance(Appearance(), 4, 5, 0, (153, 0, 0))
    wet = draw_appearance(Appearance.model_validate({"rain": WET}), 4, 5, 0, (153, 0, 0))
    np.testing.assert_array_equal(dry.finish.albedo, wet.finish.albedo)
    np.testing.assert_array_equal(dry.light.to_sun, wet.light.to_sun)
    assert "rain" not in Appearance().model_dump()
    assert not len(dry.drops)


@pytest.mark.nightly
def test_what_is_the_same_everywhere_stays_so() -> None:
    for code in (0, 1, 37, 128, 255):
        rgb = np.full((48, 64, 3), code, np.uint8)
        rained_on(rgb, drops_of(3, **WET))
        np.testing.assert_array_equal(rgb, code)


def test_a_drop_changes_its_ellipse_alone() -> None:
    rng = np.random.default_rng(2)
    rgb = rng.integers(0, 256, (100, 200, 3), np.uint8)
    wet = rgb.copy()
    rained_on(wet, drop(0.25, 0.4, 0.1, 2.0))
    v, u = np.mgrid[:100, :200] + 0.5
    inside = ((u - 50) / 10) ** 2 + ((v - 40) / 20) ** 2 < 1.0
    changed = (wet != rgb).any(axis=-1)
    assert not changed[~inside].any()
    core = ((u - 50) / 10) ** 2 + ((v - 40) / 20) ** 2 < 0.6
    assert changed[core].mean() > 0.9


def test_a_drop_shows_the_scene_upside_down_and_mirrored() -> None:
    """A bright upper half and a red left half: below and on the right in the drop."""
    rgb = np.zeros((200, 200, 3), np.uint8)
    rgb[:100, :, 1] = 255
    rgb[:, :100, 0] = 255
    rained_on(rgb, drop(0.5, 0.5, 0.4))
    above, below = rgb[80:95, 100, 1], rgb[105:120, 100, 1]
    assert below.mean() > 200 > 50 > above.mean()
    left, right = rgb[100, 80:95, 0], rgb[100, 105:120, 0]
    assert right.mean() > 200 > 50 > left.mean()


def wet_world(seed: int, **rain: Any) -> Arena:
    spec = load_profile("arenas", "varied-looks", ArenaSpec)
    look = spec.appearance.model_copy(
        update={"rain": Appearance.model_validate({"rain": rain}).rain}
    )
    spec = spec.model_copy(update={"appearance": look})
    return generate(spec, seed, name="wet", vehicle_width_m=0.55)


def wet_worlds() -> list[Arena]:
    return [
        wet_world(1, drops=[0, 0]),
        wet_world(2, drops=[5, 5]),
        wet_world(3, drops=[40, 40]),
        wet_world(4, **WET, share=0.5),
    ]


def test_the_twin_has_the_drops_of_the_rehearsal() -> None:
    """In each slot, whichever arena it had before."""
    worlds = wet_worlds()
    looks = Looks(len(worlds))
    for order in ((0, 1, 2, 3), (3, 0, 2, 1)):
        for i in order:
            looks.put(i, worlds[order[i]])
            looks.put(i, worlds[i])
        assert looks.rain is not None
        for i, world in enumerate(worlds):
            drops = world.look.drops
            assert looks.rain.present[i] == len(drops)
            np.testing.assert_array_equal(looks.rain.drops[i, : len(drops)], drops)


def test_a_picture_is_what_is_behind_its_drops() -> None:
    (world, dry), pose = (wet_world(3, drops=[n, n]) for n in (40, 0)), (np.zeros(3), np.eye(4)[0])
    shown, expected = (
        render_picture(each, each.centers_at(0), CAMERA, *pose).rgb for each in (world, dry)
    )
    assert (shown != expected).any()
    rained_on(expected, world.look.drops)
    np.testing.assert_array_equal(shown, expected)


# In every run: what the twin has, above, and its dry images in test_colour_env.py.
@pytest.mark.nightly
@pytest.mark.timeout(600)  # compiles kernels
@pytest.mark.parametrize("channels", [1, 3])
def test_the_twins_drops_are_those_of_the_rehearsal(channels: int) -> None:
    worlds = wet_worlds()
    n = len(worlds)
    camera = replace(CAMERA, kind="rgb" if channels == 3 else "grey")
    looks, fleet, changed = Looks(n), scattered(n), 0
    for order in ((0, 1, 2, 3), (3, 0, 2, 1)):
        for i in order:
            looks.put(i, worlds[i])
        out = np.zeros((n, 48, 64, channels), np.uint8)
        twin = ColourImages(camera, MOUNT, looks, MeshesSeen(n))
        twin.render(fleet, batch_of(worlds), np.ones(n, np.bool_), out)
        for i, world in enumerate(worlds):
            pose = camera_pose(fleet.position[i], fleet.quaternion[i], MOUNT)
            rgb = render_picture(world, world.centers_at(0), camera, *pose).rgb
            expected = rgb if channels == 3 else grey(rgb)[..., None]
            np.testing.assert_array_equal(out[i], expected)
            dry = replace(world, appearance=Appearance.model_validate(
                {**world.appearance.model_dump(), "rain": {}}
            ))  # fmt: skip
            changed += int((render_picture(dry, dry.centers_at(0), camera, *pose).rgb != rgb).sum())
    assert changed > 1000
