"""Take-off, Hold, Land and Descend.

Source of Descend: PX4 1.16, FlightTaskDescend.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from airl_mav.control.demand import (
    AnyDemand,
    Demand,
)
from airl_mav.core.frames import Vector, quat_yaw
from airl_mav.vehicle.rotation import Vec
from firmware_sim.autopilot.climb import SETTLED_M, ClimbLimits
from firmware_sim.autopilot.error_state import RATES, P, Q, V
from firmware_sim.autopilot.flight_modes import Mode
from firmware_sim.autopilot.modes import interface
from firmware_sim.autopilot.smooth_trajectory import PathLimits, PathSegment, stopping_place, triple
from firmware_sim.engine.record import RISING, SETTLING

LEAST_CLIMB_M = 0.1
"""Minimum height of a take-off above the standing vehicle; below it, the vehicle stays [m]."""


class Takeoff(interface.FlightMode, modes=(Mode.TAKEOFF,)):
    """Take-off mode: climbs to `FlightContext.takeoff_altitude_m`, slowly near the ground."""

    def __init__(self, context: interface.FlightContext, /) -> None:
        self._context = context
        self._place = interface.PositionYaw((0.0, 0.0, 0.0), 0.0)
        self._gently = True
        """True if the take-off started on the ground."""

    @property
    def lifts(self) -> bool:
        """True if the altitude is above the ground."""
        return self._context.takeoff_altitude_m > LEAST_CLIMB_M

    @property
    def is_steady(self) -> bool:
        """True if compiled ticks fly the climb."""
        return self._context.climb.flies

    @property
    def destination(self) -> Vec | None:
        """Take-off altitude above the start, or above the requested place."""
        return self._end

    @property
    def _end(self) -> Vec:
        north, east = self._context.takeoff_place or self._place.position[:2]
        return north, east, self._context.home[2] - self._context.takeoff_altitude_m

    def enter(self, state: Vector, _request: interface.ModeRequest | None, /) -> None:
        """Start the climb at the current position."""
        self._context.climb.restart(max(0.0, -state.item(V + 2)))
        self._place = interface.here(state)
        self._gently = self._context.standing

    def demand(self, state: Vector, time_us: int, /) -> AnyDemand:
        """Return the demand of the climb."""
        if self._context.takeoff_place is not None:
            return self._fly(state, time_us)
        # The trajectory follows the vehicle on the ground: otherwise it would wait below ground
        # during the thrust ramp, or be chased afterwards.
        climb = self._context.climb
        if not self._context.standing:
            aim(self._context)
            climb.fly(RISING, time_us, self._context.height(state))
        return interface.over(self._place, -climb.speed_m_s)

    def _fly(self, state: Vector, time_us: int) -> AnyDemand:
        """Fly to the requested place with a simultaneous climb, as in PX4."""
        context, travel = self._context, self._context.travel
        if context.standing:
            return leave_ground(context, state, time_us)
        limits = travel.limits()
        if self._gently:
            limits = gentle(limits, context, state)
        return travel.fly(state, time_us, PathSegment(self._end), limits=limits)

    def remainder(self, state: Vector, /) -> interface.ModeRequest | None:
        """Return the take-off target for Hold, once near its altitude."""
        if not self.is_done(state):
            return None
        if self._context.takeoff_place is not None:
            return interface.Reposition(interface.PositionYaw(self._end, interface.NAN))
        return interface.ClimbOn(interface.PositionYaw(self._end, self._place.yaw))

    def is_done(self, state: Vector, /) -> bool:
        """Return whether the take-off is near its altitude, within PX4's acceptance radius.

        Source: PX4 1.16, MissionBlock; half the altitude if that is smaller than the radius.
        """
        return self._context.height(state) > _end_m(self._context)


def leave_ground(context: interface.FlightContext, state: Vector, time_us: int) -> Demand:
    """Return the demand on the ground; the trajectory starts at lift-off."""
    context.travel.launch(state, time_us, context.climb.speed_m_s)
    place = interface.here(state)
    north, east, _ = place.position
    return Demand((north, east, interface.NAN), interface.FREE, place.yaw, interface.NAN)


def gentle(limits: PathLimits, context: interface.FlightContext, state: Vector) -> PathLimits:
    """Return the limits of a take-off: near the ground, at most MPC_TKO_SPEED."""
    value = context.value
    if context.over_ground(state) >= value("MPC_LAND_ALT1"):
        return limits
    speed = value("MPC_TKO_SPEED")
    acceleration = min(limits.up_m_s2, speed / max(value("MPC_TKO_RAMP_T"), 1e-3))
    return limits._replace(up_m_s=speed, up_m_s2=acceleration)


def _end_m(context: interface.FlightContext) -> float:
    """Return the height above home at which a take-off counts as near its altitude [m]."""
    altitude, radius = context.takeoff_altitude_m, context.value("NAV_MC_ALT_RAD")
    return altitude - (altitude / 2.0 if altitude < radius else radius)


def aim(context: interface.FlightContext) -> None:
    """Set the climb to the take-off altitude with the limits of PX4's FlightTaskAuto."""
    value = context.value
    jerk, brisk_m_s2 = value("MPC_JERK_AUTO"), value("MPC_ACC_UP_MAX")
    slow = value("MPC_TKO_SPEED")
    gently = min(brisk_m_s2, slow / max(value("MPC_TKO_RAMP_T"), 1e-3))
    context.climb.aim(
        *(context.takeoff_altitude_m, context.home[2], _end_m(context), value("MPC_LAND_ALT1")),
        (
            ClimbLimits(slow, gently, jerk),
            ClimbLimits(value("MPC_Z_V_AUTO_UP"), brisk_m_s2, jerk),
            ClimbLimits(value("MPC_Z_V_AUTO_DN"), value("MPC_ACC_DOWN_MAX"), jerk),
        ),
    )


