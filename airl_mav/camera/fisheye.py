"""A fisheye as the ray casters take it: a ray of its own for each pixel."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from airl_mav.arena.geometry import Arena
from airl_mav.camera.equidistant import fisheye_rays
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.camera.projection import Bent
from airl_mav.core.errors import UsageError


def bent_of(camera: Intrinsics) -> Bent | None:
    """Return the rays of a camera; None: it is no fisheye."""
    return _bent_of(camera) if camera.projection == "fisheye" else None


@lru_cache(maxsize=64)
def _bent_of(camera: Intrinsics) -> Bent:
    forward, right, down = np.ascontiguousarray(fisheye_rays(camera))
    return Bent(forward, down, right)


def check_meshes(camera: Intrinsics, arena: Arena) -> None:
    """Raise UsageError where a fisheye looks at an arena with meshes, or hills."""
    if camera.projection == "fisheye" and (arena.meshes or arena.ground is not None):
        what = "meshes" if arena.meshes else "hills"
        raise UsageError(
            f"arena {arena.name}: a fisheye sees no {what}; accepted: a pinhole or a cylinder, or"
            f" an arena without {what}"
        )
