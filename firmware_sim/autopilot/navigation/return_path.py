"""Height and duration of Return.

Source: PX4 1.16, RTL::calculate_return_alt_from_cone_half_angle, RtlDirect and RtlTimeEstimator.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from airl_mav.core.constants import DEG

_SLOWEST_M_S = 0.1
"""Minimum of every speed, as a parameter may be zero."""


def return_height(value: Callable[[str], float], height_m: float, away_m: float) -> float:
    """Return the height of the return flight above the destination [m].

    Args:
        value: Look-up for PX4 parameters by name.
        height_m: Height of the vehicle above the destination.
        away_m: Horizontal distance of the vehicle from the destination.
    """
    highest, angle, radius = value("RTL_RETURN_ALT"), value("RTL_CONE_ANG"), value("NAV_ACC_RAD")
    if angle <= 0.0:
        return max(height_m, highest)
    if away_m <= radius:
        wanted = 2.0 * away_m
    else:
        wanted = highest
        if away_m <= value("RTL_MIN_DIST"):
            wanted = min(highest, away_m / math.tan(min(89.0, max(1.0, angle)) * DEG))
        wanted = max(wanted, 2.0 * radius)
    return max(height_m, min(wanted, highest))


def return_time_s(value: Callable[[str], float], height_m: float, away_m: float) -> float:
    """Return the duration of Return, with RTL_TIME_FACTOR and RTL_TIME_MARGIN [s].

    As in PX4, the whole descent is at MPC_Z_V_AUTO_DN. For the arguments see `return_height`.
    """
    at = return_height(value, height_m, away_m)
    climb = (at - height_m) / max(value("MPC_Z_V_AUTO_UP"), _SLOWEST_M_S)
    way = away_m / max(value("MPC_XY_CRUISE"), _SLOWEST_M_S)
    wait = max(0.0, value("RTL_LAND_DELAY"))
    descent = max(0.0, at) / max(value("MPC_Z_V_AUTO_DN"), _SLOWEST_M_S)
    took = climb + way + wait + descent
    return value("RTL_TIME_FACTOR") * took + value("RTL_TIME_MARGIN")
