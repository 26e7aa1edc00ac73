"""Draw what obstacles are: shape, size, heading, height. Where they go is `placement`'s job."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from airl_mav.arena.footprints import Floats, bounding_half
from airl_mav.arena.geometry import Obstacles, Shape
from airl_mav.profiles.arena import SPHERE_OFFSET, StaticObstacles


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
        center = np.column_stack([places, -self.center_height])
        return Obstacles(self.shape, center, self.half_size, self.yaw)


def draw_bodies(
    rng: np.random.Generator, n: int, kind: StaticObstacles, altitude_m: float
) -> Bodies:
    """Draw n bodies of a kind, the widest first: big ones are harder to place later.

    Every sphere crosses the height `altitude_m` above the floor [m].
    """
    allowed = _shapes(kind.shapes)
    shape = allowed[rng.integers(len(allowed), size=n)]
    width = rng.uniform(*kind.half_width_m, size=(n, 2))
    height = rng.uniform(*kind.height_m, size=n)
    yaw = rng.uniform(-math.pi, math.pi, size=n)
    offset = rng.uniform(-SPHERE_OFFSET, SPHERE_OFFSET, size=n)

    radius = width[:, 0]
    is_box, is_sphere = shape == Shape.BOX, shape == Shape.SPHERE
    half_size = np.column_stack(
        [radius, np.where(is_box, width[:, 1], radius), np.where(is_sphere, radius, height / 2.0)]
    )
    yaw = np.where(is_box, yaw, 0.0)
    hung = np.maximum(radius, altitude_m + offset * radius)
    center_height = np.where(is_sphere, hung, height / 2.0)
    half = bounding_half(shape, half_size, yaw)

    order = np.argsort(-half.max(axis=1), kind="stable")
    return Bodies(shape[order], half_size[order], yaw[order], center_height[order], half[order])


@lru_cache
def _shapes(names: tuple[str, ...]) -> NDArray[np.int8]:
    """Return the numbers of shapes; looking up members by name is slow."""
    return np.array([Shape[name.upper()] for name in names], np.int8)
