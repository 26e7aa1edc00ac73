"""PX4's position setpoint triplet: path from a waypoint to the next, and past it."""

from __future__ import annotations

import math
from enum import Enum, auto
from typing import NamedTuple

from airl_mav.vehicle.rotation import Vec


class TripletKind(Enum):
    """Type of a triplet."""

    IDLE = auto()
    """No flight: the vehicle is on the ground."""
    TAKEOFF = auto()
    """Take-off, slow at first."""
    POSITION = auto()
    """Flight to the target, continuing to the next waypoint."""
    LOITER = auto()
    """Flight to the target, with a stay."""
    LAND = auto()
    """Landing."""


class Triplet(NamedTuple):
    """Path of a mission. Places are local NED [m]."""

    kind: TripletKind
    target: Vec
    previous: Vec | None = None
    """Start of the path; None = the vehicle's position."""
    next: Vec | None = None
    """Next waypoint; None = the vehicle stops at the target."""
    yaw: float = math.nan
    """Heading [rad]; NaN = by MPC_YAW_MODE."""
    acceptance_m: float = 0.0
    precision: int = 0
    """Precision landing: 0 = off, 1 = on a target visible at once, 2 = search for the target."""
    cruise_m_s: float = math.nan
    """Cruise speed [m/s]; NaN = MPC_XY_CRUISE."""

    def same_target(self, other: Triplet) -> bool:
        """Return whether both have the same target and attributes."""
        return self._replace(previous=None, next=None) == other._replace(previous=None, next=None)


STANDING = Triplet(TripletKind.IDLE, (0.0, 0.0, 0.0))
"""Triplet without flight."""
