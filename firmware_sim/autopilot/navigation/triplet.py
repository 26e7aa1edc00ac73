"""PX4's position setpoint triplet: the way from a waypoint to the next, and past it."""

from __future__ import annotations

import math
from enum import Enum, auto
from typing import NamedTuple

from airl_mav.vehicle.rotation import Vec


class TripletKind(Enum):
    """Manner in which a triplet is flown."""

    IDLE = auto()
    """Not at all: the vehicle stands."""
    TAKEOFF = auto()
    """From the ground, gently at first."""
    POSITION = auto()
    """To the target, and on to the next one."""
    LOITER = auto()
    """To the target, to stay there."""
    LAND = auto()
    """Down to the ground."""


class Triplet(NamedTuple):
    """What a mission gives to be flown. Places are local NED [m]."""

    kind: TripletKind
    target: Vec
    previous: Vec | None = None
    """Where the way begins; None = wherever the vehicle is."""
    next: Vec | None = None
    """Where it goes on; None = the vehicle stops at the target."""
    yaw: float = math.nan
    """Heading [rad]; NaN = by MPC_YAW_MODE."""
    acceptance_m: float = 0.0
    precision: int = 0
    """Of a landing: 1 onto a landing target that is seen at once, 2 also onto one that is not."""
    cruise_m_s: float = math.nan
    """NaN = MPC_XY_CRUISE."""

    def same_target(self, other: Triplet) -> bool:
        """Return whether both lead to the same place in the same way."""
        return self._replace(previous=None, next=None) == other._replace(previous=None, next=None)


STANDING = Triplet(TripletKind.IDLE, (0.0, 0.0, 0.0))
"""Nothing is to be flown."""
