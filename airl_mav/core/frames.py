"""Coordinate frames with all conversions, and goals as positions in them.

The project uses PX4's frames: world NED (north, east, down), body FRD (forward, right, down).
pybullet, ROS and Foxglove use ENU / FLU, and cameras look along +z of an optical frame (right,
down, forward). Quaternions are Hamilton, unit, scalar first [w, x, y, z], and rotate body vectors
into the world: v_ned = R(q) v_frd. Euler angles are the aerospace sequence yaw, pitch, roll (Z-Y-X,
intrinsic).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from airl_mav.core.constants import EARTH_RADIUS_M

Goal = tuple[float, float] | tuple[float, float, float]
"""North and east of the start [m], and down for goals with a height: negative above the start."""


def goal_distance_m(goal: Goal, position: Sequence[float] | NDArray[np.float64]) -> float:
    """Return the distance of a position NED (3,) from a goal [m]; horizontal for a 2D goal."""
    away = math.hypot(position[0] - goal[0], position[1] - goal[1])
    return away if len(goal) == 2 else math.hypot(away, position[2] - goal[2])


def goal_height_m(goal: Goal) -> float | None:
    """Return the height of a goal above the start [m]; None for a 2D goal."""
    return None if len(goal) == 2 else -goal[2]


Vector = NDArray[np.float64]

SQRT_HALF = math.sqrt(0.5)


def wrap_pi(angle: float) -> float:
    """Wrap an angle [rad] into [-pi, pi)."""
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


def ned_to_enu(v: Vector) -> Vector:
    """Swap a world vector (..., 3) between NED and ENU. Its own inverse."""
    return np.stack([v[..., 1], v[..., 0], -v[..., 2]], axis=-1)


def frd_to_flu(v: Vector) -> Vector:
    """Swap a body vector (..., 3) between FRD and FLU. Its own inverse."""
    return np.stack([v[..., 0], -v[..., 1], -v[..., 2]], axis=-1)


def quat_multiply(a: Vector, b: Vector) -> Vector:
    """Return the Hamilton product a ⊗ b of two quaternions (4,), or of n pairs (4, n)."""
    w1, x1, y1, z1 = a
    w2, x2, y2, z2 = b
    return np.array(
        [
            w1 * w2 - x1 * x2 - y1 * y2 - z1 * z2,
            w1 * x2 + x1 * w2 + y1 * z2 - z1 * y2,
            w1 * y2 - x1 * z2 + y1 * w2 + z1 * x2,
            w1 * z2 + x1 * y2 - y1 * x2 + z1 * w2,
        ]
    )


def quat_normalize(q: Vector) -> Vector:
    """Return q (4,) scaled to length 1 with w >= 0. Raises ValueError on a zero quaternion."""
    norm = float(np.linalg.norm(q))
    if norm == 0.0:
        raise ValueError("a zero quaternion does not stand for a rotation")
    return q / (norm if q[0] >= 0.0 else -norm)


def quat_to_matrix(q: Vector) -> Vector:
    """Return the rotation matrix (3, 3) of a unit quaternion (4,): v_world = R v_body."""
    w, x, y, z = q
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def quat_from_euler(roll: float, pitch: float, yaw: float) -> Vector:
    """Return the unit quaternion (4,) of aerospace Euler angles [rad]."""
    cr, sr = math.cos(0.5 * roll), math.sin(0.5 * roll)
    cp, sp = math.cos(0.5 * pitch), math.sin(0.5 * pitch)
    cy, sy = math.cos(0.5 * yaw), math.sin(0.5 * yaw)
    return np.array(
        [
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ]
    )


class Euler(NamedTuple):
    """Aerospace Euler angles [rad]."""

    roll: float
    pitch: float
    yaw: float


def quat_to_euler(q: Vector) -> Euler:
    """Return the aerospace Euler angles of a unit quaternion (4,)."""
    w, x, y, z = (float(c) for c in q)
    roll = math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    pitch = math.asin(min(1.0, max(-1.0, 2.0 * (w * y - z * x))))
    yaw = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return Euler(roll, pitch, yaw)


def quats_to_euler(q: Vector) -> tuple[Vector, Vector, Vector]:
    """Return roll, pitch, yaw, each (...), of unit quaternions (..., 4); as `quat_to_euler`."""
    w, x, y, z = q[..., 0], q[..., 1], q[..., 2], q[..., 3]
    roll = np.arctan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2.0 * (w * y - z * x), -1.0, 1.0))
    yaw = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return roll, pitch, yaw


def down_in_body(roll: Vector, pitch: Vector) -> Vector:
    """Return down (..., 3) in body axes FRD at roll and pitch (...) [rad]."""
    level = np.cos(pitch)
    return np.stack([-np.sin(pitch), np.sin(roll) * level, np.cos(roll) * level], axis=-1)


def quat_yaw(q: Vector) -> float:
    """Return the heading [rad] of a unit quaternion (4,), 0 = north, positive to the east."""
    w, x, y, z = q
    return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


# The quaternion of the axis swap ENU <- NED, as (w, x, y, z): half a turn about (1, 1, 0)/sqrt 2.
_ENU_FROM_NED = np.array([0.0, SQRT_HALF, SQRT_HALF, 0.0])
# FRD <- FLU: half a turn about the forward axis.
_FRD_FROM_FLU = np.array([0.0, 1.0, 0.0, 0.0])


def quat_ned_frd_to_enu_flu(q: Vector) -> Vector:
    """Convert an attitude NED <- FRD (4,) to ENU <- FLU (4,). Its own inverse."""
    return quat_normalize(quat_multiply(quat_multiply(_ENU_FROM_NED, q), _FRD_FROM_FLU))


FRD_FROM_OPTICAL = np.array([0.5, 0.5, 0.5, 0.5])
"""Optical frame of a camera that looks along the body's forward axis, as FRD <- optical."""


