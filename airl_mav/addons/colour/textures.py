"""Textures: repeating patterns of numbers 0..1 with coarser levels (mip maps).

A procedural pattern depends on its name only. A picture from a file provides three patterns.
Surfaces differ in offset, size and albedos. Files are untrusted: only two formats, with the size
checked first.
"""

from __future__ import annotations

import io
from functools import cache, lru_cache
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from airl_mav.addons.colour import appearance, profile
from airl_mav.core.errors import UsageError
from airl_mav.profiles.loading import read_checked

Floats = NDArray[np.float64]

FORMATS: Final = ("PNG", "JPEG")

MODES: Final = ("1", "L", "P", "RGB")
"""Accepted Pillow modes: at most 8 bits per channel, without transparency."""

LEAST_PX, MOST_PX = 2, 4096


@lru_cache(maxsize=2 * profile.MOST_IMAGES)
def texels_of(file: profile.ImageFile, side: int) -> Floats:
    """Return a picture (side, side, 3) in linear RGB 0..1, resized; cached. Raises UsageError."""
    # Imported here because flights without a simulation read no pictures.
    from PIL import Image

    data = read_checked(file)
    try:
        with Image.open(io.BytesIO(data), formats=FORMATS) as picture:
            _check(picture, file.file)
            pixels = np.asarray(picture.convert("RGB"))
    except UsageError:
        raise
    except Exception as error:  # Decoders raise many types for damaged files.
        words = " ".join(str(error).split()) or type(error).__name__
        raise UsageError(f"{file.file}: no PNG or JPEG that can be read: {words[:200]}") from None
    light = appearance.linear_of(np.arange(256) / 255.0).astype(np.float32)[pixels]
    # Box filter to shrink a picture, bilinear to enlarge it.
    how = Image.Resampling.BOX if len(light) >= side else Image.Resampling.BILINEAR
    planes = [
        np.asarray(Image.fromarray(np.ascontiguousarray(plane)).resize((side, side), how))
        for plane in np.moveaxis(light, -1, 0)
    ]
    texels = np.clip(np.stack(planes, axis=-1).astype(np.float64), 0.0, 1.0)
    # The cache shares the array between callers.
    texels.setflags(write=False)
    return texels


def _check(picture: Any, name: str) -> None:
    """Raise UsageError for a picture unsuitable as a texture, before any pixel is read."""
    width, height = picture.size
    if width != height or not LEAST_PX <= width <= MOST_PX:
        raise UsageError(
            f"{name}: {width} x {height} px; accepted: as wide as high, {LEAST_PX} to {MOST_PX} px"
        )
    if picture.mode not in MODES or "transparency" in picture.info:
        raise UsageError(
            f"{name}: of mode {picture.mode}; accepted: 8 bits a channel, without transparency"
        )


LEVELS: Final = 7
"""Number of coarser levels of a pattern; the last is one texel."""

SIDE: Final = 1 << LEVELS
"""Texels along each side of a pattern's finest level."""

STRIDE: Final = 2 * SIDE * SIDE
"""Length of one pattern in the atlas; a level of n x n texels is at n² to 2 n², row by row."""

PERIOD: Final = {"plain": 1.0, "checker": 2.0, "noise": 8.0, "brick": 4.0, "foliage": 16.0}
"""Period of each pattern, in `Material.size_m`."""

COURSES: Final = 8
"""Courses of bricks per period; a brick is twice as long as high."""

_JOINT: Final = 2  # texels of mortar above a brick, and on its left
_OCTAVES: Final = 3


@lru_cache(maxsize=8)
def atlas(images: tuple[profile.ImageFile, ...] = ()) -> NDArray[np.float32]:
    """Return all levels of all patterns (patterns * STRIDE,), in the order of TEXTURES.

    Red, green and blue of images follow; UsageError for an unreadable one.
    """
    planes = [np.moveaxis(texels_of(image, SIDE), -1, 0) for image in images]
    patterns = [*map(pattern, appearance.TEXTURES), *(plane for image in planes for plane in image)]
    made = np.zeros(len(patterns) * STRIDE, np.float32)
    for number, finest in enumerate(patterns):
        level, n = finest, SIDE
        while True:
            begin = number * STRIDE + n * n
            made[begin : begin + n * n] = level.ravel()
            if n == 1:
                break
            n //= 2
            # Each coarser level is the mean of 2 x 2 texels.
            level = level.reshape(n, 2, n, 2).mean(axis=(1, 3))
    made.setflags(write=False)
    return made


