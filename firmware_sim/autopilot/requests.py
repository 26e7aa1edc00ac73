"""Arguments of mode requests: places, speeds, circles."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

from airl_mav.vehicle.rotation import Vec

NAN = math.nan


class PositionYaw(NamedTuple):
    """Position with a heading."""

    position: Vec
    """Position, local NED [m]."""
    yaw: float
    """Heading [rad]; in some requests NaN = towards the place."""


class ModeRequest:
    """Base class for the arguments of a mode request, one subclass per type."""


@dataclass(frozen=True, slots=True)
class ClimbOn(ModeRequest):
    """Hold: finish the climb of a take-off that has ended near its altitude."""

    place: PositionYaw


@dataclass(frozen=True, slots=True)
class Reposition(ModeRequest):
    """Hold: fly to a place first (MAV_CMD_DO_REPOSITION). NaN on an axis = unchanged."""

    place: PositionYaw
    speed_m_s: float = NAN
    """Speed [m/s]; NaN = unchanged."""
    altitude_alone: bool = False
    """True if only the altitude was requested (MAV_CMD_DO_CHANGE_ALTITUDE)."""


@dataclass(frozen=True, slots=True)
class OrbitRequest(ModeRequest):
    """Orbit: circle parameters (MAV_CMD_DO_ORBIT). NaN = unchanged."""

    centre: Vec = (NAN, NAN, NAN)
    """Centre, local NED [m]."""
    radius_m: float = NAN
    """Radius, positive clockwise, negative counter-clockwise."""
    speed_m_s: float = NAN
    facing: int | None = None
    """ORBIT_YAW_BEHAVIOUR; None = unchanged."""


class LandingTarget(NamedTuple):
    """Target of a precision landing."""

    position: Vec
    """Position, local NED [m]."""
    time_us: int
    """Time of arrival, in simulated time."""


class ObstacleBins(NamedTuple):
    """Distances to the nearest obstacle in bins around the vehicle, as in OBSTACLE_DISTANCE."""

    distances_cm: tuple[int, ...]
    """Distances clockwise; beyond the range: no obstacle; 65535: unknown."""
    increment_deg: float
    """Width of a bin."""
    offset_deg: float
    """Direction of the centre of the first bin."""
    nearest_cm: int
    """Minimum range of the sensor; the maximum follows."""
    farthest_cm: int
    in_world: bool
    """True if directions are relative to north instead of straight ahead."""
    time_us: int
    """Time of arrival, in simulated time."""


class FollowedTarget(NamedTuple):
    """Target of Follow."""

    position: Vec
    """Position, local NED [m]."""
    velocity: Vec
    """Velocity NED [m/s]."""
    time_us: int
    """Time of arrival, in simulated time."""
