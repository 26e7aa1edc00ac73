"""Interface of a flight mode, the state shared by all modes, and inputs from clients.

Source of the sticks: PX4 1.16, ManualControlSelector.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import Enum, auto
from typing import Any, NamedTuple, Protocol, TypeAlias

from airl_mav.control.demand import AnyDemand, AttitudeDemand, Demand, RateDemand
from airl_mav.core import constants, frames
from airl_mav.vehicle.rotation import Vec
from firmware_sim.autopilot.autopilot_state import Clearance, OperatorText, OrbitStatus, Setpoint
from firmware_sim.autopilot.climb import Climb
from firmware_sim.autopilot.error_state import RATES, P, Q
from firmware_sim.autopilot.flight_modes import Mode
from firmware_sim.autopilot.navigation.plan import Missions
from firmware_sim.autopilot.smooth_trajectory import Travel, triple

NAN: float = math.nan


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


@dataclass(frozen=True, slots=True)
class PrecisionRequest(ModeRequest):
    """Precision Landing: place to look for the target, instead of the current position."""

    place: Vec
    """Place, local NED [m]."""
    required: bool
    """True: search for the target if not visible; False: land without it."""


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


FOLLOWED_S = 0.3
"""Time constant of the rest position's low-pass [s]; a difference from it counts as motion."""


class Sticks(NamedTuple):
    """Stick deflections -1..1."""

    roll: float
    """Positive right."""
    pitch: float
    """Positive forward."""
    throttle: float
    """Positive up; 0 = centre."""
    yaw: float
    """Positive clockwise."""


class Source(Enum):
    """Input device of the sticks."""

    RADIO = auto()
    JOYSTICK = auto()


_ALLOWED = {
    0: (Source.RADIO,),
    1: (Source.JOYSTICK,),
    2: (Source.RADIO, Source.JOYSTICK),
    3: (Source.RADIO, Source.JOYSTICK),
}
"""Allowed sources by COM_RC_IN_MODE; 3 keeps the first source, 4 allows none."""


class ManualControl:
    """Newest sticks of the selected source."""

    def __init__(self, value: Callable[[str], float]) -> None:
        """Store the look-up for PX4 parameters."""
        self._value = value
        self.was_heard = False
        """True if sticks have been received since boot."""
        self._sticks: Sticks | None = None
        self._source: Source | None = None
        self._time_us = 0
        self._rest = Sticks(0.0, 0.0, 0.0, 0.0)

    def offer(self, sticks: Sticks, source: Source, time_us: int) -> bool:
        """Accept sticks from an allowed source; return whether the pilot moves them.

        The threshold is a change of any stick by more than COM_RC_STICK_OV [%].
        """
        mode = int(self._value("COM_RC_IN_MODE"))
        if source not in _ALLOWED.get(mode, ()):
            return False
        fresh = self.sticks(time_us) is not None
        # COM_RC_IN_MODE 3 keeps its first source; others switch after a loss.
        held = fresh or mode == 3
        if held and self._source is not None and source is not self._source:
            return False
        # After a loss, the first sticks are the rest position.
        if not fresh:
            self._rest = sticks
        elapsed_s = (time_us - self._time_us) / constants.US_PER_S
        # Low-pass with the real time between messages.
        weight = min(1.0, elapsed_s / (elapsed_s + FOLLOWED_S)) if elapsed_s > 0.0 else 0.0
        self._rest = Sticks(
            *(r + weight * (s - r) for r, s in zip(self._rest, sticks, strict=True))
        )
        self.was_heard = True
        self._sticks, self._source, self._time_us = sticks, source, time_us
        limit = self._value("COM_RC_STICK_OV") / 100.0
        return any(abs(s - r) > limit for s, r in zip(sticks, self._rest, strict=True))

    def sticks(self, time_us: int) -> Sticks | None:
        """Return the sticks; None before the first and after COM_RC_LOSS_T without input."""
        limit_us = self._value("COM_RC_LOSS_T") * constants.US_PER_S
        if self._sticks is None or time_us - self._time_us > limit_us:
            return None
        return self._sticks


FREE: Vec = (NAN, NAN, NAN)
"""Position or velocity of a demand without commanded axes."""


OffboardSetpoint: TypeAlias = "Setpoint | AttitudeDemand | RateDemand"


