"""Rangefinder and optical flow sensor. Both look down."""

from __future__ import annotations

import math

import numpy as np

from airl_mav.arena.geometry import Arena, Bounds
from airl_mav.camera.bvh import meshes_of
from airl_mav.camera.projection import LensConstants, Scene
from airl_mav.camera.raycast import render_depth
from airl_mav.camera.render import Mount, camera_pose, scene_of
from airl_mav.core.frames import Vector
from airl_mav.core.kernels import kernel
from airl_mav.profiles.vehicle import OpticalFlow, Rangefinder
from airl_mav.vehicle.rotation import Vec, conjugate, rotate
from firmware_sim.engine.dynamics import POSITION, QUATERNION, quaternion, rates, velocity
from firmware_sim.interfaces import DistanceReading, FlowReading
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
        self._arena, self._mount = arena, Mount(place, _DOWN)
        self._lens = LensConstants(_FOCAL_PX, 0.0, 0.0, greatest_m)
        self._image = np.empty((1, 1), np.float32)
        if arena is None:
            none = np.zeros((0, 3))
            self._scene = Scene(_ENDLESS.as_array(), np.zeros(0, np.int8), none, none, np.zeros(0))
            self._meshes = None
        else:
            bodies = arena.obstacles
            self._scene = scene_of(arena, bodies.center)
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
        arena, scene = self._arena, self._scene
        if arena is not None and arena.tours:
            scene = scene._replace(center=arena.centers_at(elapsed_us))
        at, attitude = camera_pose(position, quaternion, self._mount)
        # One pixel of the depth camera is the ray.
        render_depth(self._image, at, attitude, self._lens, scene, self._meshes)
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


BEST = 255
"""Quality of a measurement within the limits."""

# Sums between two measurements: body rotation about x and y [rad], sensor displacement along x and
# y [m], and time [s].
_TURN_X, _TURN_Y, _WAY_X, _WAY_Y, _TIME, _SIZE = 0, 1, 2, 3, 4, 5


@kernel
def _pass(row: Vector, place: Vector, tick_s: float, since: Vector) -> None:
    """Add a tick to the sums.

    Args:
        row: (16,) motion of the vehicle at its end.
        place: (3,) position of the sensor, FRD [m].
        tick_s: Length of the tick [s].
        since: (5,) sums since the last measurement, updated.
    """
    # Flow is measured in body axes, at the sensor's place: v + w x r.
    v, w = rotate(conjugate(quaternion(row)), velocity(row)), rates(row)
    since[_TURN_X] += w[0] * tick_s
    since[_TURN_Y] += w[1] * tick_s
    since[_WAY_X] += (v[0] + w[1] * place[2] - w[2] * place[1]) * tick_s
    since[_WAY_Y] += (v[1] + w[2] * place[0] - w[0] * place[2]) * tick_s
    since[_TIME] += tick_s


class PlantOpticalFlow:
    """Simulated sensor of the flow straight below, where the surface is assumed level."""

    def __init__(
        self,
        profile: OpticalFlow,
        arena: Arena | None,
        rng: np.random.Generator,
        times: float,
        tick_s: float,
    ) -> None:
        """Initialize the sensor.

        Args:
            profile: Optical flow profile.
            arena: Arena; None = an endless floor.
            rng: Random generator of this sensor only.
            times: Factor of the noise.
            tick_s: Length of a tick [s].
        """
        self.rate = Rate(profile.rate_hz)
        self._profile, self._tick_s = profile, tick_s
        self._sigma = times * profile.noise_rad_s
        self._white = White(rng, 2)
        place = (profile.forward_m, profile.right_m, profile.down_m)
        self._place = np.array(place)
        self._ray = DownwardRay(place, profile.greatest_m, arena)
        self._since = np.zeros(_SIZE)
        self._before_m: float | None = None
        """Ground distance at the last measurement [m]; None = out of range."""

    def pass_tick(self, row: Vector) -> None:
        """Add a tick that ends in motion (16,)."""
        _pass(row, self._place, self._tick_s, self._since)

    def read(self, row: Vector, elapsed_us: int) -> FlowReading:
        """Return a reading in motion (16,), `elapsed_us` [µs] after the obstacles started."""
        profile, white = self._profile, self._white.draw()
        turn_x, turn_y, way_x, way_y, passed_s = self._since.tolist()
        self._since[:] = 0.0
        now_m = self._ray.length_m(row[POSITION], row[QUATERNION], elapsed_us)
        before_m, self._before_m = self._before_m, now_m
        # The sensor lacks a gyro: the estimator uses the vehicle's.
        turned = np.full(3, math.nan)
        if now_m is None or before_m is None or min(now_m, before_m) < profile.least_m:
            return FlowReading(np.zeros(2), passed_s, INVALID, turned)
        # Over a few hundredths of a second, the distance changes linearly.
        mean_m = 0.5 * (now_m + before_m)
        # Rotation plus translation over distance, with the signs of the sensor.
        flow = np.array([turn_x - way_y / mean_m, turn_y + way_x / mean_m])
        if math.hypot(*flow.tolist()) > profile.greatest_rad_s * passed_s:
            return FlowReading(np.zeros(2), passed_s, INVALID, turned)
        return FlowReading(flow + self._sigma * passed_s * white, passed_s, BEST, turned)
