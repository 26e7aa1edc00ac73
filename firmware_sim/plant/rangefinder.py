"""Rangefinder with noise and limits, along a ray straight down in body axes."""

from __future__ import annotations

import math

import numpy as np

from airl_mav.arena.geometry import Arena, Bounds
from airl_mav.camera.bvh import meshes_of
from airl_mav.camera.raycast import render_depth
from airl_mav.camera.render import Mount, camera_pose
from airl_mav.core.frames import Vector
from airl_mav.profiles.sensors import Rangefinder
from airl_mav.vehicle.rotation import Vec
from firmware_sim.engine.kinematics import POSITION, QUATERNION
from firmware_sim.interfaces import DistanceReading
from firmware_sim.plant.sensors import Rate, White

_DOWN = -0.5 * math.pi
"""Angle of the ray above the body's forward axis [rad]."""

_FOCAL_PX = 1_000.0
"""Focal length of a one-pixel image: narrow enough to follow a single ray."""

_ENDLESS = Bounds(-1e6, 1e6, -1e6, 1e6, 1.0)
"""Bounds of the floor without an arena."""


class DownwardRay:
    """Ray that finds ground, walls and obstacles, including moving obstacles and meshes."""

    def __init__(self, place: Vec, greatest_m: float, arena: Arena | None) -> None:
        """Mount the ray.

        Args:
            place: Start of the ray relative to the vehicle's centre, FRD [m].
            greatest_m: Maximum range [m].
            arena: Arena; None = an endless floor.
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
        """Return the distance to the nearest surface [m]; None = out of range.

        Args:
            position: (3,) position of the vehicle, NED [m].
            quaternion: (4,) body -> NED.
            elapsed_us: Time since the moving obstacles started [µs].
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


VALID, INVALID = 100, 0
"""Quality of a range within the limits, and of all others [%]."""


class PlantRangefinder:
    """Simulated sensor of the distance to the surface below."""

    def __init__(
        self, profile: Rangefinder, arena: Arena | None, rng: np.random.Generator, times: float
    ) -> None:
        """Initialize the sensor.

        Args:
            profile: Rangefinder profile.
            arena: Arena; None = an endless floor.
            rng: Random generator of this sensor only.
            times: Factor of the noise; does not affect the reported variance.
        """
        self.rate = Rate(profile.rate_hz)
        self._profile = profile
        self._sigma = times * profile.noise_m
        self._white = White(rng, 1)
        place = (profile.forward_m, profile.right_m, profile.down_m)
        self.ray = DownwardRay(place, profile.greatest_m, arena)
        """Ray of the measurement."""

    def read(self, row: Vector, elapsed_us: int) -> DistanceReading:
        """Return a reading in motion (16,), `elapsed_us` [µs] after the obstacles started."""
        profile = self._profile
        true = self.ray.length_m(row[POSITION], row[QUATERNION], elapsed_us)
        white = self._white.draw().item()
        least, greatest = profile.least_m, profile.greatest_m
        # Without an echo, such sensors report their maximum range as invalid.
        told = greatest if true is None else max(0.0, true + self._sigma * white)
        good = true is not None and least <= told <= greatest
        return DistanceReading(
            told, least, greatest, profile.noise_m**2, VALID if good else INVALID
        )
