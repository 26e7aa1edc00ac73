"""The vertical trajectory of a take-off.

Source: PX4 1.16, `PositionSmoothing` on the vertical axis (`trajectory`). The jerk limit of the
speed itself is left out: it delays a change of speed by a tenth of a second.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from airl_mav.core.constants import US_PER_S
from firmware_sim.autopilot.trajectory import braking_speed


class ClimbLimits(NamedTuple):
    """Limits of a vertical movement."""

    speed_m_s: float
    acceleration_m_s2: float
    jerk_m_s3: float


def approach_speed(distance_m: float, limits: ClimbLimits) -> float:
    """Return the greatest speed [m/s] that can still be braked within a distance [m] >= 0."""
    speed, acceleration, jerk = limits
    return min(speed, braking_speed(distance_m, acceleration, jerk))


class Climb:
    """A vertical trajectory towards a height. Its speed changes no faster than its limits."""

    def __init__(self) -> None:
        self.height_m = 0.0
        """Present height [m]."""
        self.speed_m_s = 0.0
        """Present vertical speed, upwards positive [m/s]."""
        self._time_us: int | None = None

    def restart(self, speed_m_s: float) -> None:
        """Continue from a vertical speed [m/s]."""
        self.speed_m_s, self._time_us = speed_m_s, None

    def towards(self, height_m: float, limits: ClimbLimits, time_us: int) -> None:
        """Move on to a time [µs], which rises from call to call, on the way to a height [m]."""
        elapsed_s = 0.0 if self._time_us is None else (time_us - self._time_us) / US_PER_S
        self._time_us = time_us
        self.height_m += self.speed_m_s * elapsed_s
        left_m = height_m - self.height_m
        wanted = math.copysign(approach_speed(abs(left_m), limits), left_m)
        most = limits.acceleration_m_s2 * elapsed_s
        self.speed_m_s += min(most, max(-most, wanted - self.speed_m_s))
