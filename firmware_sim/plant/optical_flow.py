"""Optical flow sensor: motion of the ground in the image of a downward camera."""

from __future__ import annotations

import math

import numpy as np

from airl_mav.arena.geometry import Arena
from airl_mav.core.frames import Vector
from airl_mav.core.kernels import kernel
from airl_mav.profiles.sensors import OpticalFlow
from airl_mav.vehicle.rotation import conjugate, rotate
from firmware_sim.engine.kinematics import POSITION, QUATERNION, quaternion, rates, velocity
from firmware_sim.interfaces import FlowReading
from firmware_sim.plant.rangefinder import DownwardRay
from firmware_sim.plant.sensors import Rate, White

BEST, INVALID = 255, 0
"""Quality of a measurement within the limits, and of all others."""

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
        turned = np.full(3, math.nan)
        if now_m is None or before_m is None or min(now_m, before_m) < profile.least_m:
            return FlowReading(np.zeros(2), passed_s, INVALID, turned)
        # Over a few hundredths of a second, the distance changes linearly.
        mean_m = 0.5 * (now_m + before_m)
        flow = np.array([turn_x - way_y / mean_m, turn_y + way_x / mean_m])
        if math.hypot(*flow.tolist()) > profile.greatest_rad_s * passed_s:
            return FlowReading(np.zeros(2), passed_s, INVALID, turned)
        return FlowReading(flow + self._sigma * passed_s * white, passed_s, BEST, turned)