@dataclass
class FlightContext:
    """State shared by the modes of one vehicle."""

    value: Callable[[str], float]
    """Look-up for PX4 parameters by name."""
    climb: Climb
    """Vertical trajectory of a take-off, which Hold continues."""
    home: Vec = (0.0, 0.0, 0.0)
    """Home position, local NED [m]."""
    takeoff_altitude_m: float = 0.0
    """Target height of a take-off above home [m]."""
    takeoff_place: tuple[float, float] | None = None
    """Target of a take-off, north and east [m]; None = vertical."""
    say: Callable[[OperatorText], None] = lambda _message: None
    """Sends a text to the operator."""
    home_yaw: float = 0.0
    """Heading at home [rad]."""
    home_amsl_m: float = 0.0
    """Altitude of home above mean sea level [m]."""
    travel: Travel = field(init=False)
    """Trajectories of the automatic modes."""
    setpoint: OffboardSetpoint | None = None
    """Newest offboard setpoint."""
    setpoints: dict[type, OffboardSetpoint] = field(default_factory=dict)
    """Newest offboard setpoint by type."""
    return_place: Callable[[], PositionYaw | None] | None = None
    """Returns Return's destination, or None if it flies mission items. None = home."""
    missions: Missions = field(default_factory=Missions)
    """Missions of Mission mode, and of Return if it flies mission items."""
    armed: bool = False
    """True if armed: a mode selected earlier is only entered."""
    standing: bool = True
    """True if the vehicle is on the ground."""
    sticks: Sticks | None = None
    """Pilot's sticks; None = never received, or lost."""
    target: FollowedTarget | None = None
    """Target of Follow."""
    landing_target: LandingTarget | None = None
    """Target of a precision landing, as last reported."""
    obstacles: ObstacleBins | None = None
    """Obstacles, as last reported."""
    ground: Clearance | None = None
    """Height above ground; None = not measured."""
    orbit: OrbitStatus | None = None
    """Last circle of Orbit."""

    def __post_init__(self) -> None:
        self.travel = Travel(self.value)

    def offer(self, setpoint: OffboardSetpoint) -> None:
        """Store an offboard setpoint."""
        self.setpoint = self.setpoints[type(setpoint)] = setpoint

    def height(self, state: frames.Vector) -> float:
        """Return the height above home [m]."""
        return self.home[2] - state.item(P + 2)

    @property
    def ground_m(self) -> float:
        """Height above ground [m]; NaN = unknown."""
        ground = self.ground
        return NAN if ground is None or not ground.valid else ground.dist_bottom_m

    def over_ground(self, state: frames.Vector) -> float:
        """Return the height above ground [m], or above home if the ground is unknown."""
        ground_m = self.ground_m
        return self.height(state) if math.isnan(ground_m) else ground_m


IMPLEMENTATIONS: dict[Mode, type[FlightMode]] = {}
"""Implementations of the flight modes imported so far."""


class FlightMode(Protocol):
    """Interface of a flight mode, created once per vehicle and entered repeatedly.

    Modes inherit the defaults. `state` is always the estimator's newest nominal state
    (`error_state`).
    """

    def __init_subclass__(cls, modes: tuple[Mode, ...] = (), **options: Any) -> None:
        """Register the class as the implementation of flight modes."""
        super().__init_subclass__(**options)
        IMPLEMENTATIONS.update(dict.fromkeys(modes, cls))

    def __init__(self, context: FlightContext, /) -> None: ...

    @property
    def lifts(self) -> bool:
        """True if an armed vehicle on the ground takes off in this mode."""
        return False

    @property
    def is_steady(self) -> bool:
        """True if the demand is constant until the next setpoint or request."""
        return False

    @property
    def destination(self) -> Vec | None:
        """Destination of an automatic mode, local NED [m]; None in all other modes."""
        return None

    def enter(self, _state: frames.Vector, _request: ModeRequest | None, /) -> None:
        """Start at the current state.

        The request comes from the user, or from the previous mode (its `remainder`). Modes ignore
        requests of other modes.
        """
        return

    def demand(self, state: frames.Vector, time_us: int, /) -> AnyDemand:
        """Return the demand at a time [µs], which increases from call to call."""
        ...

    def remainder(self, _state: frames.Vector, /) -> ModeRequest | None:
        """Return a request for the next mode; None = the next mode starts without."""
        return None

    def is_done(self, _state: frames.Vector, /) -> bool:
        """Return whether the mode has reached its goal, so that another one should follow."""
        return False


def optional_mode(mode: Mode, context: FlightContext) -> FlightMode | None:
    """Return a new mode that may be an add-on; None = not installed."""
    new = IMPLEMENTATIONS.get(mode)
    return None if new is None else new(context)


FALLBACK_DESCENT_M_S = 0.75
"""Descent rate of stick modes without pilot input (measured on PX4 1.16). The vehicle stays level:
drag alone slows it, from 1.0 to 0.3 m/s in 7 s (FlightTaskDescend)."""


def descend(yaw: float) -> Demand:
    """Return the demand of a stick mode without pilot input."""
    return Demand(FREE, (NAN, NAN, FALLBACK_DESCENT_M_S), yaw, NAN)


def since(before_us: int | None, now_us: int) -> float:
    """Return the time since the last tick [s]; 0 at the first."""
    return 0.0 if before_us is None else (now_us - before_us) / constants.US_PER_S


def here(state: frames.Vector) -> PositionYaw:
    """Return the current position and heading."""
    return PositionYaw(triple(state, P), frames.quat_yaw(state[Q:RATES]))


def over(place: PositionYaw, down_m_s: float) -> Demand:
    """Return the demand that holds a place and heading at a vertical speed NED [m/s]."""
    north, east, _ = place.position
    return Demand((north, east, NAN), (NAN, NAN, down_m_s), place.yaw, NAN)
