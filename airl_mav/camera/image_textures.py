"""Textures from files: a picture as the patterns of its red, green and blue.

What is read comes from a file that somebody else may have made: only two formats are tried, of a
size that is known before any pixel is.
"""

from __future__ import annotations

import io
from functools import lru_cache
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from airl_mav.arena.appearance import linear_of
from airl_mav.core.errors import UsageError
from airl_mav.profiles.image_file import MOST_IMAGES, ImageFile
from airl_mav.profiles.mesh_file import read_checked

Floats = NDArray[np.float64]

FORMATS: Final = ("PNG", "JPEG")

MODES: Final = ("1", "L", "P", "RGB")
"""Of Pillow: what has 8 bits a channel at most, and nothing that can be seen through."""

LEAST_PX, MOST_PX = 2, 4096
"""Of its sides [px]."""


@lru_cache(maxsize=2 * MOST_IMAGES)
def texels_of(file: ImageFile, side: int) -> Floats:
    """Return a picture (side, side, 3) in linear RGB 0..1, read once in a process.

    Each texel is the mean of the light of what it covers; a smaller picture is interpolated.

    Raises:
        UsageError: It cannot be read, is not the file that the profile was made with, or no picture
            that can be a texture.
    """
    # Imported here: who flies without a simulation has no pictures to read.
    from PIL import Image

    data = read_checked(file)
    try:
        with Image.open(io.BytesIO(data), formats=FORMATS) as picture:
            _check(picture, file.file)
            pixels = np.asarray(picture.convert("RGB"))
    except UsageError:
        raise
    except Exception as error:  # Whatever a decoder makes of a damaged file.
        words = " ".join(str(error).split()) or type(error).__name__
        raise UsageError(f"{file.file}: no PNG or JPEG that can be read: {words[:200]}") from None
    light = linear_of(np.arange(256) / 255.0).astype(np.float32)[pixels]
    how = Image.Resampling.BOX if len(light) >= side else Image.Resampling.BILINEAR
    planes = [
        np.asarray(Image.fromarray(np.ascontiguousarray(plane)).resize((side, side), how))
        for plane in np.moveaxis(light, -1, 0)
    ]
    texels = np.clip(np.stack(planes, axis=-1).astype(np.float64), 0.0, 1.0)
    texels.setflags(write=False)
    return texels


def _check(picture: Any, name: str) -> None:
    """Raise UsageError for a picture that is no texture; none of its pixels has been read."""
    width, height = picture.size
    if width != height or not LEAST_PX <= width <= MOST_PX:
        raise UsageError(
            f"{name}: {width} x {height} px; accepted: as wide as high, {LEAST_PX} to {MOST_PX} px"
        )
    if picture.mode not in MODES or "transparency" in picture.info:
        raise UsageError(
            f"{name}: of mode {picture.mode}; accepted: 8 bits a channel, without transparency"
        )
