"""Glass in the batch twin: depth passes through it, bit for bit as the rehearsal's does."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from airl_mav.addons.colour.profile import Appearance
from airl_mav.arena.generate import generate
from airl_mav.arena.geometry import Arena, Obstacles
from airl_mav.camera.frame import depth_to_z16
from airl_mav.camera.projection import lens_of
from airl_mav.camera.render import camera_pose, render
from airl_mav.envs.arena_batch import batch_of
from airl_mav.envs.cameras import Eye, render_images
from airl_mav.envs.mesh_batch import MeshesSeen
from airl_mav.profiles.arena import ArenaSpec
from airl_mav.profiles.loading import load_profile
from tests.learning.test_fleet_meshes import CAMERA, MOUNT, RANGE_M, scattered

pytestmark = pytest.mark.nightly

SEEDS = range(4)


def world(name: str, seed: int, *materials: str) -> Arena:
    spec = load_profile("arenas", name, ArenaSpec)
    look = Appearance.model_validate({"static": {"materials": list(materials)}})
    spec = spec.model_copy(update={"appearance": look})
    return generate(spec, seed, name=name, vehicle_width_m=0.55)


def without(arena: Arena) -> Arena:
    """The same arena, whose obstacles of glass are not there."""
    if arena.clear is None:
        return arena
    o, keep = arena.obstacles, ~arena.clear
    kept = Obstacles(o.shape[keep], o.center[keep], o.half_size[keep], o.yaw[keep])
    return replace(arena, obstacles=kept, appearance=Appearance(), statics=None)


def test_only_glass_is_clear() -> None:
    assert world("static-obstacles", 1, "brick").clear is None
    clear = world("static-obstacles", 1, "glass").clear
    assert clear is not None
    assert clear.all()
    mixed = [world("dense-obstacles", seed, "glass", "brick").clear for seed in SEEDS]
    shares = [each.mean() for each in mixed if each is not None]
    assert 0.3 < np.mean(shares) < 0.7


@pytest.mark.timeout(600)  # compiles kernels
@pytest.mark.parametrize("name", ["static-obstacles", "hills"])
def test_depth_is_that_of_an_arena_without_the_glass(name: str) -> None:
    """In the rehearsal and in the twin, whichever arenas the slots have had before."""
    brick = [world(name, seed, "brick") for seed in SEEDS]
    mixed = [world(name, seed, "glass", "brick") for seed in SEEDS]
    larger = [world("dense-obstacles", seed, "glass", "brick") for seed in SEEDS]
    seen, n, differ = MeshesSeen(len(SEEDS)), len(SEEDS), 0
    fleet, lens = scattered(n), lens_of(CAMERA, RANGE_M)
    for worlds in (brick, mixed, larger, brick, mixed):
        for i, each in enumerate(worlds):
            seen.put(i, each)
        out = np.zeros((n, CAMERA.height, CAMERA.width), np.uint16)
        who = np.ones(n, np.bool_)
        render_images(fleet, batch_of(worlds), who, Eye(MOUNT, lens, out, seen.by_depth))
        for i, each in enumerate(worlds):
            pose = camera_pose(fleet.position[i], fleet.quaternion[i], MOUNT)
            ours = render(each, each.centers_at(0), CAMERA, RANGE_M, *pose)
            bare = without(each)
            expected = render(bare, bare.obstacles.center, CAMERA, RANGE_M, *pose)
            np.testing.assert_array_equal(ours, expected)
            np.testing.assert_array_equal(out[i], depth_to_z16(ours))
            solid = replace(each, appearance=Appearance())
            differ += int(
                (render(solid, solid.centers_at(0), CAMERA, RANGE_M, *pose) != ours).sum()
            )
    assert differ > 500


def test_nothing_is_spent_on_glass_where_there_is_none() -> None:
    seen = MeshesSeen(1)
    seen.put(0, world("static-obstacles", 1, "brick"))
    assert seen.by_depth is None
    seen.put(0, world("static-obstacles", 1, "glass"))
    assert seen.by_depth is not None
    assert seen.batch is None
