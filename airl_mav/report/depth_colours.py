"""Depth images as bytes and in colour; near pixels are bright."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from matplotlib import colormaps
from numpy.typing import NDArray

from airl_mav.camera.frame import nearness, rgb_of

NO_RETURN = "#262a30"
"""Colour of pixels without a depth return, as in the live view."""

LEVELS = 255
"""Number of shades from far to near."""


def shades(depth_mm: NDArray[np.uint16], range_m: float) -> NDArray[np.uint8]:
    """Return a depth image (h, w) [mm] as bytes: 0 no return, 1 at `range_m`, 255 at 0 m."""
    scaled = np.round((LEVELS - 1) * nearness(depth_mm, range_m))
    bytes_of: NDArray[np.uint8] = (1.0 + scaled).astype(np.uint8)
    bytes_of[depth_mm == 0] = 0
    return bytes_of


@cache
def palette() -> tuple[str, ...]:
    """Return the colour "#rrggbb" of each byte."""
    table = colormaps["viridis"](np.linspace(0.0, 1.0, LEVELS), bytes=True)[:, :3].tolist()
    return (NO_RETURN, *(f"#{red:02x}{green:02x}{blue:02x}" for red, green, blue in table))


def coloured(depth_mm: NDArray[np.uint16], range_m: float) -> NDArray[np.uint8]:
    """Return a depth image (h, w) [mm] in colour, RGB (h, w, 3)."""
    table = np.array([[int(c[k : k + 2], 16) for k in (1, 3, 5)] for c in palette()], np.uint8)
    picture: NDArray[np.uint8] = table[shades(depth_mm, range_m)]
    return picture


def pictured(image: NDArray[Any], range_m: float) -> NDArray[np.uint8]:
    """Return a camera image (`camera.frame.Frame.image`) for display: RGB (h, w, 3)."""
    return rgb_of(image) if image.ndim == 3 else coloured(image, range_m)
