"""Draw what obstacles are: shape, size, heading, height. Where they go is `placement`'s job."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from airl_mav.arena.footprints import Floats, bounding_half
from airl_mav.arena.geometry import Obstacles, Shape
from airl_mav.core.kernels import kernel
from airl_mav.profiles.arena import SPHERE_OFFSET, StaticObstacles

_BOX, _SPHERE = int(Shape.BOX), int(Shape.SPHERE)

NUMBERS = 5
"""Numbers that are drawn for each body."""


@dataclass(frozen=True)
class Bodies:
    """n primitives that have no place yet. Fields as in Obstacles."""

    shape: NDArray[np.int8]  # (n,)
    half_size: Floats  # (n, 3) [m]
    yaw: Floats  # (n,) [rad]
    center_height: Floats  # (n,) above the floor [m]
    bounding_half: Floats  # (n, 2) half extents north, east [m]

    def __len__(self) -> int:
        """Return n."""
        return len(self.shape)

    def at(self, places: Floats) -> Obstacles:
        """Return obstacles that stand at `places` (n, 2) north, east [m]."""
        center = np.empty((len(self), 3))
        center[:, :2], center[:, 2] = places, -self.center_height
        return Obstacles(self.shape, center, self.half_size, self.yaw)


def draw_bodies(
    rng: np.random.Generator, n: int, kind: StaticObstacles, altitude_m: float
) -> Bodies:
    """Draw n bodies, widest first because they are hardest to place; spheres cross `altitude_m`."""
    allowed = _shapes(kind.shapes)
    shape = allowed[rng.integers(len(allowed), size=n)]
    # Drawn here: numba needs longer to take a generator than numpy to draw all of them.
    bodies = bodies_of(rng.random(NUMBERS * n), shape, kind, altitude_m)
    _widest_first(
        bodies.shape, bodies.half_size, bodies.yaw, bodies.center_height, bodies.bounding_half
    )
    return bodies


def bodies_of(
    numbers: Floats, shape: NDArray[np.int8], kind: StaticObstacles, altitude_m: float
) -> Bodies:
    """Return bodies of a shape (n,) as `numbers` (NUMBERS n,) make them; see `_size`."""
    n = len(shape)
    half_size, yaw, center_height = np.empty((n, 3)), np.empty(n), np.empty(n)
    _size(
        numbers, shape, kind.half_width_m, kind.height_m, altitude_m, half_size, yaw, center_height
    )
    half = bounding_half(shape, half_size, yaw)
    return Bodies(shape, half_size, yaw, center_height, half)


@kernel
def _size(
    numbers: Floats,
    shape: NDArray[np.int8],
    half_width_m: tuple[float, float],
    height_m: tuple[float, float],
    altitude_m: float,
    half_size: Floats,
    yaw: Floats,
    center_height: Floats,
) -> None:
    """Write sizes, headings and heights of bodies of a shape (n,), as the fields of `Bodies`.

    Args:
        numbers: (5 n,) uniform in [0, 1): n pairs of half widths, n heights, n headings, n offsets
            of spheres from the flight altitude, scaled as `Generator.uniform` does.
        shape: (n,).
        half_width_m: Range of half widths [m].
        height_m: Range of heights [m].
        altitude_m: Height above the floor that every sphere crosses [m].
        half_size: (n, 3) [m], written.
        yaw: (n,) [rad], written.
        center_height: (n,) above the floor [m], written.
    """
    n, (narrow, wide), (flat, tall) = len(shape), half_width_m, height_m
    for i in range(n):
        radius = narrow + (wide - narrow) * numbers[2 * i]
        half_size[i, 0] = half_size[i, 1] = radius
        half_size[i, 2] = (flat + (tall - flat) * numbers[2 * n + i]) / 2.0
        yaw[i], center_height[i] = 0.0, half_size[i, 2]
        if shape[i] == _BOX:
            half_size[i, 1] = narrow + (wide - narrow) * numbers[2 * i + 1]
            yaw[i] = -math.pi + 2.0 * math.pi * numbers[3 * n + i]
        elif shape[i] == _SPHERE:
            offset = -SPHERE_OFFSET + 2.0 * SPHERE_OFFSET * numbers[4 * n + i]
            half_size[i, 2] = radius
            center_height[i] = max(radius, altitude_m + offset * radius)


@kernel
def _widest_first(
    shape: NDArray[np.int8], half_size: Floats, yaw: Floats, center_height: Floats, half: Floats
) -> None:
    """Sort the fields of `Bodies` stably by their widest side; insertion sort, as they are few."""
    for i in range(1, len(shape)):
        j = i
        while j > 0 and max(half[j, 0], half[j, 1]) > max(half[j - 1, 0], half[j - 1, 1]):
            k = j - 1
            shape[j], shape[k] = shape[k], shape[j]
            yaw[j], yaw[k] = yaw[k], yaw[j]
            center_height[j], center_height[k] = center_height[k], center_height[j]
            for axis in range(3):
                half_size[j, axis], half_size[k, axis] = half_size[k, axis], half_size[j, axis]
            for axis in range(2):
                half[j, axis], half[k, axis] = half[k, axis], half[j, axis]
            j = k


@lru_cache
def _shapes(names: tuple[str, ...]) -> NDArray[np.int8]:
    """Return the numbers of shapes; looking up members by name is slow."""
    return np.array([Shape[name.upper()] for name in names], np.int8)