ABOVE_HOME_M = 0.3
"""Minimum height above home of a setpoint that lifts a standing vehicle [m]."""

STANDING_M_S = 0.3
"""Speed below which a vehicle counts as stopped: Hold and Land then keep the position [m/s]."""


class Hold(interface.FlightMode, modes=(Mode.HOLD,)):
    """Hold mode: brakes, then holds the position of the stop."""

    def __init__(self, context: interface.FlightContext, /) -> None:
        self._context = context
        self._place = interface.PositionYaw((0.0, 0.0, 0.0), 0.0)
        self._braking = False
        self._travelling = False
        self._settling = False
        """True if Hold still climbs to the altitude of an ended take-off."""
        self._rises = False
        """True if an armed vehicle on the ground takes off to a place above it."""

    @property
    def lifts(self) -> bool:
        """True if the place is above the armed vehicle. Source: PX4 1.16, FlightTaskAuto."""
        return self._rises

    @property
    def is_steady(self) -> bool:
        """True if Hold keeps its position, or compiled ticks fly to it."""
        settling = self._settling and not self._context.climb.flies
        return not (self._travelling or settling or self._braking)

    @property
    def destination(self) -> Vec | None:
        """Hold position, once known."""
        return None if self._braking else self._place.position

    def enter(self, state: Vector, request: interface.ModeRequest | None, /) -> None:
        """Start: finish a take-off climb, fly to a place, or brake."""
        self._settling = isinstance(request, interface.ClimbOn)
        self._travelling = isinstance(request, interface.Reposition)
        self._braking = not (self._settling or self._travelling)
        if isinstance(request, interface.ClimbOn):
            self._place = request.place
        elif isinstance(request, interface.Reposition):
            self._go(request, state)
        else:
            self._place = interface.here(state)
        context, down = self._context, self._place.position[2]
        above = down < context.home[2] - ABOVE_HOME_M
        self._rises = self._travelling and above and context.standing and context.armed

    def demand(self, state: Vector, time_us: int, /) -> AnyDemand:
        """Brake first, then hold the position of the stop."""
        if self._rises and self._context.standing:
            return leave_ground(self._context, state, time_us)
        self._rises = False
        if self._travelling:
            place = self._place
            leg = PathSegment(place.position)
            return self._context.travel.fly(state, time_us, leg, yaw=place.yaw)
        if self._settling and not self._context.climb.has_ended:
            return self._settle(time_us)
        if self._settling:
            self._settling = False
            self._context.climb.stop()
        if self._braking:
            self._place = self._place._replace(position=triple(state, P))
            if math.hypot(*triple(state, V)) > STANDING_M_S:
                return Demand(interface.FREE, (0.0, 0.0, 0.0), self._place.yaw, interface.NAN)
            self._braking = False
        return Demand(self._place.position, interface.FREE, self._place.yaw, interface.NAN)

    def _go(self, request: interface.Reposition, state: Vector) -> None:
        """Start the flight to a place; NaN coordinates keep their current value.

        Source: PX4 1.16, Navigator: a new height alone keeps the horizontal position; an empty
        request stops the vehicle.
        """
        place, before = request.place, self._place
        origin = (
            before.position if not self._braking else stopping_place(state, self._context.value)
        )
        now = triple(state, P)
        north, east, down = place.position
        if math.isnan(north) or math.isnan(east):
            north, east = origin[0], origin[1]
        if math.isnan(down):
            down = now[2]
        self._place = interface.PositionYaw((north, east, down), place.yaw)
        if not math.isnan(request.speed_m_s):
            self._context.travel.speed_m_s = request.speed_m_s

    def _settle(self, time_us: int) -> Demand:
        """Return the demand between the end of a take-off and its altitude."""
        context, climb = self._context, self._context.climb
        aim(context)
        climb.fly(SETTLING, time_us)
        north, east, _ = self._place.position
        if abs(context.takeoff_altitude_m - climb.height_m) <= SETTLED_M:
            climb.stop(ended=True)
        return Demand(
            (north, east, context.home[2] - climb.height_m),
            (interface.NAN, interface.NAN, -climb.speed_m_s),
            self._place.yaw,
            interface.NAN,
        )


