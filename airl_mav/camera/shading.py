"""Light, texture, fog and sRGB of one point, in branch-free float32 for vectorized loops."""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from airl_mav.arena.finishes import TEXTURES
from airl_mav.camera.gloss import Gloss
from airl_mav.camera.textures import LEVELS, SIDE, STRIDE
from airl_mav.core.kernels import borrowing_kernel, kernel

F32 = np.float32
I32 = np.int32
Vec32 = tuple[np.float32, np.float32, np.float32]
Plane = NDArray[np.float32]
Packed = NDArray[np.int32]

ZERO: Final = F32(0.0)
HALF: Final = F32(0.5)
ONE: Final = F32(1.0)
_IMAGES: Final = len(TEXTURES)
"""First texture number of an image."""

LEAST: Final = F32(1e-6)
"""Minimum divisor."""


class Surface(NamedTuple):
    """Material of one surface."""

    base: np.int64
    """Start of the pattern in the atlas; for an image, its red channel."""
    step: np.int64
    """Atlas offset from red to green and from green to blue; 0 = one channel."""
    per_m: np.float32
    """Periods of the pattern per metre [1/m]."""
    offset: tuple[np.float32, np.float32]
    """Offset of the pattern, in periods."""
    albedo: Vec32
    """Albedo at pattern value 0."""
    more: Vec32
    """Difference between the albedo at pattern value 1 and `albedo`."""


class Points(NamedTuple):
    """Work buffers for the points of one line of an image."""

    place: Packed
    """Index of the nearest texel in the pattern."""
    facing: Plane
    """Cosine of the angle between normal and sun; 0 on sides away from the sun."""
    up: Plane
    """Cosine of the angle between normal and zenith."""
    pattern: Plane
    """Pattern value; for an image, red."""
    green: Plane
    """Green of an image; `blue` accordingly."""
    blue: Plane


class PixelRays(NamedTuple):
    """Rays of all pixels, line by line, in north, east and down."""

    north: Plane  # (n,)
    east: Plane  # (n,)
    down: Plane  # (n,)


class Lit(NamedTuple):
    """Light of an arena, linear RGB."""

    to_sun: Vec32
    """Unit vector NED."""
    sun: Vec32
    """Irradiance of a surface facing the sun."""
    sky: Vec32
    """Irradiance of a level surface by the whole sky."""
    ground: Vec32
    """Radiosity of the sunlit floor: irradiance of a surface that faces only the floor."""
    zenith: Vec32
    horizon: Vec32
    extinction: np.float32


class SceneLook(NamedTuple):
    """Appearance of an arena, as for `colour.render_colour`, and the pixel size."""

    texture: NDArray[np.int8]  # (2 + n,)
    per_m: NDArray[np.float32]  # (2 + n,)
    offset: NDArray[np.float32]  # (2 + n, 2)
    albedo: NDArray[np.float32]  # (2 + n, 2, 3)
    gloss: Gloss  # None if all surfaces are matt
    light: Lit
    atlas: Plane
    pixel2: np.float32
    """Square of the side of a pixel at a depth of 1."""


class Canvas(NamedTuple):
    """Image during shading: n pixels line by line, and work buffers."""

    out: Packed  # (n,) written
    ids: Packed  # (n,) segmentation
    far: Plane  # (n,) depth [m], 0 = no surface
    lit: Plane  # (n,) 1 in the sun, 0 in shadow
    clear: Plane  # (n,) transmission of fog
    rays: PixelRays
    points: Points


@borrowing_kernel
def surface_of(look: SceneLook, i: int) -> Surface:
    """Return material i."""
    texture, per_m, offset, albedo = look.texture, look.per_m, look.offset, look.albedo
    dark = (albedo[i, 0, 0], albedo[i, 0, 1], albedo[i, 0, 2])
    more = (
        albedo[i, 1, 0] - dark[0],
        albedo[i, 1, 1] - dark[1],
        albedo[i, 1, 2] - dark[2],
    )
    base = np.int64(texture[i]) * STRIDE
    # Procedural patterns are grey: one plane serves all channels.
    step = np.int64(STRIDE) if texture[i] >= _IMAGES else np.int64(0)
    return Surface(base, step, per_m[i], (offset[i, 0], offset[i, 1]), dark, more)


@kernel
def _part(x: np.float32) -> np.float32:
    """Return x - floor(x); `floor` itself does not vectorize."""
    part = x - F32(I32(x))
    return part + ONE if part < ZERO else part


@kernel
def texel_at(u: np.float32, v: np.float32, texels2: np.float32) -> np.int32:
    """Return the nearest texel at (u, v), in periods, of the mip level for a pixel.

    `texels2`: squared number of texels per pixel, each way, at the finest level.
    """
    # Half the exponent of a float is log2 of its root: the level. Its side is SIDE / 2^level.
    exponent = I32(F32(texels2 + texels2).view(I32) >> 23) - I32(127)
    level = I32(min(max(exponent, I32(0)), I32(2 * LEVELS))) >> 1
    side = I32(I32(127 + LEVELS - level) << 23).view(F32)
    # A coordinate just below an integer may round up to it.
    column = min(F32(I32(_part(u) * side)), side - ONE)
    row = min(F32(I32(_part(v) * side)), side - ONE)
    # A level of n x n texels begins at n², see `textures.STRIDE`.
    return I32(side * (side + row) + column)


@kernel
def irradiance(light: Lit, channel: int, direct: np.float32, rise: np.float32) -> np.float32:
    """Return the irradiance of a surface in one channel (0, 1 or 2) of linear RGB.

    Sky and ground are weighted by (1 + cos tilt) / 2 and (1 - cos tilt) / 2 (Liu and Jordan, The
    long-term average performance of flat-plate solar-energy collectors, 1963). `direct` is the
    cosine of normal and sun times the unshadowed share, `rise` the cosine of normal and zenith.
    """
    # Irradiance of an upright plane, and its increase for a level plane.
    upright = HALF * (light.sky[channel] + light.ground[channel])
    level = light.sky[channel] - upright
    return direct * light.sun[channel] + (upright + rise * level)


