"""The light below a ceiling: the ceiling glows evenly, and the sun does not reach what is inside.

A camera without global illumination needs to know what the floor and the walls get of it in the
mean. That is a balance of three surfaces, floor, walls and ceiling, of a square room with the same
height and the same share of walls (radiosity method: Goral et al., Modeling the interaction of
light between diffuse surfaces, SIGGRAPH 1984). The ceiling reflects nothing.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from airl_mav.arena.appearance import FLOOR, LUMINANCE, Drawn, Floats, Inside, Light


def indoors(look: Drawn, floor_m2: float, walls: tuple[tuple[int, float], ...]) -> Drawn:
    """Return a look with the light of the sky from the ceiling, and no sun.

    The floor gets in the mean what a level surface outdoors gets of the sky, in luminance; colours
    that walls and floor throw on each other come to that.

    Args:
        look: As it would be without a ceiling.
        floor_m2: Area of the floor [m²].
        walls: Each surface that is a wall: its row in the `Finish`, and its area on all sides that
            are seen [m²].
    """
    light, albedo = look.light, look.finish.albedo.mean(axis=1)
    areas = np.array([area for _, area in walls])
    of_walls = areas @ albedo[[row for row, _ in walls]] / areas.sum()
    floor, upright = _irradiances(albedo[FLOOR], of_walls, floor_m2, float(areas.sum()))
    luminance = float(LUMINANCE @ light.sky)
    colour = light.sky / luminance if luminance > 0.0 else np.ones(3)
    glow = colour * luminance / float(LUMINANCE @ (colour * floor))
    inside = Light(
        to_sun=light.to_sun,
        sun=np.zeros(3),
        zenith=glow,
        horizon=glow,
        extinction=light.extinction,
        inside=Inside(floor * glow, upright * glow),
    )
    return replace(look, light=inside)


def _irradiances(
    floor_albedo: Floats, wall_albedo: Floats, floor_m2: float, walls_m2: float
) -> tuple[Floats, Floats]:
    """Return the mean irradiance (3,) of floor and walls under a ceiling of radiosity 1.

    The walls of a square room are 4 height / side of its floor.
    """
    across = seen_across(4.0 * floor_m2 / walls_m2)
    to_floor = (1.0 - across) * floor_m2 / walls_m2
    among = 1.0 - 2.0 * to_floor
    # floor = across + (1 - across) wall_albedo walls
    # walls = to_floor + to_floor floor_albedo floor + among wall_albedo walls
    gain = to_floor * floor_albedo
    walls = (to_floor + gain * across) / (
        1.0 - among * wall_albedo - gain * (1.0 - across) * wall_albedo
    )
    return across + (1.0 - across) * wall_albedo * walls, walls


def seen_across(x: float) -> float:
    """Return the view factor between two squares, one right above the other.

    Howell and Menguc, A catalog of radiation heat transfer configuration factors, C-11.

    Args:
        x: Their side over their distance, above 0.
    """
    square, root = x * x, math.sqrt(1.0 + x * x)
    log = 0.5 * math.log((1.0 + square) ** 2 / (1.0 + 2.0 * square))
    turns = 2.0 * x * root * math.atan(x / root) - 2.0 * x * math.atan(x)
    return 2.0 / (math.pi * square) * (log + turns)
