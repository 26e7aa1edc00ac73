"""Shapes of the scene that viser has not: walls seen from inside, arrows, the line of a trail."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from airl_mav.arena.geometry import Bounds
from airl_mav.view.look import ARROW_S, LEAST_ARROW_M

Floats = NDArray[np.float64]


def walls(bounds: Bounds) -> tuple[NDArray[np.float32], NDArray[np.uint32]]:
    """Return the four walls, and the ceiling where there is one, as a mesh whose front is inside.

    Returns:
        Corners (8, 3) NED [m], and the corners of the triangles (8 or 10, 3).
    """
    b = bounds
    ends = [
        (b.north_max, b.east_min),
        (b.north_max, b.east_max),
        (b.north_min, b.east_max),
        (b.north_min, b.east_min),
    ]
    corners = [(*end, height) for height in (0.0, -b.height) for end in ends]
    faces = []
    for here, after in ((0, 1), (1, 2), (2, 3), (3, 0)):
        faces += [(here, after, after + 4), (here, after + 4, here + 4)]
    if b.ceiling:
        faces += [(4, 5, 6), (4, 6, 7)]
    return np.array(corners, np.float32), np.array(faces, np.uint32)


def arrow(velocity: Floats | None) -> NDArray[np.float32]:
    """Return the arrow (n, 2, 3) of a velocity (3,) [m/s], from the origin [m]; n = 0: none."""
    if velocity is None or np.linalg.norm(velocity) * ARROW_S < LEAST_ARROW_M:
        return np.zeros((0, 2, 3), np.float32)
    return np.array([[np.zeros(3), ARROW_S * velocity]], np.float32)


def segments_of(points: list[tuple[float, float, float]]) -> NDArray[np.float32]:
    """Return the segments (n - 1, 2, 3) of a line through n points."""
    line = np.array(points, np.float32)
    return np.stack([line[:-1], line[1:]], axis=1)
