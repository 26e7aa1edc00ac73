"""The safe velocity: how fast a vehicle may fly that decides late and sees only so far."""

from __future__ import annotations

import math

from airl_mav.core.constants import DEG, GRAVITY_M_S2
from airl_mav.profiles.parameters import parameter_values
from airl_mav.profiles.vehicle import VehicleProfile


def safe_velocity(
    latency_s: float, sensing_distance_m: float, max_acceleration_m_s2: float
) -> float:
    """Return the greatest speed from which the vehicle stops within what it senses [m/s].

    It flies on for the latency and then brakes: v T + v² / (2 a) = d, so that
    v = a (sqrt(T² + 2 d / a) - T). The F-1 model (Krishnan et al., The Sky Is Not the Limit, IEEE
    Computer Architecture Letters 19, 2020, after Liu et al., ICRA 2016), which Air Learning scales
    its actions by.

    Args:
        latency_s: T, from sensing to acting, >= 0 [s].
        sensing_distance_m: d, how far ahead an obstacle is taken notice of, > 0 [m].
        max_acceleration_m_s2: a, greatest deceleration, > 0 [m/s²].

    Raises:
        ValueError: An argument is out of range.
    """
    a, d = max_acceleration_m_s2, sensing_distance_m
    if not (latency_s >= 0.0 and d > 0.0 and a > 0.0):
        raise ValueError(f"latency {latency_s} s, distance {d} m, acceleration {a} m/s²")
    return a * (math.sqrt(latency_s**2 + 2.0 * d / a) - latency_s)


def max_acceleration(vehicle: VehicleProfile) -> float:
    """Return the greatest horizontal acceleration of a vehicle that keeps its height [m/s²].

    The lesser of what the tilt limit of its autopilot permits, g tan(tilt), and what the thrust
    does, sqrt((F / m)² - g²).
    """
    tilt_max_deg = parameter_values(vehicle.parameters)["MPC_TILTMAX_AIR"]
    lift = vehicle.thrust_n / vehicle.body.mass_kg
    by_thrust = math.sqrt(lift**2 - GRAVITY_M_S2**2)
    return min(GRAVITY_M_S2 * math.tan(tilt_max_deg * DEG), by_thrust)
