"""Return: climb, fly home or to a rally point, optionally wait, land; or fly the mission.

Source: PX4 1.16, RtlDirect, RtlTimeEstimator and RTL::calculate_return_alt_from_cone_half_angle.
The navigator provides the path along the mission.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from enum import Enum, auto

from airl_mav.control.demand import AnyDemand
from airl_mav.core import constants, frames
from airl_mav.vehicle.rotation import Vec
from firmware_sim.autopilot.autopilot_state import OperatorText, Severity
from firmware_sim.autopilot.error_state import P
from firmware_sim.autopilot.events import flight_events as events
from firmware_sim.autopilot.flight_modes import Mode
from firmware_sim.autopilot.modes import automatic, interface
from firmware_sim.autopilot.smooth_trajectory import PathSegment, triple

_REQUIRED = 2
"""RTL_PLD_MD: 1 lands on a target that is visible at once, 2 searches for the target."""


class _Stage(Enum):
    CLIMB = auto()
    GO_HOME = auto()
    DESCEND = auto()
    """Descend to RTL_DESCEND_ALT to wait."""
    WAIT = auto()
    LAND = auto()


class ReturnToLaunch(interface.FlightMode, modes=(Mode.RETURN,)):
    """Return mode: climbs, flies home and lands."""

    def __init__(self, context: interface.FlightContext, /) -> None:
        self._context = context
        self._start = interface.PositionYaw((0.0, 0.0, 0.0), 0.0)
        self._stage = _Stage.CLIMB
        self._waiting_since_us: int | None = None
        self._down = 0.0
        """Height of the flight home, NED [m]."""
        self._home = interface.PositionYaw((0.0, 0.0, 0.0), 0.0)
        self._mission = interface.optional_mode(Mode.MISSION, context)
        self._precision = interface.optional_mode(Mode.PRECISION_LAND, context)
        self._instead: interface.FlightMode | None = None
        """Mode that flies: Mission along mission items, Precision Landing at the end."""

    @property
    def destination(self) -> Vec | None:
        """End of the current stage."""
        if self._instead is not None and self._instead is self._mission:
            return self._mission.destination
        north, east, ground = self._home.position
        if self._stage is _Stage.CLIMB:
            return *self._start.position[:2], self._down
        if self._stage is _Stage.GO_HOME:
            return north, east, self._down
        return north, east, ground if self._stage is _Stage.LAND else self._waiting_down

    def enter(self, state: frames.Vector, _request: interface.ModeRequest | None, /) -> None:
        """Start with the climb, if needed."""
        context = self._context
        home = interface.PositionYaw(context.home, context.home_yaw)
        chosen = home if context.return_place is None else context.return_place()
        self._instead = self._mission if chosen is None else None
        if self._instead is not None:
            self._instead.enter(state, None)
            return
        self._home = chosen or home
        self._start = interface.here(state)
        self._waiting_since_us = None
        height = self._height(state)
        at = return_height(context.value, height, self._away(state))
        self._down = self._home.position[2] - at
        self._stage = _Stage.CLIMB if height < at else _Stage.GO_HOME
        ground = context.home_amsl_m + context.home[2] - self._home.position[2]
        above_sea = math.ceil(ground + at)
        text = f"RTL: start return at {above_sea} m ({math.ceil(at)} m above destination)"
        event = events.RTL_RETURN_AT.event(above_sea, math.ceil(at))
        if context.armed:  # Disarmed, nothing is flown or reported.
            context.say(OperatorText(Severity.INFO, text, event))

    def demand(self, state: frames.Vector, time_us: int, /) -> AnyDemand:
        """Return the demand of the current stage, and advance stages."""
        if self._instead is None:
            self._go_on(state, time_us)
        if self._instead is not None:
            return self._instead.demand(state, time_us)
        (north, east, _), travel = self._home.position, self._context.travel
        if self._stage is _Stage.CLIMB:
            start = self._start
            leg = PathSegment((start.position[0], start.position[1], self._down))
            return travel.fly(state, time_us, leg, yaw=start.yaw)
        if self._stage is _Stage.GO_HOME:
            near = self._away(state) < self._context.value("RTL_MIN_DIST")
            yaw = self._home.yaw if near else math.nan
            return travel.fly(state, time_us, PathSegment((north, east, self._down)), yaw=yaw)
        if self._stage is _Stage.LAND:
            context = self._context
            speed = automatic.landing_speed(context.value, self._height(state), context.ground_m)
            leg = PathSegment((north, east, math.nan), vertical_m_s=speed)
            return travel.fly(state, time_us, leg, yaw=self._home.yaw)
        leg = PathSegment((north, east, self._waiting_down))
        return travel.fly(state, time_us, leg, yaw=self._home.yaw)

    @property
    def _waiting_down(self) -> float:
        """Waiting height before landing, NED [m]."""
        return max(self._down, self._home.position[2] - self._context.value("RTL_DESCEND_ALT"))

    def _go_on(self, state: frames.Vector, time_us: int) -> None:
        """Select the next stage when the current one has ended."""
        value, down = self._context.value, triple(state, P)[2]
        radius = value("NAV_MC_ALT_RAD")
        delay = value("RTL_LAND_DELAY")
        home_reached = self._away(state) < value("NAV_ACC_RAD")
        if self._stage is _Stage.CLIMB and abs(down - self._down) < radius:
            self._stage = _Stage.GO_HOME
        elif self._stage is _Stage.GO_HOME and home_reached and abs(down - self._down) < radius:
            if delay:
                self._stage = _Stage.DESCEND
            else:
                self._land(state)
        elif self._stage is _Stage.DESCEND and abs(down - self._waiting_down) < radius:
            self._stage, self._waiting_since_us = _Stage.WAIT, time_us
            if delay < 0.0:
                self._context.say(OperatorText.of(Severity.INFO, events.RTL_LOITERING))
        elif self._stage is _Stage.WAIT and self._waiting_since_us is not None:
            waited_s = (time_us - self._waiting_since_us) / constants.US_PER_S
            if 0.0 <= delay <= waited_s:
                self._land(state)

    def _land(self, state: frames.Vector) -> None:
        """Land, on a landing target if RTL_PLD_MD requires it."""
        self._stage = _Stage.LAND
        option = round(self._context.value("RTL_PLD_MD"))
        if option > 0 and self._precision is not None:
            north, east, down = *self._home.position[:2], state.item(P + 2)
            request = interface.PrecisionRequest((north, east, down), required=option == _REQUIRED)
            self._precision.enter(state, request)
            self._instead = self._precision
        elif option > 0:
            text = "RTL_PLD_MD has no effect without the add-on extra_modes"
            self._context.say(OperatorText(Severity.CRITICAL, text))
        self._context.say(OperatorText.of(Severity.INFO, events.RTL_LAND))

    def _height(self, state: frames.Vector) -> float:
        """Return the height above the landing place [m]."""
        return self._home.position[2] - state.item(P + 2)

    def _away(self, state: frames.Vector) -> float:
        """Return the horizontal distance from home [m]."""
        (north, east, _), home = triple(state, P), self._home.position
        return math.hypot(north - home[0], east - home[1])


_SLOWEST_M_S = 0.1
"""Minimum of every speed, as a parameter may be zero."""


def return_height(value: Callable[[str], float], height_m: float, away_m: float) -> float:
    """Return the height of the return flight above the destination [m].

    Args:
        value: Look-up for PX4 parameters by name.
        height_m: Height of the vehicle above the destination.
        away_m: Horizontal distance of the vehicle from the destination.
    """
    highest, angle, radius = value("RTL_RETURN_ALT"), value("RTL_CONE_ANG"), value("NAV_ACC_RAD")
    if angle <= 0.0:
        return max(height_m, highest)
    if away_m <= radius:
        target_m = 2.0 * away_m
    else:
        target_m = highest
        if away_m <= value("RTL_MIN_DIST"):
            target_m = min(highest, away_m / math.tan(min(89.0, max(1.0, angle)) * constants.DEG))
        target_m = max(target_m, 2.0 * radius)
    return max(height_m, min(target_m, highest))


def return_time_s(value: Callable[[str], float], height_m: float, away_m: float) -> float:
    """Return the duration of Return, with RTL_TIME_FACTOR and RTL_TIME_MARGIN [s].

    As in PX4, the whole descent is at MPC_Z_V_AUTO_DN. For the arguments see `return_height`.
    """
    at = return_height(value, height_m, away_m)
    climb = (at - height_m) / max(value("MPC_Z_V_AUTO_UP"), _SLOWEST_M_S)
    way = away_m / max(value("MPC_XY_CRUISE"), _SLOWEST_M_S)
    wait = max(0.0, value("RTL_LAND_DELAY"))
    descent = max(0.0, at) / max(value("MPC_Z_V_AUTO_DN"), _SLOWEST_M_S)
    took = climb + way + wait + descent
    return value("RTL_TIME_FACTOR") * took + value("RTL_TIME_MARGIN")
