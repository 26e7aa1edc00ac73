"""Every compiled renderer of pictures: what an arena has none of changes no pixel."""

from __future__ import annotations

import math

import numpy as np
import pytest

from airl_mav.arena.generate import generate
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.camera.picture import Picture, render_picture
from airl_mav.camera.render import render
from airl_mav.core.frames import quat_from_euler
from airl_mav.profiles.arena import ArenaSpec
from airl_mav.profiles.camera_kind import Projection
from airl_mav.profiles.loading import load_profile
from tests.support.one_renderer import one_renderer


@pytest.mark.nightly  # Each of them compiles for half a minute.
@pytest.mark.timeout(900)
@pytest.mark.parametrize("projection", ["pinhole", "fisheye"])
def test_empty_meshes_and_matt_surfaces_change_no_pixel(projection: Projection) -> None:
    spec = load_profile("arenas", "dense-obstacles", ArenaSpec)
    arena = generate(spec, 3, name="dense", vehicle_width_m=0.55)
    camera = Intrinsics.from_fov(64, 48, math.radians(120.0), projection)
    pose = np.array([6.0, -6.0, -3.0]), quat_from_euler(0.1, -0.1, 0.3)

    def shown() -> tuple[Picture, np.ndarray]:
        centers = arena.centers_at(0)
        picture = render_picture(arena, centers, camera, *pose)
        return picture, render(arena, centers, camera, 20.0, *pose)

    plain, depth = shown()
    assert plain.rgb.std() > 10.0
    for meshes, gloss in ((True, False), (False, True), (True, True)):
        with one_renderer(meshes=meshes, gloss=gloss):
            picture, same_depth = shown()
        for ours, theirs in zip(picture, plain, strict=True):
            np.testing.assert_array_equal(ours, theirs)
        np.testing.assert_array_equal(same_depth, depth)
