"""Simulations of rangefinder and optical flow sensor, which look down, and of external vision."""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from airl_mav.arena.geometry import Arena, Bounds
from airl_mav.camera.bvh import meshes_of
from airl_mav.camera.projection import LensConstants, Scene
from airl_mav.camera.raycast import render_depth
from airl_mav.camera.render import Mount, camera_pose, scene_of
from airl_mav.core.constants import US_PER_S
from airl_mav.core.frames import Vector
from airl_mav.core.kernels import kernel
from airl_mav.profiles.vehicle import OpticalFlow, Rangefinder, Vision
from airl_mav.vehicle import rotation
from firmware_sim.engine.dynamics import POSITION, QUATERNION, VELOCITY, quaternion, rates, velocity
from firmware_sim.interfaces import DistanceReading, FlowReading, Odometry
from firmware_sim.plant.sensors import SimulatedSensor, Site

_DOWN = -0.5 * math.pi
"""Angle of the ray above the body's forward axis [rad]."""

_FOCAL_PX = 1_000.0
"""Focal length of a one-pixel image: narrow enough to follow a single ray."""

_ENDLESS = Bounds(-1e6, 1e6, -1e6, 1e6, 1.0)
"""Bounds of the floor without an arena."""


class DownwardRay:
    """Ray that finds ground, walls and obstacles, including moving obstacles and meshes."""

    def __init__(self, place: rotation.Vec, greatest_m: float, arena: Arena | None) -> None:
        """Mount the ray at a place in the vehicle, FRD [m], with a maximum range [m]."""
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

        The vehicle is at a position (3,) NED [m] in an attitude (4,) body -> NED; the moving
        obstacles started `elapsed_us` [µs] ago.
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


def _place_of(profile: Rangefinder | OpticalFlow) -> rotation.Vec:
    return profile.forward_m, profile.right_m, profile.down_m


class PlantRangefinder(SimulatedSensor):
    """Sensor of the distance to the surface below (`profiles.vehicle.Rangefinder`)."""

    def __init__(self, profile: Rangefinder, site: Site) -> None:
        super().__init__(profile, site)
        self.ray = DownwardRay(_place_of(profile), profile.greatest_m, site.arena)
        """Ray of the measurement."""

    def read(self, row: Vector, elapsed_us: int) -> DistanceReading:
        """Return a range; see `SimulatedSensor`."""
        profile = self.profile
        true = self.ray.length_m(row[POSITION], row[QUATERNION], elapsed_us)
        noise_m = self.site.times * profile.noise_m * self.white().item()
        least, greatest = profile.least_m, profile.greatest_m
        # Without an echo, such sensors report their maximum range as invalid.
        told = greatest if true is None else max(0.0, true + noise_m)
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
    """Add a tick that ends in motion `row` (16,) to the sums (5,) of a sensor at a place (3,)."""
    # Flow is measured in body axes, at the sensor's place: v + w x r.
    v, w = rotation.rotate(rotation.conjugate(quaternion(row)), velocity(row)), rates(row)
    since[_TURN_X] += w[0] * tick_s
    since[_TURN_Y] += w[1] * tick_s
    since[_WAY_X] += (v[0] + w[1] * place[2] - w[2] * place[1]) * tick_s
    since[_WAY_Y] += (v[1] + w[2] * place[0] - w[0] * place[2]) * tick_s
    since[_TIME] += tick_s


