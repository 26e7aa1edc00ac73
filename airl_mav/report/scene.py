"""Colours and shapes of a scene, for every renderer."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from airl_mav.arena.geometry import Bounds

Colour = tuple[int, int, int]
"""Red, green, blue, 0-255."""

STILL, MOVING, GOAL, START = (139, 151, 163), (240, 147, 43), (27, 138, 63), (31, 78, 140)
FLOOR, GRID, SECTION = (236, 238, 240), (214, 218, 222), (186, 192, 198)
HILLS = (203, 198, 180)
FLOWN, COMMANDED, DROP = (40, 104, 168), (214, 84, 10), (120, 128, 136)
NOSE, BLADE = (214, 84, 10), (33, 38, 45)

WALL_OPACITY = 0.25
GLASS_OPACITY = 0.35

OPEN = Bounds(-50.0, 50.0, -50.0, 50.0, 5.0)
"""Floor around the start of a flight without an arena."""

ARROW_S = 0.6
"""Length of a velocity arrow per speed [s]."""

LEAST_ARROW_M = 0.02


@dataclass(frozen=True)
class FlightColours:
    """Colours of one flight among several in the same scene."""

    trail: Colour
    body: Colour
    disc: Colour
    whole: bool = True
    """True if arena, camera and commanded velocity are drawn, too."""


FIRST = FlightColours((47, 127, 196), (47, 54, 61), (40, 104, 168))
OTHER = FlightColours((150, 80, 170), (110, 50, 130), (150, 80, 170), whole=False)


Floats = NDArray[np.float64]


def walls(bounds: Bounds) -> tuple[NDArray[np.float32], NDArray[np.uint32]]:
    """Return walls and ceiling facing inward: corners (8, 3) NED [m] and triangles (n, 3)."""
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
    """Return the arrow (n, 2, 3) of a velocity (3,) [m/s] from the origin [m]; n = 0 for None."""
    if velocity is None or np.linalg.norm(velocity) * ARROW_S < LEAST_ARROW_M:
        return np.zeros((0, 2, 3), np.float32)
    return np.array([[np.zeros(3), ARROW_S * velocity]], np.float32)


def segments_of(points: list[tuple[float, float, float]]) -> NDArray[np.float32]:
    """Return the segments (n - 1, 2, 3) of a polyline through n points."""
    line = np.array(points, np.float32)
    return np.stack([line[:-1], line[1:]], axis=1)
