"""A ray straight down in body axes, against what cameras see of the arena."""

from __future__ import annotations

import math

import numpy as np

from airl_mav.arena.geometry import Arena, Bounds
from airl_mav.camera.bvh import meshes_of
from airl_mav.camera.raycast import render_depth
from airl_mav.camera.render import Mount, camera_pose
from airl_mav.core.frames import Vector
from airl_mav.vehicle.rotation import Vec

_DOWN = -0.5 * math.pi
"""Angle of the ray above the body's forward axis [rad]."""

_FOCAL_PX = 1_000.0
"""Of an image of one pixel: so narrow that next to nothing but the ray is looked at."""

_ENDLESS = Bounds(-1e6, 1e6, -1e6, 1e6, 1.0)
"""The floor where there is no arena."""


class DownwardRay:
    """Finds ground, walls and obstacles, moving ones and meshes among them."""

    def __init__(self, place: Vec, greatest_m: float, arena: Arena | None) -> None:
        """Mount it.

        Args:
            place: Where it begins, from the vehicle's centre, FRD [m].
            greatest_m: How far it reaches [m].
            arena: Where; None = an endless floor.
        """
        self._greatest_m, self._arena = greatest_m, arena
        self._mount = Mount(place, _DOWN)
        self._image = np.empty((1, 1), np.float32)
        bounds = _ENDLESS if arena is None else arena.bounds
        self._bounds = bounds.as_array()
        if arena is None:
            self._shapes = np.zeros(0, np.int8), np.zeros((0, 3)), np.zeros(0)
            self._still = np.zeros((0, 3))
            self._meshes = None
        else:
            bodies = arena.obstacles
            self._shapes = bodies.shape, bodies.half_size, bodies.yaw
            self._still = bodies.center
            self._meshes = meshes_of(arena.meshes, len(bodies), arena.ground, arena.clear)
        # The first ray loads or compiles the kernels: better here than in flight.
        self.length_m(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]), 0)

    def length_m(self, position: Vector, quaternion: Vector, elapsed_us: int) -> float | None:
        """Return how far the next thing is [m]; None: nothing is within reach.

        Args:
            position: (3,) of the vehicle, NED [m].
            quaternion: (4,) body -> NED.
            elapsed_us: Time since moving obstacles set out [µs].
        """
        arena, centers = self._arena, self._still
        if arena is not None and arena.tours:
            centers = arena.centers_at(elapsed_us)
        at, attitude = camera_pose(position, quaternion, self._mount)
        shape, half_size, yaw = self._shapes
        render_depth(
            self._image,
            at,
            attitude,
            _FOCAL_PX,
            0.0,
            0.0,
            False,
            self._greatest_m,
            self._bounds,
            shape,
            centers,
            half_size,
            yaw,
            self._meshes,
            None,
        )
        depth = self._image.item()
        return depth if depth > 0.0 else None