SLOW_BELOW_M = 0.5
"""Margin below MPC_LAND_ALT2 that exceeds the estimate's error [m]."""


class Land(interface.FlightMode, modes=(Mode.LAND,)):
    """Land mode: descends at the position of the stop, with PX4's decreasing speed."""

    def __init__(self, context: interface.FlightContext, /) -> None:
        self._context = context
        self._place = interface.PositionYaw((0.0, 0.0, 0.0), 0.0)
        self._stopping, self._began = False, (0.0, 0.0)
        self._is_slow = False

    @property
    def is_steady(self) -> bool:
        """True if the vehicle descends to its place at touchdown speed."""
        return self._is_slow and not self._stopping

    @property
    def destination(self) -> Vec | None:
        """Ground below the start of the mode, at home altitude."""
        north, east = self._began
        return north, east, self._context.home[2]

    def enter(self, state: Vector, _request: interface.ModeRequest | None, /) -> None:
        """Start at the current position."""
        self._place, self._stopping = interface.here(state), True
        self._began = self._place.position[:2]

    def demand(self, state: Vector, _time_us: int, /) -> Demand:
        """Stop first, then hold that position; descend at all times."""
        context = self._context
        height_m, ground_m = context.height(state), context.ground_m
        speed = landing_speed(context.value, height_m, ground_m)
        low_m = context.value("MPC_LAND_ALT2") - SLOW_BELOW_M
        self._is_slow = math.isnan(ground_m) and height_m < low_m
        if self._stopping:
            north, east, _ = triple(state, V)
            if math.hypot(north, east) > STANDING_M_S:
                self._place = self._place._replace(position=triple(state, P))
                return Demand(interface.FREE, (0.0, 0.0, speed), self._place.yaw, interface.NAN)
            self._stopping = False
        return interface.over(self._place, speed)


def landing_speed(
    value: Callable[[str], float], height_m: float, ground_m: float = interface.NAN
) -> float:
    """Return the descent speed [m/s]: PX4 slows down linearly between two heights.

    Args:
        value: Look-up for parameters.
        height_m: Height above the landing place.
        ground_m: Height above ground, which takes precedence; NaN = unknown.
    """
    if not math.isnan(ground_m):
        if ground_m <= value("MPC_LAND_ALT3"):
            return value("MPC_LAND_CRWL")
        height_m = ground_m
    low, high = value("MPC_LAND_ALT2"), value("MPC_LAND_ALT1")
    slow, fast = value("MPC_LAND_SPEED"), value("MPC_Z_V_AUTO_DN")
    if height_m <= low:
        return slow
    if height_m >= high:
        return fast
    return slow + (fast - slow) / (high - low) * (height_m - low)


class Descend(interface.FlightMode, modes=(Mode.DESCEND,)):
    """Level descent at MPC_LAND_SPEED with constant heading."""

    def __init__(self, context: interface.FlightContext, /) -> None:
        self._context = context
        self._yaw = 0.0

    def enter(self, state: Vector, _request: interface.ModeRequest | None, /) -> None:
        """Start with the current heading."""
        self._yaw = quat_yaw(state[Q:RATES])

    def demand(self, _state: Vector, _time_us: int, /) -> Demand:
        """Return the descent demand."""
        return Demand(
            interface.FREE,
            (interface.NAN, interface.NAN, self._context.value("MPC_LAND_SPEED")),
            self._yaw,
            interface.NAN,
        )
