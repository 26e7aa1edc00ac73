"""Rain on the lens: drops that show the scene upside down, small and out of focus.

A drop is a strong lens, too near to be sharp. It shows its surroundings upside down with a soft
edge (Porav, Bruls and Newman, I can see clearly now: image restoration via de-raining, ICRA 2019).
Here it is an ellipse with an edge blurred by `_SOFT`, whose point at (a, b), in its own half axes,
shows the mean of nine points around (-a, -b) of `_REACH` of the image's width.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from airl_mav.camera.image_sensor import LIGHT_OF
from airl_mav.camera.shading import F32, ONE, ZERO, encoded
from airl_mav.core.kernels import kernel

_REACH: Final = F32(0.3)
"""How far from the middle of a drop is what it shows at its edge, in widths of the image."""

_BLUR: Final = F32(0.025)
"""How far from each other are the points whose mean it shows, in widths of the image."""

_SOFT: Final = F32(0.35)
"""Share of its half axes over which a drop fades out."""


def rained_on(rgb: NDArray[np.uint8], drops: NDArray[np.float32]) -> None:
    """Draw drops into an sRGB image (h, w, 3), in place; see `draw_drops`."""
    if len(drops):
        draw_drops(rgb, np.empty_like(rgb), drops, LIGHT_OF)


@kernel
def draw_drops(
    rgb: NDArray[np.uint8],
    dry: NDArray[np.uint8],
    drops: NDArray[np.float32],
    light_of: NDArray[np.float32],
) -> None:
    """Draw drops into an image `rgb` (h, w, 3) sRGB; `dry` is a buffer of its size.

    `drops` (k, 4): middle in widths and heights of the image from left and top, width in image
    widths, height in drop widths. `light_of` is `image_sensor.LIGHT_OF`.
    """
    height, width, _ = rgb.shape
    dry[:, :, :] = rgb
    across, blur = F32(width) * _REACH, F32(width) * _BLUR
    for k in range(len(drops)):
        x, y = drops[k, 0] * F32(width), drops[k, 1] * F32(height)
        half_x = F32(0.5) * drops[k, 2] * F32(width)
        half_y = half_x * drops[k, 3]
        top, bottom = max(math.floor(y - half_y), 0), min(int(y + half_y) + 1, height)
        left, right = max(math.floor(x - half_x), 0), min(int(x + half_x) + 1, width)
        for v in range(top, bottom):
            for u in range(left, right):
                a = (F32(u) + F32(0.5) - x) / half_x
                b = (F32(v) + F32(0.5) - y) / half_y
                far = np.sqrt(a * a + b * b)
                share = min(max((ONE - far) / _SOFT, ZERO), ONE)
                if share == ZERO:
                    continue
                u0, v0 = x - across * a, y - across * b
                for channel in range(3):
                    total = ZERO
                    for tap in range(9):
                        du, dv = F32(tap % 3 - 1) * blur, F32(tap // 3 - 1) * blur
                        # At the border of the image it goes on as it is there.
                        i = min(max(int(v0 + dv), 0), height - 1)
                        j = min(max(int(u0 + du), 0), width - 1)
                        total += light_of[dry[i, j, channel]]
                    own = light_of[rgb[v, u, channel]]
                    mixed = own + share * (total / F32(9.0) - own)
                    rgb[v, u, channel] = np.uint8(encoded(mixed))
