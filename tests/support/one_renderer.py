"""One compiled renderer for the tests of pictures.

Meshes and glossy surfaces are optional arguments of the renderers. Each combination is compiled
anew, for half a minute. Here every arena has both, empty where the arena has none, as arenas of the
batch twin do beside others that have them.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from airl_mav.arena.ground import no_relief
from airl_mav.camera import picture, render
from airl_mav.camera.bvh import Meshes, forest_of, meshes_of, placed_in
from airl_mav.camera.gloss import MATT, Gloss
from airl_mav.camera.picture import ColourArrays

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
    return replace(arrays, gloss=arrays.gloss or matt)


@contextmanager
def one_renderer(*, meshes: bool = True, gloss: bool = True) -> Iterator[None]:
    """Render all pictures and depth images meanwhile with meshes and glossy surfaces."""
    with pytest.MonkeyPatch.context() as patch:
        for module in (picture, render) if meshes else ():
            patch.setattr(module, "meshes_of", _meshes)
        if gloss:
            patch.setattr(ColourArrays, "of", _arrays)
        yield
