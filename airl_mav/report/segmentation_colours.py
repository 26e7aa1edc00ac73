"""Segmentation images in colour: what each pixel sees."""

from __future__ import annotations

import numpy as np
from matplotlib import colormaps
from numpy.typing import NDArray

from airl_mav.camera.primitives import (
    CEILING,
    FLOOR,
    OBSTACLE,
    SKY,
    WALL_EAST_WEST,
    WALL_NORTH_SOUTH,
)

ROOM = {
    CEILING: (236, 238, 240),
    SKY: (38, 42, 48),
    FLOOR: (120, 124, 130),
    WALL_NORTH_SOUTH: (178, 184, 192),
    WALL_EAST_WEST: (208, 212, 218),
}
"""Colours of what is no obstacle; no obstacle has a grey."""


def coloured_segmentation(seen: NDArray[np.int32]) -> NDArray[np.uint8]:
    """Return what is seen (h, w), `Picture.seen`, in colour, RGB (h, w, 3).

    Obstacles have the colours of matplotlib's tab20 without its greys, over and over.
    """
    tab20 = colormaps["tab20"](np.arange(20), bytes=True)[:, :3]
    own = np.delete(tab20, (14, 15), axis=0)
    most = max(int(seen.max(initial=0)) + 1, OBSTACLE)
    # The number of the ceiling is -1: the last row.
    table = np.empty((most + 1, 3), np.uint8)
    table[OBSTACLE:most] = own[np.arange(most - OBSTACLE) % len(own)]
    for number, colour in ROOM.items():
        table[number] = colour
    coloured: NDArray[np.uint8] = table[seen]
    return coloured