@borrowing_kernel
def paint(
    canvas: Canvas,
    look: SceneLook,
    surface: Surface,
    left: int,
    end: int,
    first: np.int32,
    last: np.int32,
) -> None:
    """Write the packed sRGB of left..end for surfaces first..last; Lambert's and Beer's laws."""
    place, facing, up, pattern, green_of, blue_of = canvas.points
    light, atlas = look.light, look.atlas
    row, marks = canvas.out[left:end], canvas.ids[left:end]
    lit_row, clear_row = canvas.lit[left:end], canvas.clear[left:end]
    # A separate loop: gathers from the atlas do not vectorize. Unsigned: a signed index would add a
    # check for negative values at each access.
    for u in range(end - left):
        pattern[u] = atlas[np.uint64(surface.base + place[u])]
    if surface.step == 0:
        green_of, blue_of = pattern, pattern
    else:
        green_at, blue_at = surface.base + surface.step, surface.base + 2 * surface.step
        for u in range(end - left):
            green_of[u] = atlas[np.uint64(green_at + place[u])]
            blue_of[u] = atlas[np.uint64(blue_at + place[u])]
    dark, more, horizon = surface.albedo, surface.more, light.horizon
    for u in range(end - left):
        value, through = pattern[u], clear_row[u]
        direct, rise = lit_row[u] * facing[u], up[u]
        red = (dark[0] + more[0] * value) * irradiance(light, 0, direct, rise)
        green = (dark[1] + more[1] * green_of[u]) * irradiance(light, 1, direct, rise)
        blue = (dark[2] + more[2] * blue_of[u]) * irradiance(light, 2, direct, rise)
        colour = packed(
            horizon[0] + through * (red - horizon[0]),
            horizon[1] + through * (green - horizon[1]),
            horizon[2] + through * (blue - horizon[2]),
        )
        # Branch-free: pixels of other bodies keep their colour.
        row[u] = colour if (marks[u] >= first) & (marks[u] <= last) else row[u]


@kernel
def encoded(x: np.float32) -> np.int32:
    """Return linear light as an sRGB code, 0..255 (IEC 61966-2-1). Negative light is black.

    The power is a minimax polynomial of the root, accurate to 0.09 of a code.
    """
    # Light beyond white is clipped.
    x = min(x, ONE)
    s = np.sqrt(x)
    curve = F32(-413.73478559914724) + F32(131.81300432715605) * s
    curve = F32(517.7284762186123) + curve * s
    curve = F32(-357.54480524554555) + curve * s
    curve = F32(387.0472913646104) + curve * s
    # Adds half a code, so that truncation rounds to the nearest code.
    curve = F32(-10.226101032503605 + 0.5) + curve * s
    straight = F32(12.92 * 255.0) * x + HALF
    return I32(curve if x > F32(0.0031308) else straight)


@kernel
def packed(red: np.float32, green: np.float32, blue: np.float32) -> np.int32:
    """Return linear RGB as one number: sRGB red + 256 green + 65536 blue."""
    return I32(encoded(red) + I32(I32(256) * encoded(green)) + I32(I32(65536) * encoded(blue)))


@kernel
def turn_of(y: np.float32, x: np.float32) -> np.float32:
    """Return the angle of a direction in turns, -0.5..0.5, to 1e-5, by a minimax polynomial."""
    ax, ay = abs(x), abs(y)
    z = min(ax, ay) / max(max(ax, ay), LEAST)
    z2 = z * z
    angle = F32(0.14628965886563458) + F32(-0.03900338343142313) * z2
    angle = F32(-0.32118531071533873) + angle * z2
    angle = (F32(0.999214808018403) + angle * z2) * z * F32(0.5 / math.pi)
    # Unfold the first octant: at the diagonal, then at both axes.
    angle = F32(0.25) - angle if ay > ax else angle
    angle = HALF - angle if x < ZERO else angle
    return -angle if y < ZERO else angle


# --- coordinates of a point in its material's pattern
#
# Coordinates are in body axes [m]. The pattern is in metres, or in periods where a whole number of
# periods wraps around a body. Inlined into the vectorized loops of `surfaces`.

_TURN: Final = 2.0 * math.pi

STEEP: Final = F32(0.02)
"""Minimum cosine between ray and normal for the size of a pixel."""


@kernel
def texels2(surface: Surface, pixel2: np.float32) -> np.float32:
    """Return the squared texels per pixel of the finest level, 1 m away, at normal incidence."""
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
    """Return the pattern coordinates [m] on a box face, from its middle.

    `a`, `b` and `c` (down) are box coordinates from the centre; `on_c` marks upper and lower faces,
    otherwise `on_a` marks faces across the first axis.
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
    """Return the pattern coordinates on a cylinder, in periods; `cap`: on an end face."""
    across = a * per_m if cap else turn_of(b, a) * per_turn
    along = (b if cap else c) * per_m
    return across, along


@kernel
def on_sphere(
    a: np.float32, b: np.float32, c: np.float32, per_turn: np.float32
) -> tuple[np.float32, np.float32]:
    """Return the pattern coordinates on a sphere, in periods, from longitude and latitude."""
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
    """Return the pattern coordinates on a triangle [m], projected along the normal's main axis."""
    q0, q1, q2 = abs(n0), abs(n1), abs(n2)
    level = q2 >= max(q0, q1)
    across = a if level or q1 > q0 else b
    along = b if level else c
    return across, along
