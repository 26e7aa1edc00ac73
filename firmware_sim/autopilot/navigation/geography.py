"""Distances on the globe."""

from __future__ import annotations

import math

from airl_mav.core.constants import EARTH_RADIUS_M


def distance_m(a: tuple[float, float], b: tuple[float, float]) -> float:
    """Return the great-circle distance [m] between two places (latitude, longitude) [deg].

    Haversine on a sphere, as PX4's get_distance_to_next_waypoint.
    """
    lat_a, lat_b = math.radians(a[0]), math.radians(b[0])
    half_lat = math.sin(0.5 * (lat_b - lat_a))
    half_lon = math.sin(0.5 * math.radians(b[1] - a[1]))
    h = half_lat * half_lat + half_lon * half_lon * math.cos(lat_a) * math.cos(lat_b)
    return EARTH_RADIUS_M * 2.0 * math.atan2(math.sqrt(h), math.sqrt(max(0.0, 1.0 - h)))
