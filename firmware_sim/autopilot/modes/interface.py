"""The interface of a flight mode, and the state that all modes share."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol, TypeAlias

from airl_mav.control.demand import AnyDemand, AttitudeDemand, Demand, RateDemand
from airl_mav.core.constants import US_PER_S
from airl_mav.core.frames import Vector, quat_yaw
from airl_mav.vehicle.rotation import Vec
from firmware_sim.autopilot.autopilot_state import Clearance, Message, OrbitStatus, Setpoint
from firmware_sim.autopilot.climb import Climb
from firmware_sim.autopilot.error_state import RATES, P, Q
from firmware_sim.autopilot.manual_control import Sticks
from firmware_sim.autopilot.navigation.triplet import STANDING, Triplet
from firmware_sim.autopilot.requests import FollowedTarget, LandingTarget, Obstacles, Place, Request
from firmware_sim.autopilot.travel import Travel

NAN = math.nan
FREE: Vec = (NAN, NAN, NAN)
"""Of a demand's position or velocity: no axis is commanded."""


OffboardSetpoint: TypeAlias = "Setpoint | AttitudeDemand | RateDemand"


@dataclass
class FlightContext:
    """What the modes of one vehicle share."""

    value: Callable[[str], float]
    """Looks up a PX4 parameter by its name."""
    climb: Climb
    """The vertical trajectory of a take-off, which hold goes on with."""
    home: Vec = (0.0, 0.0, 0.0)
    """Local NED [m]."""
    takeoff_altitude_m: float = 0.0
    """Height above home that a take-off climbs to [m]."""
    takeoff_place: tuple[float, float] | None = None
    """Where it leads, north and east [m]; None = straight up."""
    say: Callable[[Message], None] = lambda _message: None
    """Tells the operators something."""
    home_yaw: float = 0.0
    """Heading at home [rad]."""
    home_amsl_m: float = 0.0
    """Altitude of home above mean sea level [m]."""
    travel: Travel = field(init=False)
    """How the automatic modes move."""
    setpoint: OffboardSetpoint | None = None
    """The newest offboard setpoint."""
    setpoints: dict[type, OffboardSetpoint] = field(default_factory=dict)
    """The newest of each kind."""
    return_place: Callable[[], Place | None] | None = None
    """Chooses where Return goes; returns None where it flies items of the mission. None = home."""
    triplet: Triplet = STANDING
    """What Mission mode flies, and Return where it flies items of the mission."""
    mission_over: bool = False
    """Whether the mission has come to its end."""
    armed: bool = False
    """Whether the motors may turn: a mode that is chosen before is only entered."""
    standing: bool = True
    """Whether the vehicle stands on the ground."""
    sticks: Sticks | None = None
    """The pilot's sticks; None = there are none, or they are lost."""
    target: FollowedTarget | None = None
    """What Follow follows."""
    landing_target: LandingTarget | None = None
    """What a precision landing lands on, as it was reported last."""
    obstacles: Obstacles | None = None
    """Where obstacles are, as was told last."""
    ground: Clearance | None = None
    """How far the ground is below; None = nothing tells it."""
    orbit: OrbitStatus | None = None
    """The circle that was flown last."""

    def __post_init__(self) -> None:
        self.travel = Travel(self.value)

    def offer(self, setpoint: OffboardSetpoint) -> None:
        """Take an offboard setpoint."""
        self.setpoint = self.setpoints[type(setpoint)] = setpoint

    def height(self, state: Vector) -> float:
        """Return the height above home [m]."""
        return self.home[2] - state.item(P + 2)

    @property
    def ground_m(self) -> float:
        """How far the ground is below [m]; NaN = not known."""
        ground = self.ground
        return NAN if ground is None or not ground.valid else ground.dist_bottom_m

    def over_ground(self, state: Vector) -> float:
        """Return the height above ground [m], above home where the ground is not known."""
        ground_m = self.ground_m
        return self.height(state) if math.isnan(ground_m) else ground_m


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

    @property
    def is_steady(self) -> bool:
        """Whether the demand stays the same until another setpoint or request arrives."""
        return False

    @property
    def destination(self) -> Vec | None:
        """Where an automatic mode is going, local NED [m]; None in all other modes."""
        return None

    def enter(self, _state: Vector, _request: Request | None, /) -> None:
        """Begin at the present state.

        The request is the user's, or what the mode before leaves to this one (its `remainder`). A
        mode ignores those that are not for it.
        """
        return

    def demand(self, state: Vector, time_us: int, /) -> AnyDemand:
        """Return what to fly at a time [µs] that rises from call to call."""
        ...

    def remainder(self, _state: Vector, /) -> Request | None:
        """Return what is left to the mode after this one; None = it begins where it is entered."""
        return None

    def is_done(self, _state: Vector, /) -> bool:
        """Return whether the mode has reached its end, and another one should follow."""
        return False


FALLBACK_DESCENT_M_S = 0.75
"""Descent of modes that need a pilot's input and have none (measured on PX4 1.16). The vehicle
stays level: drag alone slows it, from 1.0 to 0.3 m/s in 7 s (FlightTaskDescend)."""


def descend(yaw: float) -> Demand:
    """Return the demand of a mode without the pilot's input that it needs."""
    return Demand(FREE, (NAN, NAN, FALLBACK_DESCENT_M_S), yaw, NAN)


def since(before_us: int | None, now_us: int) -> float:
    """Return the time since the last tick [s]; 0 at the first."""
    return 0.0 if before_us is None else (now_us - before_us) / US_PER_S


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
