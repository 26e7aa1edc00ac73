"""Greedy: a vector-field histogram over the depth image, without memory, map or learning.

After Borenstein and Koren (IEEE Trans. Robotics and Automation 7(3), 1991): it computes the free
distance of a strip as wide as the vehicle for each heading in view. The free heading nearest to the
goal wins.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from airl_mav.policy.actions import Action
from airl_mav.policy.observation import Observation


@dataclass(frozen=True)
class GreedySettings:
    """Settings of the baseline."""

    max_speed_m_s: float = 4.0
    max_yaw_rate_rad_s: float = math.radians(90.0)
    brake_m_s2: float = 2.5
    """Deceleration assumed by the speed limit."""
    half_width_m: float = 0.7
    """Half the vehicle's width plus a margin."""
    band_m: float = 0.6
    """Returns within this height above or below the vehicle are obstacles."""
    stop_distance_m: float = 1.3
    """Minimum distance to returns."""
    free_distance_m: float = 10.0
    """Free distance at which headings count as equally free."""
    period_s: float = 0.5
    """Decision period assumed by the speed limit."""
    turn_gain_1_s: float = 1.2
    """Yaw rate per angle error. Gain times the actual decision period must stay well below 2, or
    the heading oscillates: this gain is stable with decisions 1 s apart."""
    headings: int = 37
    """Number of headings tried across the field of view."""


class GreedyPolicy:
    """Depth-reactive steering towards the goal. Implements `actions.Policy`."""

    def __init__(self, settings: GreedySettings | None = None) -> None:
        self._settings = settings or GreedySettings()
        self.side = 1.0
        """Turn direction if all headings are blocked, 1 = right; kept to avoid oscillation."""

    def act(self, observation: Observation) -> Action:
        """Return the velocity for an observation."""
        s, bearing = self._settings, observation.goal_bearing
        half_fov = 0.5 * observation.intrinsics.horizontal_fov_rad
        if abs(bearing) > half_fov:
            # The goal is out of view: turn towards it on the spot.
            self.side = math.copysign(1.0, bearing)
            return Action(0.0, 0.0, self._turn(bearing))
        points = near_points(observation, s.band_m)
        margin = half_fov / s.headings
        headings = np.linspace(-half_fov + margin, half_fov - margin, s.headings)
        clear = np.array([clearance(points, h, s.half_width_m) for h in headings])
        distance = observation.goal_distance
        # Obstacles behind the goal do not matter.
        needed = min(s.free_distance_m, max(distance, s.stop_distance_m))
        lack = np.maximum(0.0, needed - clear) / needed
        cost = np.abs(headings - bearing) + 4.0 * lack
        best = int(np.argmin(cost))
        if clear[best] <= s.stop_distance_m:
            return Action(0.0, 0.0, self.side * s.max_yaw_rate_rad_s * 0.5)
        heading = float(headings[best])
        if abs(heading) > math.radians(3.0):
            self.side = math.copysign(1.0, heading)
        speed = self._speed(float(clear[best]), distance)
        turn = self._turn(heading)
        # The velocity turns with the nose during the hold: aim so that the mean course is right.
        course = heading - 0.5 * turn * s.period_s
        return Action(speed * math.cos(course), speed * math.sin(course), turn)

    def _turn(self, angle: float) -> float:
        limit = self._settings.max_yaw_rate_rad_s
        return max(-limit, min(limit, self._settings.turn_gain_1_s * angle))

    def _speed(self, free_m: float, goal_m: float) -> float:
        """Return the maximum speed from which the vehicle can stop after another period."""
        s = self._settings
        room = max(0.0, free_m - s.stop_distance_m)
        # v T + v²/2a = room, solved for v
        t, a = s.period_s, s.brake_m_s2
        v = a * (math.sqrt(t * t + 2.0 * room / a) - t)
        return min(s.max_speed_m_s, v, max(0.5, goal_m / (2.0 * t)))


def near_points(observation: Observation, band_m: float) -> NDArray[np.float64]:
    """Return the returns at flight height as points (n, 2), forward and right [m]."""
    points = level_points(observation)
    return points[np.abs(points[:, 2]) < band_m, :2]


def level_points(observation: Observation) -> NDArray[np.float64]:
    """Return the returns as points (n, 3), forward, right and down from the vehicle [m].

    The image is levelled by the vehicle's roll and pitch, so that neither the floor nor the tilt of
    acceleration looks like an obstacle. The camera is assumed at the vehicle's centre, along the
    nose.
    """
    k, depth = observation.intrinsics, observation.depth_m
    seen = depth > 0.0
    v, u = np.nonzero(seen)
    z = depth[seen].astype(np.float64)
    right, down = (u - k.cx) / k.focal * z, (v - k.cy) / k.focal * z
    ahead = z
    if k.model.cylindrical:
        angle = (u - k.cx) / k.focal
        ahead, right = np.cos(angle) * z, np.sin(angle) * z
    elif k.model.tabled:
        ahead, right, down = k.rays[:, v, u] * z
    # Heading frame from body: R_y(pitch) R_x(roll).
    cr, sr = math.cos(observation.roll), math.sin(observation.roll)
    cp, sp = math.cos(observation.pitch), math.sin(observation.pitch)
    level_right = cr * right - sr * down
    tilted_down = sr * right + cr * down
    forward = cp * ahead + sp * tilted_down
    level_down = -sp * ahead + cp * tilted_down
    return np.stack([forward, level_right, level_down], axis=1)


def clearance(points: NDArray[np.float64], heading: float, half_width_m: float) -> float:
    """Return the free distance [m] of a strip of +- half_width_m along a heading [rad]."""
    c, s = math.cos(heading), math.sin(heading)
    along = c * points[:, 0] + s * points[:, 1]
    across = -s * points[:, 0] + c * points[:, 1]
    hit = (np.abs(across) < half_width_m) & (along > 0.0)
    return float(along[hit].min()) if hit.any() else math.inf
