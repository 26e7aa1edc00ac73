"""What modes are asked for beyond their names: places, speeds, circles."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

from airl_mav.vehicle.rotation import Vec

NAN = math.nan


class Place(NamedTuple):
    """A place and the heading that is kept there."""

    position: Vec
    """Local NED [m]."""
    yaw: float
    """Heading [rad]; where a request allows it, NaN = towards the place."""


class Request:
    """What a mode is entered with, beyond its name: the base of such data, one class a kind."""


@dataclass(frozen=True, slots=True)
class ClimbOn(Request):
    """Hold: climb the rest of a take-off that has ended near its altitude."""

    place: Place


@dataclass(frozen=True, slots=True)
class Reposition(Request):
    """Hold: go to a place first (MAV_CMD_DO_REPOSITION). NaN on an axis = stay there."""

    place: Place
    speed_m_s: float = NAN
    """NaN = as fast as before."""
    altitude_alone: bool = False
    """Whether that is all that was asked for (MAV_CMD_DO_CHANGE_ALTITUDE)."""


@dataclass(frozen=True, slots=True)
class OrbitRequest(Request):
    """Orbit: the circle (MAV_CMD_DO_ORBIT). NaN = as it is."""

    centre: Vec = (NAN, NAN, NAN)
    """Local NED [m]."""
    radius_m: float = NAN
    """Positive clockwise, negative counter-clockwise."""
    speed_m_s: float = NAN
    facing: int | None = None
    """ORBIT_YAW_BEHAVIOUR; None = as it is."""


class LandingTarget(NamedTuple):
    """Target of a precision landing."""

    position: Vec
    """Local NED [m]."""
    time_us: int
    """When it was heard, in simulated time."""


class Obstacles(NamedTuple):
    """How far the nearest obstacle is in bins around the vehicle, as OBSTACLE_DISTANCE has it."""

    distances_cm: tuple[int, ...]
    """Clockwise; beyond the range: none there; 65535: not known."""
    increment_deg: float
    """Width of a bin."""
    offset_deg: float
    """Direction of the middle of the first."""
    nearest_cm: int
    """Range of the sensor."""
    farthest_cm: int
    in_world: bool
    """Whether directions are counted from north, not from straight ahead."""
    time_us: int
    """When it was heard, in simulated time."""


class FollowedTarget(NamedTuple):
    """Target of Follow."""

    position: Vec
    """Local NED [m]."""
    velocity: Vec
    """NED [m/s]."""
    time_us: int
    """When it was heard, in simulated time."""
