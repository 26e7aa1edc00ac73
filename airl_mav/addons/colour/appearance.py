"""Appearance drawn from a seed: a material for each surface, and the light.

A camera without global illumination needs the mean irradiance of floor and walls below a ceiling.
The balance of floor, walls and ceiling is solved for a square room with the same height and the
same share of walls (radiosity method: Goral et al., Modeling the interaction of light between
diffuse surfaces, SIGGRAPH 1984). The ceiling reflects nothing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import get_args

import numpy as np
from numpy.typing import NDArray

from airl_mav.addons.colour import profile
from airl_mav.arena.geometry import Arena, Statics
from airl_mav.core.streams import Stream, stream

Floats = NDArray[np.float64]
Rgb = tuple[int, int, int]

TEXTURES: tuple[str, ...] = get_args(profile.TextureName)
"""Texture of each number in `Finish.texture`."""

SURFACES: tuple[str, ...] = get_args(profile.SurfaceName)
"""Reflection model of each number in `Finish.surface`."""

FLOOR, WALLS, OBSTACLE = 0, 1, 2
"""Rows of a `Finish`: obstacle i has row OBSTACLE + i."""

LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
"""Share of linear red, green and blue in luminance (ITU-R BT.709, the primaries of sRGB)."""


class _Part(IntEnum):
    """Independent draws of one appearance: changing one kind leaves the others unchanged."""

    SUN = 0
    SKY = 1
    FOG = 2
    FLOOR = 3
    WALLS = 4
    STATIC = 5
    MOVING = 6


@dataclass(frozen=True)
class Finish:
    """Materials of m surfaces: floor, walls, then the obstacles in their order."""

    texture: NDArray[np.int8]  # (m,) number in TEXTURES, or of an image: `image_number`
    albedo: Floats  # (m, 2, 3) linear RGB 0..1 where the texture is 0, and where it is 1
    size_m: Floats  # (m,) `Material.size_m`
    offset: Floats  # (m, 2) offset of the pattern in its periods, 0..1
    surface: NDArray[np.int8]  # (m,) number in SURFACES
    roughness: Floats  # (m,) `Material.roughness`
    images: tuple[profile.ImageFile, ...] = ()

    def colour(self, row: int) -> Rgb:
        """Return the sRGB 0-255 of a surface seen from far away: half of each albedo."""
        return srgb_bytes(self.albedo[row].mean(axis=0))


@dataclass(frozen=True)
class Inside:
    """Mean irradiance of surfaces below a ceiling."""

    floor: Floats  # (3,) linear RGB irradiance of the floor
    walls: Floats  # (3,) the same of upright surfaces


@dataclass(frozen=True)
class Light:
    """Sun, sky and fog. A white surface under the irradiance 1 reads full scale."""

    to_sun: Floats  # (3,) unit vector NED towards the sun
    sun: Floats  # (3,) linear RGB irradiance of a surface that faces the sun
    zenith: Floats  # (3,) linear RGB of the sky overhead, as an image shows it
    horizon: Floats  # (3,) the same at the horizon; the colour of fog
    extinction: float
    """Extinction coefficient of fog [1/m]."""
    inside: Inside | None = None
    """Light below a ceiling, which zenith and horizon show, without a sun; None = no ceiling."""

    @property
    def sky(self) -> Floats:
        """Linear RGB irradiance (3,) of a level surface from the sky.

        2 ∫ (horizon + (zenith - horizon) x) x dx over x, the sine of the elevation, 0 to 1.
        """
        return (self.horizon + 2.0 * self.zenith) / 3.0


@dataclass(frozen=True)
class Drawn:
    """The appearance of one concrete arena."""

    finish: Finish
    light: Light

    def colour_of(self, i: int) -> Rgb:
        """Return the sRGB 0-255 of obstacle i seen from far away."""
        return self.finish.colour(OBSTACLE + i)


def look_of(arena: Arena) -> Drawn:
    """Draw the materials of all surfaces of an arena, and the light."""
    look = draw_appearance(
        arena.appearance,
        arena.seed,
        arena.n_static,
        len(arena.tours),
        arena.wall_colour,
        arena.statics,
    )
    b, n = arena.bounds, arena.n_static
    if not b.ceiling:
        return look
    length, width = b.north_max - b.north_min, b.east_max - b.east_min
    walls = [(WALLS, 2.0 * (length + width) * b.height)]
    boxes = 0 if arena.building is None else arena.building.boxes
    for i in range(n - boxes, n):
        # Both sides are visible.
        half = arena.obstacles.half_size[i]
        walls.append((OBSTACLE + i, float(8.0 * half[:2].max() * half[2])))
    return indoors(look, length * width, tuple(walls))


def clear_of(arena: Arena) -> NDArray[np.bool_] | None:
    """Return a mask (n,) of an arena's glass obstacles; None = no glass."""
    parts = () if arena.statics is None else arena.statics.materials
    # The appearance is drawn only if a material can be glass.
    if not arena.appearance.may_have("glass", (name for name in parts if name is not None)):
        return None
    glass = arena.look.finish.surface[OBSTACLE:] == SURFACES.index("glass")
    return glass if glass.any() else None


