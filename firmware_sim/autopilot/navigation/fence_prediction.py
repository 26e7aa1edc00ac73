"""Where the geofence looks with GF_PREDICT: as far ahead as the vehicle needs to come to a stand.

Source: PX4 1.16, GeofenceBreachAvoidance (multirotor). Pure.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from airl_mav.core.frames import Geodetic, local_to_geodetic
from airl_mav.vehicle.rotation import Vec
from firmware_sim.autopilot.trajectory import Axis

PERIOD_S = 0.2
"""Between two looks at the fence: so long the vehicle may have flown on [s]."""


def point_ahead(place: Geodetic, velocity: Vec, value: Callable[[str], float]) -> Geodetic:
    """Return the place that must be within the fence: where braking from a velocity would end.

    Args:
        place: Where the vehicle is.
        velocity: NED [m/s].
        value: Looks up a PX4 parameter by its name.
    """
    north, east, down = velocity
    speed, jerk = math.hypot(north, east), value("MPC_JERK_AUTO")
    most = max(value("MPC_ACC_HOR"), value("MPC_ACC_HOR_MAX"))
    ahead_m = braking_distance(speed, value("MPC_ACC_HOR"), most, jerk)
    share = ahead_m / speed if speed > 0.0 else 0.0
    upward, downward = value("MPC_ACC_UP_MAX"), value("MPC_ACC_DOWN_MAX")
    limit = downward if down < 0.0 else upward  # a climb is ended by accelerating down
    below_m = math.copysign(braking_distance(abs(down), limit, max(upward, downward), jerk), down)
    offset = np.array([north * share, east * share, below_m if down else 0.0])
    return local_to_geodetic(offset, place)


def braking_distance(speed: float, limit: float, most: float, jerk: float) -> float:
    """Return how far a vehicle flies until it stands, and between two looks at the fence [m].

    PX4 takes the vehicle to accelerate as much as it may when it begins to brake.

    Args:
        speed: At which it flies [m/s].
        limit: Of the deceleration [m/s²].
        most: Of the acceleration when braking begins [m/s²].
        jerk: Limit of the jerk, > 0 [m/s³].
    """
    axis = Axis()
    axis.restart(0.0, speed)
    axis.acceleration = most
    axis.plan(0.0, limit, jerk)
    axis.advance(axis.duration_s)
    return axis.position + PERIOD_S * speed
