"""Compiled picture renderers: features that an arena lacks change no pixel."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest

from airl_mav.addons.colour import picture
from airl_mav.addons.colour.picture import ColourArrays, Picture, render_picture
from airl_mav.addons.colour.shading import MATT, Gloss
from airl_mav.arena.generate import generate
from airl_mav.arena.geometry import no_relief
from airl_mav.camera import render as depth_images
from airl_mav.camera.bvh import Meshes, forest_of, meshes_of, placed_in
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.camera.render import render
from airl_mav.core.frames import quat_from_euler
from airl_mav.profiles.arena import ArenaSpec
from airl_mav.profiles.loading import load_profile
from airl_mav.profiles.projections import Projection

_of = ColourArrays.of


def _meshes(placed: Any, n_obstacles: int, *more: Any) -> Meshes:
    """Return an arena's meshes, arguments as of `meshes_of`."""
    found = meshes_of(placed, n_obstacles, *more)
    return found or Meshes(forest_of(()).bvh, *placed_in({}, (), n_obstacles), no_relief())


def _arrays(look: Any) -> ColourArrays:
    """Return the arrays of a drawn appearance."""
    arrays = _of(look)
    zeros = np.zeros(len(arrays.texture), np.float32)
    matt = Gloss(np.full(len(zeros), MATT, np.int8), zeros, zeros)
    return arrays._replace(gloss=arrays.gloss or matt)


@contextmanager
def rendered_as(*, meshes: bool, gloss: bool) -> Iterator[None]:
    """Render all arenas in this context with meshes and glossy surfaces, empty if absent."""
    with pytest.MonkeyPatch.context() as patch:
        for module in (picture, depth_images) if meshes else ():
            patch.setattr(module, "meshes_of", _meshes)
        if gloss:
            patch.setattr(ColourArrays, "of", _arrays)
        yield


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
        seen = render_picture(arena, centers, camera, *pose)
        return seen, render(arena, centers, camera, 20.0, *pose)

    plain, depth = shown()
    assert plain.rgb.std() > 10.0
    for meshes, gloss in ((True, False), (False, True), (True, True)):
        with rendered_as(meshes=meshes, gloss=gloss):
            same, same_depth = shown()
        for ours, theirs in zip(same, plain, strict=True):
            np.testing.assert_array_equal(ours, theirs)
        np.testing.assert_array_equal(same_depth, depth)
