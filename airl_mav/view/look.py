"""What things look like in a scene, whoever draws it."""

from __future__ import annotations

from dataclasses import dataclass

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
"""The floor of a flight outside of all arenas: around its start."""

ARROW_S = 0.6
"""A velocity's arrow ends where the vehicle would be after so long [s]."""

LEAST_ARROW_M = 0.02
"""A shorter one is not drawn."""


@dataclass(frozen=True)
class Look:
    """What tells one flight from another in the same scene."""

    trail: Colour
    body: Colour
    disc: Colour
    whole: bool = True
    """Whether arena, camera and commanded velocity are drawn, too."""


FIRST = Look((47, 127, 196), (47, 54, 61), (40, 104, 168))
OTHER = Look((150, 80, 170), (110, 50, 130), (150, 80, 170), whole=False)
