"""Light, texture, fog and sRGB of one point, in branch-free float32 for vectorized loops.

Reflection models in addition to Lambert's law are Fresnel's equations and microfacets. Rough
surfaces follow Walter et al., Microfacet models for refraction through rough surfaces, 2007: facets
with GGX-distributed slopes and Smith's shadowing, separately for both directions. Reflected
directions are sampled from the visible facets (Heitz, Sampling the GGX distribution of visible
normals, 2018).
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from airl_mav.addons.colour.appearance import FLOOR as FLOOR_ROW
from airl_mav.addons.colour.appearance import LUMINANCE, SURFACES, TEXTURES, WALLS, Finish
from airl_mav.addons.colour.appearance import OBSTACLE as OBSTACLE_ROW
from airl_mav.addons.colour.textures import LEVELS, SIDE, STRIDE
from airl_mav.camera.bvh import GROUND_FIRST, Meshes
from airl_mav.camera.projection import dot
from airl_mav.core.kernels import borrowing_kernel, kernel
from airl_mav.vehicle.rotation import Vec

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


MATT: Final = SURFACES.index("matt")
GLOSSY: Final = SURFACES.index("glossy")
METAL: Final = SURFACES.index("metal")
GLASS: Final = SURFACES.index("glass")

INDEX: Final = 1.5
"""Refractive index of varnish and of glass."""

_SMOOTH: Final = 1e-3
"""Value of `alpha` below which a surface is a mirror."""

VARNISH_ADMITS: Final = 0.908222
"""Share of light from all sides that enters varnish: 1 - 0.091778, the mean of Fresnel's
reflectance at the index 1.5 over the cosine."""

SAMPLES: Final = 8
"""Reflected directions sampled at each point of a rough surface; `spread` provides eight."""


class Gloss(NamedTuple):
    """Properties of non-matt surfaces; a tuple, as kernels require. Rows as in `Finish`."""

    surface: NDArray[np.int8]  # (m,) MATT, GLOSSY, ...
    alpha: NDArray[np.float32]  # (m,) width of the slopes of the facets; 0: a mirror
    lets: NDArray[np.float32]  # (m,) share of the sun's light that passes through a body

    @classmethod
    def of(cls, finish: Finish) -> Gloss | None:
        """Return the surface properties of an arena; None if all surfaces are matt."""
        if not finish.surface.any():
            return None
        mean = finish.albedo.mean(axis=1) @ LUMINANCE
        sheet = (1.0 - pane_reflects(1.0)) * mean
        # Light crosses both sides of a body, but only one sheet of a wall.
        lets = np.where(finish.surface == GLASS, sheet**2, 0.0)
        lets[WALLS] = sheet[WALLS] if finish.surface[WALLS] == GLASS else 0.0
        alpha = finish.roughness**2
        return cls(finish.surface, alpha.astype(np.float32), lets.astype(np.float32))


@borrowing_kernel
def let_through(gloss: Gloss | None, row: int) -> np.float32:
    """Return the share of sunlight that passes through a body; 0 if all surfaces are matt."""
    return np.float32(0.0) if gloss is None else gloss.lets[row]


@kernel
def fresnel(cosine: float) -> float:
    """Return the reflected share of unpolarised light by the cosine of ray and normal, 0 to 1."""
    # Cosine inside the medium by Snell's law, then the reflectance of each polarisation.
    inner = math.sqrt(1.0 - (1.0 - cosine * cosine) / (INDEX * INDEX))
    across = (cosine - INDEX * inner) / (cosine + INDEX * inner)
    along = (INDEX * cosine - inner) / (INDEX * cosine + inner)
    return 0.5 * (across * across + along * along)


@kernel
def pane_reflects(cosine: float) -> float:
    """Return the reflectance of a thin pane, including multiple internal reflections."""
    once = fresnel(cosine)
    # Sum of the series r + (1 - r)² r / (1 - r²).
    return 2.0 * once / (1.0 + once)


@kernel
def is_smooth(alpha: float) -> bool:
    """Return True if a surface is a mirror."""
    return alpha < _SMOOTH


@kernel
def _visible(alpha: float, cosine: float) -> float:
    """Return the share of facets visible from a direction (Smith's G1 for GGX)."""
    tangent2 = 1.0 / max(cosine * cosine, 1e-12) - 1.0
    return 2.0 / (1.0 + math.sqrt(1.0 + alpha * alpha * tangent2))


@kernel
def highlight(alpha: float, normal: Vec, ray: Vec, to_sun: Vec) -> tuple[float, float]:
    """Return radiance per irradiance of the sun on a rough white surface, and the facets' cosine.

    `alpha` is the width of the slopes. The vectors are unit vectors. The cosine gives Fresnel's
    share.
    """
    sun, eye = dot(normal, to_sun), -dot(normal, ray)
    if sun <= 0.0 or eye <= 0.0:
        return 0.0, 1.0
    h = (to_sun[0] - ray[0], to_sun[1] - ray[1], to_sun[2] - ray[2])
    # GGX distribution at the half vector.
    per = 1.0 / max(math.sqrt(dot(h, h)), 1e-12)
    half = per * dot(normal, h)
    spread = half * half * (alpha * alpha - 1.0) + 1.0
    # The distribution's 1/pi cancels with the radiance of a white matt surface, also 1/pi.
    facets = alpha * alpha / (spread * spread)
    # The cosine of the sun cancels with the irradiance of the surface.
    value = facets * _visible(alpha, sun) * _visible(alpha, eye) / (4.0 * eye)
    return value, -per * dot(h, ray)


@kernel
def mirrored(ray: Vec, normal: Vec) -> Vec:
    """Return the mirrored direction of a ray, normalized against accumulated rounding."""
    twice = 2.0 * dot(ray, normal)
    a, b, c = (
        ray[0] - twice * normal[0],
        ray[1] - twice * normal[1],
        ray[2] - twice * normal[2],
    )
    per = 1.0 / math.sqrt(a * a + b * b + c * c)
    return (per * a, per * b, per * c)


@kernel
def spread(number: int) -> tuple[float, float]:
    """Return one of `SAMPLES` evenly distributed points in the unit square (Hammersley)."""
    # Bit reversal of a number of three bits.
    mirrored_bits = 4 * (number & 1) + (number & 2) + ((number & 4) >> 2)
    return (number + 0.5) / SAMPLES, (mirrored_bits + 0.5) / SAMPLES


@kernel
def facet(alpha: float, normal: Vec, ray: Vec, u: float, v: float) -> Vec:
    """Return the normal of a visible facet, sampled by uniform (u, v) in the unit square."""
    # Axes about the normal (Duff et al., Building an orthonormal basis, revisited, 2017).
    sign = math.copysign(1.0, normal[2])
    a = -1.0 / (sign + normal[2])
    b = normal[0] * normal[1] * a
    first = (1.0 + sign * normal[0] * normal[0] * a, sign * b, -sign * normal[0])
    second = (b, sign + normal[1] * normal[1] * a, -normal[1])
    # Stretched by alpha, the visible facets form a hemisphere (Heitz, 2018).
    x, y, z = -alpha * dot(first, ray), -alpha * dot(second, ray), -dot(normal, ray)
    per = 1.0 / math.sqrt(x * x + y * y + z * z)
    x, y, z = per * x, per * y, per * z
    level = math.sqrt(x * x + y * y)
    p0, p1 = (-y / level, x / level) if level > 1e-9 else (1.0, 0.0)
    # Third axis: (x, y, z) times (p0, p1, 0).
    q0, q1, q2 = -z * p1, z * p0, x * p1 - y * p0
    # Sample its projection: a disk, one half compressed by the tilt of the view.
    radius, angle = math.sqrt(u), 2.0 * math.pi * v
    s, t = radius * math.cos(angle), radius * math.sin(angle)
    share = 0.5 * (1.0 + z)
    t = (1.0 - share) * math.sqrt(max(1.0 - s * s, 0.0)) + share * t
    w = math.sqrt(max(1.0 - s * s - t * t, 0.0))
    m0, m1, m2 = s * p0 + t * q0 + w * x, s * p1 + t * q1 + w * y, t * q2 + w * z
    # Undo the stretch.
    m0, m1, m2 = alpha * m0, alpha * m1, max(m2, 0.0)
    per = 1.0 / max(math.sqrt(m0 * m0 + m1 * m1 + m2 * m2), 1e-12)
    return (
        per * (m0 * first[0] + m1 * second[0] + m2 * normal[0]),
        per * (m0 * first[1] + m1 * second[1] + m2 * normal[1]),
        per * (m0 * first[2] + m1 * second[2] + m2 * normal[2]),
    )


@kernel
def facet_gives(alpha: float, normal: Vec, away: Vec) -> float:
    """Return the weight of a direction `away` mirrored by a sampled facet; 0 below the surface."""
    cosine = dot(normal, away)
    return _visible(alpha, cosine) if cosine > 0.0 else 0.0


@borrowing_kernel
def material_row(meshes: Meshes, k: int) -> int:
    """Return the row of mesh k's material in `Finish`."""
    first = meshes.first[k]
    return FLOOR_ROW if first == GROUND_FIRST else OBSTACLE_ROW + first
