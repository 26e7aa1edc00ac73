"""F-1 model: safe speed of a vehicle from decision period, sensing range and deceleration.

Krishnan et al., "The Sky Is Not the Limit: A Visual Performance Model for Cyber-Physical Co-Design
in Autonomous Machines", IEEE Computer Architecture Letters 19, 2020, after Liu et al., ICRA 2016;
Air Learning scales its actions by it. The model uses one constant deceleration. A vehicle that must
tilt first needs a longer stopping distance: `envs.stopping` measures it.
"""

from __future__ import annotations

import math

from airl_mav.core.constants import DEG, GRAVITY_M_S2
from airl_mav.profiles.parameters import flown_values
from airl_mav.profiles.vehicle import VehicleProfile


def f1_velocity(period_s: float, sensing_distance_m: float, max_acceleration_m_s2: float) -> float:
    """Return the maximum speed at which the vehicle stops within its sensing range [m/s].

    The vehicle flies on for a period T and then brakes. v T + v² / (2 a) = d, so v = a (sqrt(T² + 2
    d / a) - T). At T = 0 this is the roof, sqrt(2 d a). T is the period of sensing, computing and
    acting, d the range of obstacle detection, a the maximum deceleration.
    """
    a, d = max_acceleration_m_s2, sensing_distance_m
    if not (period_s >= 0.0 and d > 0.0 and a > 0.0):
        raise ValueError(f"period {period_s} s, distance {d} m, acceleration {a} m/s²")
    return a * (math.sqrt(period_s**2 + 2.0 * d / a) - period_s)


def f1_knee_hz(share: float, sensing_distance_m: float, max_acceleration_m_s2: float) -> float:
    """Return the decision rate at which the safe velocity is a share q of its roof, 0..1 [Hz].

    From v = q sqrt(2 d a): f = 1 / T = sqrt(a / (2 d)) 2 q / (1 - q²). Beyond it faster decisions
    gain little.
    """
    a, d = max_acceleration_m_s2, sensing_distance_m
    return math.sqrt(a / (2.0 * d)) * 2.0 * share / (1.0 - share**2)


def max_acceleration(vehicle: VehicleProfile) -> float:
    """Return the maximum horizontal acceleration of a vehicle at constant height [m/s²].

    The minimum of two limits: the autopilot's tilt limit, g tan(tilt), and the thrust, sqrt((F /
    m)² - g²).
    """
    tilt_max_deg = flown_values(vehicle.parameters)["MPC_TILTMAX_AIR"]
    lift = vehicle.thrust_n / vehicle.body.mass_kg
    by_thrust = math.sqrt(lift**2 - GRAVITY_M_S2**2)
    return min(GRAVITY_M_S2 * math.tan(tilt_max_deg * DEG), by_thrust)
