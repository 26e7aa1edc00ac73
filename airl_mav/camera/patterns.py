"""Where a point of a body lies in the pattern of its material, and which texel that is.

Places are along the body's own axes [m]. The pattern is in metres, or in periods where it goes
round a body in a whole number of them. Inlined into the loops of `surfaces`, which vectorise.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from airl_mav.camera.shading import F32, Surface, turn_of
from airl_mav.camera.textures import SIDE
from airl_mav.core.kernels import kernel

_TURN: Final = 2.0 * math.pi

STEEP: Final = F32(0.02)
"""Least cosine between ray and normal for the size of a pixel."""


@kernel
def texels2(surface: Surface, pixel2: np.float32) -> np.float32:
    """Return the square of the texels of the finest level that a pixel covers 1 m away, head on."""
    texels = F32(SIDE) * surface.per_m
    return texels * texels * pixel2


@kernel
def periods_around(radius: float, per_m: np.float32) -> np.float32:
    """Return the whole number of periods around a body of a radius [m]."""
    return F32(max(np.rint(_TURN * radius * per_m), 1.0))


@kernel
def on_box(
    a: np.float32, b: np.float32, c: np.float32, on_c: bool, on_a: bool
) -> tuple[np.float32, np.float32]:
    """Return the place [m] in the pattern of a box face, from its middle.

    `a`, `b` and `c` (down) are box coordinates from the centre; `on_c` marks upper and lower faces,
    otherwise `on_a` those across the first axis.
    """
    across = a if on_c else (b if on_a else a)
    along = b if on_c else c
    return across, along


@kernel
def on_cylinder(
    a: np.float32,
    b: np.float32,
    c: np.float32,
    cap: bool,
    per_m: np.float32,
    per_turn: np.float32,
) -> tuple[np.float32, np.float32]:
    """Return a place in the pattern of a cylinder, in periods; `cap`: on one of its ends."""
    across = a * per_m if cap else turn_of(b, a) * per_turn
    along = (b if cap else c) * per_m
    return across, along


@kernel
def on_sphere(
    a: np.float32, b: np.float32, c: np.float32, per_turn: np.float32
) -> tuple[np.float32, np.float32]:
    """Return a place in the pattern of a sphere, in periods: by longitude and latitude."""
    return turn_of(b, a) * per_turn, turn_of(c, np.sqrt(a * a + b * b)) * per_turn


@kernel
def on_triangle(
    a: np.float32,
    b: np.float32,
    c: np.float32,
    n0: np.float32,
    n1: np.float32,
    n2: np.float32,
) -> tuple[np.float32, np.float32]:
    """Return a place in the pattern of a triangle [m], as seen along the axis of its normal."""
    q0, q1, q2 = abs(n0), abs(n1), abs(n2)
    level = q2 >= max(q0, q1)
    across = a if level or q1 > q0 else b
    along = b if level else c
    return across, along
