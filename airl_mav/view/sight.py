"""How far away a watcher's camera may be without an obstacle between it and what it looks at."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from airl_mav.arena.geometry import Arena, Bounds
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.core.frames import quat_from_euler

AHEAD = Intrinsics(width=1, height=1, focal=1.0, cx=0.0, cy=0.0)
"""A camera of one ray."""

_FAR_M = 1e4
NO_WALLS = Bounds(-_FAR_M, _FAR_M, -_FAR_M, _FAR_M, 1e-3)
"""The scene's walls can be looked through from outside; its floor cannot."""

KEPT = 0.9
"""Share of the way to an obstacle that the camera takes."""

NEAREST_M = 1.0
"""It comes no nearer, for whatever stands there: less than that shows nothing."""


def unhidden(
    arena: Arena, time_us: int, at: NDArray[np.float64], offset: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return a camera's place from what it looks at (3,) NED [m], with nothing in between.

    Args:
        arena: Where both are.
        time_us: Time since the episode began [µs].
        at: What is looked at (3,) NED [m].
        offset: Where the camera would be from there (3,) NED [m].

    Returns:
        `offset`, or the part of it that ends before the first obstacle.
    """
    # Imported here: without numba a view has its page ready sooner than a browser opens it.
    from airl_mav.camera.render import render

    away = float(np.linalg.norm(offset))
    if away <= NEAREST_M:
        return offset
    north, east, down = offset.tolist()
    look = quat_from_euler(0.0, math.atan2(-down, math.hypot(north, east)), math.atan2(east, north))
    # Boxes stand in for meshes: nobody looks at the picture, and their file may not be here.
    scene = replace(arena, bounds=NO_WALLS, meshes=())
    depth = render(scene, arena.centers_at(time_us), AHEAD, away, at, look).item()
    if depth == 0.0:
        return offset
    return offset * max(KEPT * depth, NEAREST_M) / away