def pattern(name: str) -> Floats:
    """Return the finest level of a pattern (SIDE, SIDE): rows go down, columns to the right."""
    row, column = np.mgrid[:SIDE, :SIDE]
    if name == "checker":
        half = SIDE // 2
        checks: Floats = ((row // half + column // half) % 2).astype(np.float64)
        return checks
    if name == "brick":
        return _bricks(row, column)
    if name == "noise":
        return _value_noise(np.random.default_rng(1), 8, _OCTAVES)
    if name == "foliage":
        return _leaves(np.random.default_rng(2))
    return np.zeros((SIDE, SIDE))


def _bricks(row: NDArray[np.intp], column: NDArray[np.intp]) -> Floats:
    """Return a running bond: every second course is shifted by half a brick."""
    height, length = SIDE // COURSES, SIDE // int(PERIOD["brick"])
    course = row // height
    along = column + (course % 2) * (length // 2)
    # Fixed seeds: a pattern depends on its name only.
    rng = np.random.default_rng(3)
    tone = rng.uniform(0.75, 1.0, (COURSES, int(PERIOD["brick"])))
    brick = tone[course, (along % SIDE) // length]
    joint = (row % height < _JOINT) | (along % length < _JOINT)
    return np.where(joint, 0.0, brick)


def _value_noise(rng: np.random.Generator, cells: int, octaves: int) -> Floats:
    """Return repeating value noise: each octave halves wavelength and amplitude."""
    total, weight = np.zeros((SIDE, SIDE)), 0.0
    for octave in range(octaves):
        n = cells << octave
        values = rng.random((n, n))
        place = np.arange(SIDE) * n / SIDE
        low = place.astype(np.intp)
        part = place - low
        # Smoothstep between the corners of a cell.
        blend = part * part * (3.0 - 2.0 * part)
        # The last cell continues with the first, so the pattern repeats.
        high = (low + 1) % n
        rows = values[low] + (values[high] - values[low]) * blend[:, None]
        total += 0.5**octave * (rows[:, low] + (rows[:, high] - rows[:, low]) * blend)
        weight += 0.5**octave
    contrast = 1.7  # The sum of octaves concentrates around the mean.
    return np.clip(0.5 + contrast * (total / weight - 0.5), 0.0, 1.0)


def _leaves(rng: np.random.Generator) -> Floats:
    """Return overlapping ellipses, each brighter at its midrib, later ones brighter."""
    seen = np.zeros((SIDE, SIDE))
    row, column = np.mgrid[:SIDE, :SIDE]
    count = 500
    length = SIDE / PERIOD["foliage"]
    for k in range(count):
        middle = rng.random(2) * SIDE
        angle, size = rng.uniform(0.0, np.pi), length * rng.uniform(0.6, 1.1)
        # Shortest offset in the repeating pattern.
        dr, dc = (
            (x - m + SIDE / 2) % SIDE - SIDE / 2 for x, m in zip((row, column), middle, strict=True)
        )
        along = (np.cos(angle) * dc + np.sin(angle) * dr) / size
        across = (np.cos(angle) * dr - np.sin(angle) * dc) / (0.45 * size)
        inside = along**2 + across**2 <= 1.0
        tone = (0.25 + 0.6 * k / count) * rng.uniform(0.7, 1.0)
        seen = np.where(inside, tone * (1.0 - 0.35 * np.abs(across)), seen)
    leaves: Floats = seen / seen.max()
    return leaves


@cache
def means() -> Floats:
    """Return the mean of each pattern, in the order of TEXTURES."""
    return np.array([pattern(name).mean() for name in appearance.TEXTURES])


def mean_of(finish: appearance.Finish, row: int) -> Floats | float:
    """Return the mean of a surface's pattern; (3,) of an image's red, green and blue."""
    number = int(finish.texture[row])
    if number < len(appearance.TEXTURES):
        return float(means()[number])
    mean: Floats = texels(finish, row).mean(axis=(0, 1))
    return mean


def texels(finish: appearance.Finish, row: int) -> Floats:
    """Return the finest level of a surface's texture (SIDE, SIDE, 3), 0..1 each."""
    number = int(finish.texture[row])
    if number < len(appearance.TEXTURES):
        return np.repeat(pattern(appearance.TEXTURES[number])[..., None], 3, axis=-1)
    return texels_of(finish.images[(number - appearance.image_number(0)) // 3], SIDE)


def periods(finish: appearance.Finish) -> Floats:
    """Return the length of the period (m,) of every surface's pattern, in `Finish.size_m`."""
    lengths = [PERIOD[name] for name in appearance.TEXTURES] + [1.0] * 3 * len(finish.images)
    return np.array(lengths)[finish.texture]
