"""Mission: flies the waypoints of the mission executor."""

from __future__ import annotations

import math

from airl_mav.control.demand import AnyDemand
from airl_mav.core.frames import Vector
from airl_mav.vehicle.rotation import Vec
from firmware_sim.addons.missions.items import STANDING, Triplet, TripletKind
from firmware_sim.addons.missions.manager import MissionManager
from firmware_sim.autopilot.autopilot_state import OperatorText, Severity
from firmware_sim.autopilot.error_state import P, V
from firmware_sim.autopilot.flight_modes import Mode
from firmware_sim.autopilot.inputs import ModeRequest, PrecisionRequest
from firmware_sim.autopilot.modes.automatic import gentle, landing_speed, leave_ground
from firmware_sim.autopilot.modes.interface import FlightContext, FlightMode, optional_mode
from firmware_sim.autopilot.smooth_trajectory import PathLimits, PathSegment, triple

_TAKEOFF, _LAND, _IDLE = TripletKind.TAKEOFF, TripletKind.LAND, TripletKind.IDLE

_REQUIRED = 2
"""PRECISION_LAND_MODE: search for the target."""

_MOVES_M_S = 0.5
"""Minimum speed to turn the nose along the path [m/s] (MPC_YAW_MODE = 3)."""


class Mission(FlightMode, modes=(Mode.MISSION,)):
    """Mission mode: follows the triplets of missions with PX4's speeds at and between waypoints."""

    def __init__(self, context: FlightContext, /) -> None:
        self._context = context
        self._triplet: Triplet | None = None
        self._precision = optional_mode(Mode.PRECISION_LAND, context)
        self._lands_precisely = False

    @property
    def _path(self) -> Triplet:
        missions = self._context.missions
        return missions.triplet if isinstance(missions, MissionManager) else STANDING

    @property
    def lifts(self) -> bool:
        """True if the mission leaves the ground."""
        return self._path.kind not in (_IDLE, _LAND)

    @property
    def destination(self) -> Vec | None:
        """Position of the active item."""
        return self._path.target

    def enter(self, _state: Vector, _request: ModeRequest | None, /) -> None:
        """Start; the executor supplies the waypoints."""
        self._triplet, self._lands_precisely = None, False

    def demand(self, state: Vector, time_us: int, /) -> AnyDemand:
        """Return the demand for the active waypoints."""
        context = self._context
        triplet, position, travel = self._path, triple(state, P), context.travel
        if context.standing:
            # The trajectory starts at the vehicle's position at lift-off.
            return leave_ground(context, state, time_us)
        if triplet is not self._triplet:
            if self._triplet is None or triplet.cruise_m_s != self._triplet.cruise_m_s:
                travel.speed_m_s = triplet.cruise_m_s
            self._triplet = triplet
            if triplet.precision and self._precision is None:
                text = "Precision landing is not available without the add-on extra_modes"
                context.say(OperatorText(Severity.CRITICAL, text))
        if triplet.precision and self._precision is not None:
            if not self._lands_precisely:
                self._lands_precisely = True
                north, east, down = *triplet.target[:2], position[2]
                required = triplet.precision == _REQUIRED
                self._precision.enter(state, PrecisionRequest((north, east, down), required))
            return self._precision.demand(state, time_us)
        self._lands_precisely = False
        yaw = triplet.yaw if math.isfinite(triplet.yaw) else self._heading(state)
        leg, limits = _leg(triplet, position), self._limits(state)
        if triplet.kind is _LAND:
            speed = landing_speed(context.value, context.height(state), context.ground_m)
            north, east, _ = triplet.target
            leg = PathSegment((north, east, math.nan), vertical_m_s=speed)
        return travel.fly(state, time_us, leg, yaw=yaw, limits=limits)

    def is_done(self, _state: Vector, /) -> bool:
        """Return whether the mission has ended."""
        return self._context.missions.over

    def _limits(self, state: Vector) -> PathLimits:
        triplet = self._path
        limits = self._context.travel.limits()._replace(acceptance_m=triplet.acceptance_m)
        return gentle(limits, self._context, state) if triplet.kind is _TAKEOFF else limits

    def _heading(self, state: Vector) -> float:
        """Return the heading by MPC_YAW_MODE; NaN = towards the waypoint, unchanged near it."""
        mode, home = round(self._context.value("MPC_YAW_MODE")), self._context.home
        if mode == 3:
            north, east, _ = triple(state, V)
            return math.atan2(east, north) if math.hypot(north, east) > _MOVES_M_S else math.nan
        if mode not in (1, 2):
            return math.nan
        position = triple(state, P)
        north, east = home[0] - position[0], home[1] - position[1]
        if math.hypot(north, east) < self._path.acceptance_m:
            return math.nan
        return math.atan2(east, north) if mode == 1 else math.atan2(-east, -north)


def _leg(triplet: Triplet, position: Vec) -> PathSegment:
    """Return the leg to fly; off its line, the vehicle returns to the line first.

    Source: PX4 1.16, FlightTaskAuto::_getCurrentState, _updateInternalWaypoints.
    """
    start, target = triplet.previous, triplet.target
    direct = PathSegment(target, start, triplet.next)
    if start is None:
        return direct
    line = [b - a for a, b in zip(start, target, strict=True)]
    length = math.hypot(*line)
    if length < 1e-6:
        return direct
    unit = [c / length for c in line]
    along = math.fsum(u * (p - s) for u, p, s in zip(unit, position, start, strict=True))
    if along > length:
        return PathSegment(target, position, triplet.next)
    if along < 0.0 and math.dist(start, position) > triplet.acceptance_m:
        return PathSegment(start, position, target)
    north, east, down = (s + u * along for s, u in zip(start, unit, strict=True))
    if math.dist((north, east, down), position) > triplet.acceptance_m:
        return PathSegment((north, east, down), position, target)
    return direct
