"""What a flight mode is, and what all modes share."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

from airl_mav.control.cascade import Demand
from airl_mav.core.frames import Vector, quat_yaw
from airl_mav.vehicle.rotation import Vec
from firmware_sim.autopilot.autopilot_state import Setpoint
from firmware_sim.autopilot.climb import Climb
from firmware_sim.autopilot.error_state import RATES, P, Q

NAN = math.nan
FREE: Vec = (NAN, NAN, NAN)
"""Of a demand's position or velocity: no axis is commanded."""


class Place(NamedTuple):
    """A place and the heading that is kept there."""

    position: Vec
    """Local NED [m]."""
    yaw: float
    """Heading [rad]."""


@dataclass
class FlightContext:
    """What the modes of one vehicle share."""

    value: Callable[[str], float]
    """Looks up a PX4 parameter by its name."""
    home: Vec = (0.0, 0.0, 0.0)
    """Local NED [m]."""
    takeoff_altitude_m: float = 0.0
    """Height above home that a take-off climbs to [m]."""
    climb: Climb = field(default_factory=Climb)
    """The vertical trajectory of a take-off, which hold goes on with."""
    setpoint: Setpoint | None = None
    """The newest offboard setpoint."""

    def height(self, state: Vector) -> float:
        """Return the height above home [m]."""
        return self.home[2] - state.item(P + 2)


class FlightMode(Protocol):
    """One flight mode, made once for a vehicle and entered again and again.

    Modes inherit from it what they have nothing to say about. Every `state` is the estimator's
    newest nominal state (`error_state`).
    """

    def __init__(self, context: FlightContext, /) -> None: ...

    @property
    def lifts(self) -> bool:
        """Whether an armed vehicle that stands on the ground takes off in this mode."""
        return False

    def enter(self, state: Vector, destination: Place | None, /) -> None:
        """Begin at the present state.

        `destination` is what the mode before was still on its way to (its `destination`).
        """
        ...

    def demand(self, state: Vector, time_us: int, /) -> Demand:
        """Return what to fly at a time [µs] that rises from call to call."""
        ...

    def destination(self, _state: Vector, /) -> Place | None:
        """Return what the mode after this one goes on to, None = it begins where it is entered."""
        return None

    def is_done(self, _state: Vector, /) -> bool:
        """Return whether the mode has reached its end, and another one should follow."""
        return False


def triple(state: Vector, start: int) -> Vec:
    """Return three consecutive numbers of a state."""
    north, east, down = state[start : start + 3].tolist()
    return north, east, down


def here(state: Vector) -> Place:
    """Return where the vehicle is and where it points."""
    return Place(triple(state, P), quat_yaw(state[Q:RATES]))


def over(place: Place, down_m_s: float) -> Demand:
    """Return the demand that keeps to a place and a heading at a vertical speed NED [m/s]."""
    north, east, _ = place.position
    return Demand((north, east, NAN), (NAN, NAN, down_m_s), place.yaw, NAN)
