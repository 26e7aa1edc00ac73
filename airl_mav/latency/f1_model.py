"""The F-1 model: how fast a vehicle may fly that decides late, sees only so far and brakes evenly.

Krishnan et al., "The Sky Is Not the Limit: A Visual Performance Model for Cyber-Physical Co-Design
in Autonomous Machines", IEEE Computer Architecture Letters 19, 2020, after Liu et al., ICRA 2016;
Air Learning scales its actions by it. Its deceleration is one number. A vehicle that has to tilt
first takes a longer way to stand: `envs.stopping` measures it.
"""

from __future__ import annotations

import math

from airl_mav.core.constants import DEG, GRAVITY_M_S2
from airl_mav.profiles.parameters import flown_values
from airl_mav.profiles.vehicle import VehicleProfile


def f1_velocity(period_s: float, sensing_distance_m: float, max_acceleration_m_s2: float) -> float:
    """Return the greatest speed from which the vehicle stops within what it senses [m/s].

    It flies on for a period T and then brakes. v T + v² / (2 a) = d. So v = a (sqrt(T² + 2 d /
    a) - T). At T = 0 that is the roof, sqrt(2 d a). T is that of sensing, computing and acting, d
    how far ahead an obstacle is taken notice of, a the greatest deceleration.
    """
    a, d = max_acceleration_m_s2, sensing_distance_m
    if not (period_s >= 0.0 and d > 0.0 and a > 0.0):
        raise ValueError(f"period {period_s} s, distance {d} m, acceleration {a} m/s²")
    return a * (math.sqrt(period_s**2 + 2.0 * d / a) - period_s)


def f1_knee_hz(share: float, sensing_distance_m: float, max_acceleration_m_s2: float) -> float:
    """Return the rate of decisions at which the safe velocity is a share q of its roof, 0..1 [Hz].

    From v = q sqrt(2 d a): f = 1 / T = sqrt(a / (2 d)) 2 q / (1 - q²). Beyond it faster decisions
    gain little.
    """
    a, d = max_acceleration_m_s2, sensing_distance_m
    return math.sqrt(a / (2.0 * d)) * 2.0 * share / (1.0 - share**2)


def max_acceleration(vehicle: VehicleProfile) -> float:
    """Return the greatest horizontal acceleration of a vehicle that keeps its height [m/s²].

    The lesser of what the tilt limit of its autopilot permits, g tan(tilt), and what the thrust
    does, sqrt((F / m)² - g²).
    """
    tilt_max_deg = flown_values(vehicle.parameters)["MPC_TILTMAX_AIR"]
    lift = vehicle.thrust_n / vehicle.body.mass_kg
    by_thrust = math.sqrt(lift**2 - GRAVITY_M_S2**2)
    return min(GRAVITY_M_S2 * math.tan(tilt_max_deg * DEG), by_thrust)