class PlantOpticalFlow(SimulatedSensor):
    """Sensor of the flow straight below, where the surface is assumed level."""

    noises = 2

    def __init__(self, profile: OpticalFlow, site: Site) -> None:
        super().__init__(profile, site)
        self._place = np.array(_place_of(profile))
        self._ray = DownwardRay(_place_of(profile), profile.greatest_m, site.arena)
        self._since = np.zeros(_SIZE)
        self._before_m: float | None = None
        """Ground distance at the last measurement [m]; None = out of range."""

    def sense(self, time_us: int, row: Vector, elapsed_us: int) -> FlowReading | None:
        """Integrate the flow of every tick; see `SimulatedSensor`."""
        self.pass_tick(row)
        return self.read(row, elapsed_us) if self.due(time_us) else None

    def pass_tick(self, row: Vector) -> None:
        """Add a tick that ends in motion (16,)."""
        _pass(row, self._place, self.site.tick_s, self._since)

    def read(self, row: Vector, elapsed_us: int) -> FlowReading:
        """Return the flow since the last reading; see `SimulatedSensor`."""
        profile, white = self.profile, self.white()
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
        sigma = self.site.times * profile.noise_rad_s
        return FlowReading(flow + sigma * passed_s * white, passed_s, BEST, turned)


class PlantVision(SimulatedSensor):
    """Visual-inertial odometry: a pose in the start frame, with drift and latency."""

    noises = 13

    def __init__(self, profile: Vision, site: Site) -> None:
        super().__init__(profile, site)
        self._start: tuple[Vector, rotation.Quat] | None = None
        """Position, and the level frame with the vehicle's heading, at the first pose."""
        self._last = np.zeros(3)
        self._drift = np.zeros(3)
        """Drift of the position, in the frame [m]."""
        self._turned = 0.0
        """Drift of the frame's heading [rad]."""
        self._late: deque[tuple[float, Odometry]] = deque()
        """Poses with their delivery times [µs], oldest first."""

    def sense(self, time_us: int, row: Vector, elapsed_us: int) -> Odometry | None:
        """Return the pose that is due after its latency; see `SimulatedSensor`."""
        if self.due(time_us):
            delivered_us = time_us + self.profile.delay_s * US_PER_S
            self._late.append((delivered_us, self.read(row, elapsed_us)))
        return self._late.popleft()[1] if self._late and self._late[0][0] <= time_us else None

    def read(self, row: Vector, elapsed_us: int) -> Odometry:
        """Return a pose without latency; see `SimulatedSensor`."""
        del elapsed_us
        profile, white, times = self.profile, self.white(), self.site.times
        place, velocity, attitude = row[POSITION], row[VELOCITY], quaternion(row)
        if self._start is None:
            yaw = 0.5 * rotation.yaw_of(attitude)
            self._start = place.copy(), (math.cos(yaw), 0.0, 0.0, math.sin(yaw))
            self._last = place.copy()
        start, frame = self._start
        # Drift grows with the square root of the way: independent steps per metre.
        way = float(np.linalg.norm(place - self._last))
        self._last = place.copy()
        self._drift += times * profile.position_drift_m_sqrt_m * math.sqrt(way) * white[0:3]
        period_s = 1.0 / profile.rate_hz
        # Heading drift grows with the square root of time.
        walk = times * profile.yaw_drift_rad_sqrt_s * math.sqrt(period_s)
        self._turned += walk * white.item(3)
        half = 0.5 * self._turned
        # From NED into the drifted start frame.
        into = rotation.multiply(
            (math.cos(half), 0.0, 0.0, math.sin(half)), rotation.conjugate(frame)
        )
        seen = rotation.rotate(into, tuple(place - start))
        moving = rotation.rotate(into, tuple(velocity))
        # Attitude noise is a small rotation.
        error = rotation.exponential(tuple(times * profile.angle_noise_rad * white[4:7]))
        return Odometry(
            np.array(seen) + self._drift + times * profile.position_noise_m * white[7:10],
            np.array(moving) + times * profile.velocity_noise_m_s * white[10:13],
            np.array(rotation.multiply(rotation.multiply(into, attitude), error)),
            "frd",
            "frd",
            # Reported variances are the profile's, without the factor `times`.
            np.full(3, profile.position_noise_m**2),
            np.full(3, profile.velocity_noise_m_s**2),
            np.full(3, profile.angle_noise_rad**2),
        )