def draw_appearance(
    appearance: profile.Appearance,
    seed: int,
    n_static: int,
    n_moving: int,
    wall_colour: Rgb,
    statics: Statics | None = None,
) -> Drawn:
    """Draw the appearance of an arena; deterministic.

    `appearance.period` consecutive seeds share their draws. `wall_colour` is the sRGB of the
    material of this name, 0-255; `statics` groups static primitives, None = each is separate.
    """
    draw = seed // appearance.period
    kinds: list[tuple[_Part, profile.Surfaces, int]] = [
        (_Part.FLOOR, appearance.floor, 1),
        (_Part.WALLS, appearance.walls, 1),
        (_Part.STATIC, appearance.static, n_static if statics is None else len(statics.names)),
        (_Part.MOVING, appearance.moving, n_moving),
    ]
    rows = [
        _surfaces(
            stream(draw, Stream.APPEARANCE, part),
            n,
            kind,
            appearance,
            wall_colour,
            statics if part is _Part.STATIC else None,
        )
        for part, kind, n in kinds
        if n
    ]
    texture, albedo, size, offset, surface, roughness = (
        np.concatenate(parts) for parts in zip(*rows, strict=True)
    )
    finish = Finish(
        texture.astype(np.int8),
        albedo,
        size,
        offset,
        surface.astype(np.int8),
        roughness,
        appearance.images,
    )
    return Drawn(finish, _light(appearance, draw))


def _surfaces(
    rng: np.random.Generator,
    n: int,
    kind: profile.Surfaces,
    appearance: profile.Appearance,
    wall_colour: Rgb,
    statics: Statics | None,
) -> tuple[Floats, ...]:
    """Draw n surfaces of a kind: texture, albedos, size, offset, ..., in the order of `Finish`.

    All values are drawn for every surface, used or not, so that settings and counts do not change
    other draws. The parts of a group share draws.
    """
    # Per surface: material, brightness, three tints, two offsets of the pattern.
    draws = rng.random((n, 7))
    materials = [appearance.material(name, wall_colour) for name in kind.materials]
    chosen = (draws[:, 0] * len(materials)).astype(np.intp)
    if statics is not None:
        # Parts of one asset share the draws of their owner.
        draws, chosen = draws[statics.of], chosen[statics.of]
        for part, name in enumerate(statics.materials):
            if name is not None:
                chosen[part] = len(materials)
                materials.append(appearance.material(name, wall_colour))
    dark, bright = kind.brightness
    factor = (dark + (bright - dark) * draws[:, 1, None]) * (
        1.0 + kind.tint * (2.0 * draws[:, 2:5] - 1.0)
    )
    albedo = np.array([_albedos(material) for material in materials])[chosen] * factor[:, None]
    texture = np.array([_number(material, appearance) for material in materials], np.float64)
    size = np.array([material.size_m for material in materials])
    surface = np.array([SURFACES.index(material.surface) for material in materials], np.float64)
    rough = np.array([material.roughness for material in materials])
    return (
        texture[chosen],
        np.clip(albedo, 0.0, 1.0),
        size[chosen],
        draws[:, 5:],
        surface[chosen],
        rough[chosen],
    )


def image_number(k: int) -> int:
    """Return the texture number of image k; its red, green and blue are three patterns."""
    return len(TEXTURES) + 3 * k


def _number(material: profile.Material, appearance: profile.Appearance) -> int:
    """Return the number of a material's texture."""
    if material.image is None:
        return TEXTURES.index(material.texture)
    return image_number(appearance.images.index(material.image))


def _albedos(material: profile.Material) -> Floats:
    """Return both albedos (2, 3), linear RGB. An image has the albedos of its black and white."""
    if material.image is not None:
        return np.stack([np.zeros(3), linear_of(np.array(material.albedo) / 255.0)])
    second = material.albedo if material.albedo_2 is None else material.albedo_2
    return linear_of(np.array([material.albedo, second]) / 255.0)