def quat_flu_from_optical(pitch_up: float, yaw: float = 0.0) -> Vector:
    """Return FLU <- optical (4,) of a camera, by its angles up and right of forward [rad]."""
    tilt = quat_from_euler(0.0, pitch_up, yaw)
    return quat_normalize(quat_multiply(quat_multiply(_FRD_FROM_FLU, tilt), FRD_FROM_OPTICAL))


def quat_from_direction(direction: Vector) -> Vector:
    """Return an attitude (4,) with its x axis along a direction (3,), level in y.

    Works in any right-handed parent frame with z as the vertical; the direction is normalized.
    """
    x, y, z = (float(part) for part in direction)
    return quat_from_euler(0.0, -math.atan2(z, math.hypot(x, y)), math.atan2(y, x))


def quat_wxyz_to_xyzw(q: Vector) -> tuple[float, float, float, float]:
    """Reorder to pybullet's and scipy's scalar-last quaternion."""
    return float(q[1]), float(q[2]), float(q[3]), float(q[0])


def ned_to_heading(v: Vector, yaw: float | Vector) -> Vector:
    """Rotate world vectors (..., 3) by yaw (...) into the heading frame (forward, right, down).

    The heading frame is MAVLink's BODY_NED. Yaw follows the vehicle, roll and pitch stay level.
    """
    c, s = np.cos(yaw), np.sin(yaw)
    north, east = v[..., 0], v[..., 1]
    return np.stack([c * north + s * east, c * east - s * north, v[..., 2]], axis=-1)


def heading_to_ned(v: Vector, yaw: float | Vector) -> Vector:
    """Rotate heading-frame vectors (..., 3) (forward, right, down) by yaw (...) into NED."""
    c, s = np.cos(yaw), np.sin(yaw)
    forward, right = v[..., 0], v[..., 1]
    return np.stack([c * forward - s * right, s * forward + c * right, v[..., 2]], axis=-1)


class Geodetic(NamedTuple):
    """Geodetic position."""

    latitude_deg: float
    longitude_deg: float
    altitude_m: float
    """Altitude above mean sea level, positive up [m]."""


def local_to_geodetic(ned: Vector, origin: Geodetic) -> Geodetic:
    """Convert a local NED position (3,) [m] to a geodetic position.

    Azimuthal equidistant projection on a sphere, as PX4's MapProjection::reproject (Snyder, Map
    Projections, USGS 1395, eqs. 20-14, 20-15).
    """
    x, y = float(ned[0]) / EARTH_RADIUS_M, float(ned[1]) / EARTH_RADIUS_M
    c = math.hypot(x, y)
    altitude = origin.altitude_m - float(ned[2])
    if c == 0.0:
        return Geodetic(origin.latitude_deg, origin.longitude_deg, altitude)
    lat0 = math.radians(origin.latitude_deg)
    sin_c, cos_c = math.sin(c), math.cos(c)
    lat = math.asin(cos_c * math.sin(lat0) + x * sin_c * math.cos(lat0) / c)
    lon = math.radians(origin.longitude_deg) + math.atan2(
        y * sin_c, c * math.cos(lat0) * cos_c - x * math.sin(lat0) * sin_c
    )
    return Geodetic(math.degrees(lat), math.degrees(lon), altitude)


def geodetic_to_local(point: Geodetic, origin: Geodetic) -> Vector:
    """Convert a geodetic position to local NED (3,) [m]; inverse of `local_to_geodetic`."""
    lat0, lat = math.radians(origin.latitude_deg), math.radians(point.latitude_deg)
    dlon = math.radians(point.longitude_deg - origin.longitude_deg)
    cos_c = math.sin(lat0) * math.sin(lat) + math.cos(lat0) * math.cos(lat) * math.cos(dlon)
    c = math.acos(min(1.0, max(-1.0, cos_c)))
    k = 1.0 if c < 1e-12 else c / math.sin(c)
    north = k * (math.cos(lat0) * math.sin(lat) - math.sin(lat0) * math.cos(lat) * math.cos(dlon))
    east = k * math.cos(lat) * math.sin(dlon)
    down = origin.altitude_m - point.altitude_m
    return np.array([north * EARTH_RADIUS_M, east * EARTH_RADIUS_M, down])


HOME: Final = Geodetic(47.397743, 8.545594, 489.4)
"""Home of PX4 SITL: latitude, longitude [deg], altitude above mean sea level [m]."""

MAGNETIC_FIELD_NED: Final[Vector] = np.array([0.2143, 0.0119, 0.4317])
"""Earth's magnetic field at HOME [gauss]: 0.482 G, inclination 63.6°, declination 3.2°
(World Magnetic Model 2020-2025)."""

MAGNETIC_DECLINATION: Final = float(np.arctan2(MAGNETIC_FIELD_NED[1], MAGNETIC_FIELD_NED[0]))
"""Angle from true to magnetic north at HOME [rad], positive east."""
