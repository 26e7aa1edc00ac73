"""Take-off: climb above the start, or fly to another place."""

from __future__ import annotations

from airl_mav.control.demand import AnyDemand, Demand
from airl_mav.core.frames import Vector
from airl_mav.vehicle.rotation import Vec
from firmware_sim.autopilot.climb import ClimbLimits
from firmware_sim.autopilot.error_state import V
from firmware_sim.autopilot.flight_modes import Mode
from firmware_sim.autopilot.modes.interface import (
    FREE,
    NAN,
    FlightContext,
    FlightMode,
    here,
    over,
)
from firmware_sim.autopilot.requests import ClimbOn, ModeRequest, PositionYaw, Reposition
from firmware_sim.autopilot.smooth_trajectory import PathLimits, PathSegment
from firmware_sim.engine.record import RISING

LEAST_CLIMB_M = 0.1
"""Minimum height of a take-off above the standing vehicle; below it, the vehicle stays [m]."""


class Takeoff(FlightMode, modes=(Mode.TAKEOFF,)):
    """Take-off mode: climbs to `FlightContext.takeoff_altitude_m`, slowly near the ground."""

    def __init__(self, context: FlightContext, /) -> None:
        self._context = context
        self._place = PositionYaw((0.0, 0.0, 0.0), 0.0)
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

    def enter(self, state: Vector, _request: ModeRequest | None, /) -> None:
        """Start the climb at the current position."""
        self._context.climb.restart(max(0.0, -state.item(V + 2)))
        self._place = here(state)
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
        return over(self._place, -climb.speed_m_s)

    def _fly(self, state: Vector, time_us: int) -> AnyDemand:
        """Fly to the requested place with a simultaneous climb, as in PX4."""
        context, travel = self._context, self._context.travel
        if context.standing:
            return leave_ground(context, state, time_us)
        limits = travel.limits()
        if self._gently:
            limits = gentle(limits, context, state)
        return travel.fly(state, time_us, PathSegment(self._end), limits=limits)

    def remainder(self, state: Vector, /) -> ModeRequest | None:
        """Return the take-off target for Hold, once near its altitude."""
        if not self.is_done(state):
            return None
        if self._context.takeoff_place is not None:
            return Reposition(PositionYaw(self._end, NAN))
        return ClimbOn(PositionYaw(self._end, self._place.yaw))

    def is_done(self, state: Vector, /) -> bool:
        """Return whether the take-off is near its altitude, within PX4's acceptance radius.

        Source: PX4 1.16, MissionBlock; half the altitude if that is smaller than the radius.
        """
        return self._context.height(state) > _end_m(self._context)


def leave_ground(context: FlightContext, state: Vector, time_us: int) -> Demand:
    """Return the demand on the ground; the trajectory starts at lift-off."""
    context.travel.launch(state, time_us, context.climb.speed_m_s)
    place = here(state)
    north, east, _ = place.position
    return Demand((north, east, NAN), FREE, place.yaw, NAN)


def gentle(limits: PathLimits, context: FlightContext, state: Vector) -> PathLimits:
    """Return the limits of a take-off: near the ground, at most MPC_TKO_SPEED."""
    value = context.value
    if context.over_ground(state) >= value("MPC_LAND_ALT1"):
        return limits
    speed = value("MPC_TKO_SPEED")
    acceleration = min(limits.up_m_s2, speed / max(value("MPC_TKO_RAMP_T"), 1e-3))
    return limits._replace(up_m_s=speed, up_m_s2=acceleration)


def _end_m(context: FlightContext) -> float:
    """Return the height above home at which a take-off counts as near its altitude [m]."""
    altitude, radius = context.takeoff_altitude_m, context.value("NAV_MC_ALT_RAD")
    return altitude - (altitude / 2.0 if altitude < radius else radius)


def aim(context: FlightContext) -> None:
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