def _light(appearance: profile.Appearance, draw: int) -> Light:
    """Draw sun, sky and fog."""
    sun, sky = appearance.sun, appearance.sky
    rng = stream(draw, Stream.APPEARANCE, _Part.SUN)
    azimuth, elevation = (
        math.radians(rng.uniform(*span)) for span in (sun.azimuth_deg, sun.elevation_deg)
    )
    sun_irradiance = rng.uniform(*sun.irradiance)
    sky_irradiance = stream(draw, Stream.APPEARANCE, _Part.SKY).uniform(*sky.irradiance)
    rng = stream(draw, Stream.APPEARANCE, _Part.FOG)
    # Always two draws, so that the fog's settings do not change each other.
    extinction = rng.uniform(*appearance.fog.extinction_1_m)
    extinction = extinction if rng.random() < appearance.fog.share else 0.0
    level = math.cos(elevation)
    # NED: the sun above the horizon has a negative down component.
    to_sun = (level * math.cos(azimuth), level * math.sin(azimuth), -math.sin(elevation))
    zenith, horizon = (linear_of(np.array(c) / 255.0) for c in (sky.zenith, sky.horizon))
    # Scale the sky's colours to the drawn irradiance, by luminance.
    whole = float(LUMINANCE @ (horizon + 2.0 * zenith) / 3.0)
    scale = sky_irradiance / whole if whole > 0.0 else 0.0
    colour = linear_of(np.array(sun.colour) / 255.0)
    luminance = float(LUMINANCE @ colour)
    return Light(
        to_sun=np.array(to_sun),
        sun=colour * (sun_irradiance / luminance if luminance > 0.0 else 0.0),
        zenith=scale * zenith,
        horizon=scale * horizon,
        extinction=float(extinction),
    )


def linear_of(encoded: Floats) -> Floats:
    """Return linear light of sRGB values, both 0..1 (IEC 61966-2-1).

    Bit-identical on every processor, as seeds require; numpy's power differs with AVX-512. Slow:
    use a table for images.
    """
    # Python's power, not numpy's: the result must have the same bits on every processor.
    raised = [x**2.4 for x in ((encoded + 0.055) / 1.055).ravel().tolist()]
    return np.where(encoded <= 0.04045, encoded / 12.92, np.reshape(raised, encoded.shape))


def srgb_of(linear: Floats) -> Floats:
    """Return sRGB values of linear light, both 0..1 (IEC 61966-2-1); clipped."""
    x = np.clip(linear, 0.0, 1.0)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1.0 / 2.4) - 0.055)


def srgb_bytes(linear: Floats) -> tuple[int, int, int]:
    """Return linear RGB (3,) as sRGB 0-255."""
    red, green, blue = (round(255.0 * float(channel)) for channel in srgb_of(linear))
    return red, green, blue


def indoors(look: Drawn, floor_m2: float, walls: tuple[tuple[int, float], ...]) -> Drawn:
    """Return an appearance lit by a ceiling of the sky's colour, without a sun.

    The mean luminance on the floor equals the luminance of a level surface outdoors, including
    interreflections of walls and floor. `walls` are row in the `Finish` and visible area [m²] of
    each wall surface.
    """
    light, albedo = look.light, look.finish.albedo.mean(axis=1)
    areas = np.array([area for _, area in walls])
    of_walls = areas @ albedo[[row for row, _ in walls]] / areas.sum()
    floor, upright = _irradiances(albedo[FLOOR], of_walls, floor_m2, float(areas.sum()))
    luminance = float(LUMINANCE @ light.sky)
    # Without sky light the ceiling is white.
    colour = light.sky / luminance if luminance > 0.0 else np.ones(3)
    # The brightness of the ceiling that gives the floor its outdoor luminance.
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
    """Return mean irradiance (3,) of floor and walls for a ceiling of radiosity 1."""
    across = seen_across(4.0 * floor_m2 / walls_m2)
    # Reciprocity of view factors: floor area times factor equals wall area times factor.
    to_floor = (1.0 - across) * floor_m2 / walls_m2
    # A wall sees floor and ceiling alike; the rest of its view is walls.
    among = 1.0 - 2.0 * to_floor
    # floor = across + (1 - across) wall_albedo walls
    # walls = to_floor + to_floor floor_albedo floor + among wall_albedo walls
    gain = to_floor * floor_albedo
    walls = (to_floor + gain * across) / (
        1.0 - among * wall_albedo - gain * (1.0 - across) * wall_albedo
    )
    return across + (1.0 - across) * wall_albedo * walls, walls


def seen_across(x: float) -> float:
    """Return the view factor between two squares, of side / distance `x`, one above the other.

    Howell and Menguc, A catalog of radiation heat transfer configuration factors, C-11.
    """
    square, root = x * x, math.sqrt(1.0 + x * x)
    log = 0.5 * math.log((1.0 + square) ** 2 / (1.0 + 2.0 * square))
    turns = 2.0 * x * root * math.atan(x / root) - 2.0 * x * math.atan(x)
    return 2.0 / (math.pi * square) * (log + turns)
