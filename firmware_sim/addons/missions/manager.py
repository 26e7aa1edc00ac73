"""Missions of a vehicle: their executors, Mission mode, and the destination and path of Return.

Source of Return: PX4 1.16, RTL::findRtlDestination, RtlMissionFast, RtlMissionFastReverse and
RtlDirectMissionLand, for a multicopter. They fly only the places of a mission, without waits and
commands. RTL_TYPE = 2 has no destination but a path along the mission.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from enum import IntEnum
from typing import NamedTuple

import numpy as np

from airl_mav.control.demand import AnyDemand
from airl_mav.core.frames import Geodetic, Vector, local_to_geodetic
from airl_mav.vehicle.rotation import Vec
from firmware_sim.addons.missions import executor, feasibility
from firmware_sim.addons.missions.items import (
    STANDING,
    NavCommand,
    PlanFrame,
    Triplet,
    TripletKind,
    go_to,
)
from firmware_sim.autopilot.autopilot_state import OperatorText, Severity
from firmware_sim.autopilot.error_state import P, V
from firmware_sim.autopilot.events.definition import define
from firmware_sim.autopilot.flight_modes import Mode
from firmware_sim.autopilot.modes import automatic, interface, return_to_launch
from firmware_sim.autopilot.navigation import geofence, plan
from firmware_sim.autopilot.smooth_trajectory import PathLimits, PathSegment, triple

_N = NavCommand

RTL_MISSION_LAND = define(
    "rtl_mission_land_climb", "RTL Mission Land: climb to {1m_v}", "int32_t rtl_alt"
)
NAN = math.nan

MOST_ITEMS = 1_000
"""Maximum length of a return path: a mission may jump back 65,535 times."""


def landing_start(items: tuple[plan.PlanItem, ...]) -> int | None:
    """Return the index of the mission's landing: DO_LAND_START, else NAV_LAND.

    None if the mission has no landing.
    """
    landings = [index for index, item in enumerate(items) if item.command == _N.LAND]
    if not landings:
        return None
    starts = [index for index, item in enumerate(items) if item.command == _N.DO_LAND_START]
    # A DO_LAND_START behind the landing does not start it: the earlier of both is used.
    return min([*starts[:1], landings[0]])


def along_mission(
    plans: plan.Plans, home: Geodetic, here: Geodetic, *, flying: bool
) -> tuple[plan.PlanItem, ...]:
    """Return the path of RTL_TYPE 2: on to the mission's landing, else back to its start.

    Args:
        plans: Mission with its active item.
        home: End of a path back.
        here: Position of the vehicle.
        flying: True if the mission is active; False: start at the nearest item.
    """
    items = plans.mission
    index = plans.current if flying else _nearest(items, home, here)
    if index is None:
        return ()
    if landing_start(items) is not None:
        return onwards(plans, index)
    # In flight the active item is not yet reached: the way back begins at the one before.
    return _back(items, index - 1 if flying else index, home)


def onwards(plans: plan.Plans, index: int) -> tuple[plan.PlanItem, ...]:
    """Return the places from an item to the landing, including remaining jumps."""
    remaining = plan.Plans()
    remaining.store(plan.MissionType.MISSION, plans.mission, 0)
    # A copy: the preview of the path must not consume the mission's jumps.
    remaining.jumps_done = dict(plans.jumps_done)
    way: list[plan.PlanItem] = []
    following = go_to(remaining, index)
    # Jumps may form a loop, so the length is limited.
    for _ in range(MOST_ITEMS):
        if following is None:
            break
        item = plans.mission[following]
        if item.command == _N.LAND:
            return (*way, item)
        if item.has_position:
            way.append(_passed(item))
        following = go_to(remaining, following + 1)
    return tuple(way)


def at(command: int, place: Geodetic, altitude_m: float) -> plan.PlanItem:
    """Return an item at a place and an altitude above mean sea level [m]."""
    params = (0.0, 0.0, 0.0, NAN)
    return plan.PlanItem(
        command, PlanFrame.GLOBAL, params, place.latitude_deg, place.longitude_deg, altitude_m
    )


def _back(
    items: tuple[plan.PlanItem, ...], index: int, home: Geodetic
) -> tuple[plan.PlanItem, ...]:
    """Return the places from an item back to the take-off, then the landing at home."""
    way: list[plan.PlanItem] = []
    for item in reversed(items[: max(index, 0) + 1]):
        if item.has_position:
            way.append(_passed(item))
        if item.command == _N.TAKEOFF:
            break
    return (*way, at(_N.LAND, home, home.altitude_m))


def _passed(item: plan.PlanItem) -> plan.PlanItem:
    """Return an item as a waypoint without a stay; LOITER_TO_ALT is unchanged."""
    _, radius, passing, heading = item.params
    # Its altitude change is part of the path and must not be skipped.
    if item.command == _N.LOITER_TO_ALT:
        return replace(item, autocontinue=True)
    # Parameter 2 is an acceptance radius only for waypoints; 0 selects the default.
    own = radius if item.command == _N.WAYPOINT else 0.0
    return replace(
        item, command=_N.WAYPOINT, params=(0.0, own, passing, heading), autocontinue=True
    )


def _nearest(items: tuple[plan.PlanItem, ...], home: Geodetic, here: Geodetic) -> int | None:
    """Return the item with the nearest place in 3D; None = no places."""

    def away(index: int) -> float:
        place = items[index].place(home.altitude_m)
        height = place.altitude_m - here.altitude_m
        return math.hypot(plan.distance_m(place[:2], here[:2]), height)

    places = [index for index, item in enumerate(items) if item.has_position]
    return min(places, key=away, default=None)


NEARER_M = 2.0
"""Minimum advantage in distance to prefer a place over another [m]."""

OF_HOME_M = 10.0
"""Distance to home within which rally points are ignored [m]."""


class ReturnType(IntEnum):
    """Values of RTL_TYPE."""

    HOME_OR_RALLY = 0
    NOT_HOME = 1
    """Landing of the mission or a rally point; home if there is neither."""
    MISSION = 2
    """Along the mission to its landing; without a landing, back along the mission to home."""
    NEAREST = 3
    """Home, landing of the mission, or a rally point."""


class Destination(NamedTuple):
    """Destination of Return."""

    place: Geodetic
    """Place at ground altitude."""
    by_landing: bool = False
    """True if the destination is the mission's landing, flown from its first item."""


def destination(
    plans: plan.Plans, home: Geodetic, here: Geodetic, kind: int, *, valid: bool = True
) -> Destination:
    """Return the destination of Return.

    Args:
        plans: Rally points and mission.
        home: Home at ground altitude; the result is also at ground altitude.
        here: Position of the vehicle.
        kind: RTL_TYPE; undefined values count as 0.
        valid: True if the mission is feasible; if not, its landing is ignored.
    """

    def away(place: Geodetic) -> float:
        return plan.distance_m(place[:2], here[:2])

    best = Destination(home)
    # Any other place is nearer than infinity, so home is used only without one.
    nearest = math.inf if kind == ReturnType.NOT_HOME else away(home)
    candidates: list[Destination] = []
    if kind in (ReturnType.NOT_HOME, ReturnType.NEAREST) and valid:
        landings = [item for item in plans.mission if item.command == NavCommand.LAND]
        places = [item.place(home.altitude_m) for item in landings[:1]]
        candidates += [Destination(place, by_landing=True) for place in places]
    rally = [
        item.place(home.altitude_m)
        for item in plans.stored(plan.MissionType.RALLY).items
        if item.command == NavCommand.RALLY_POINT
    ]
    # A rally point at home is no alternative to home.
    far = [place for place in rally if plan.distance_m(place[:2], home[:2]) > OF_HOME_M]
    for candidate in [*candidates, *map(Destination, far)]:
        # The margin prevents a change of destination by noise.
        if away(candidate.place) + NEARER_M < nearest:
            best, nearest = candidate, away(candidate.place)
    return best


class MissionManager(plan.Missions):
    """Executors of Mission and of Return along mission items; `triplet` is the active path."""

    def __init__(
        self,
        plans: plan.Plans,
        value: Callable[[str], float],
        crew: plan.Crew,
        fence: geofence.FenceMonitor,
    ) -> None:
        """Store the plans, the look-up for PX4 parameters, the callbacks and the geofence."""
        self._plans, self._value, self._crew, self._fence = plans, value, crew, fence
        self.executor = executor.MissionExecutor(plans, value, crew, self._check)
        """Mission executor, which also holds region of interest and speed."""
        self._way_home = plan.Plans()
        """Mission items flown by Return."""
        self._returning = executor.MissionExecutor(
            self._way_home, value, crew, self._check_way_home, climbs_first=False
        )
        self._home_by_mission = False
        """True if Return flies mission items now."""
        self._returned = False
        """True if the path of the current return has been selected."""
        self._flying = False

    @property
    def triplet(self) -> Triplet:
        """Active waypoints in Mission or Return mode."""
        if self._home_by_mission:
            return self._returning.triplet
        return self.executor.triplet if self._flying else STANDING

    @property
    def valid(self) -> bool:
        """True if a feasible mission is stored."""
        return self._plans.valid

    @property
    def over(self) -> bool:
        """True if the active mission has ended."""
        return self._flying and self._plans.finished

    def review(self, now: plan.NavigationState, /) -> None:
        """Check the mission after a change of mission, fence or home."""
        self.executor.review(now)

    def look_at(self, place: Geodetic | None, /) -> None:
        """Set the region of interest; None = clear it."""
        self.executor.roi.look_at(place)

    def destination(self, now: plan.NavigationState, /) -> Geodetic | None:
        """Return the destination of Return by RTL_TYPE; None = along mission items."""
        if self._return_type is ReturnType.MISSION:
            return None
        goal = self._goal(now)
        return None if goal.by_landing else goal.place

    def step(self, now: plan.NavigationState, mode: Mode, /, *, armed: bool) -> None:
        """Advance by a period of the navigator."""
        flying = armed and mode is Mode.MISSION
        # Return goes first: it needs to know whether the mission was active until now.
        self._step_home(now, returning=armed and mode is Mode.RETURN)
        if flying and not self._flying:
            self.executor.activate(now)
        elif self._flying and not flying:
            self.executor.deactivate()
        elif flying:
            self.executor.update(now)
        else:
            self.executor.idle(now, armed=armed)
        self._flying = flying

    def _step_home(self, now: plan.NavigationState, *, returning: bool) -> None:
        """Advance Return along the mission, if it flies mission items."""
        if not returning:
            if self._home_by_mission:
                self._returning.deactivate()
            self._home_by_mission = self._returned = False
        elif self._home_by_mission:
            self._returning.update(now)
        elif not self._returned:
            # The path is selected once, at the start of the mode.
            self._returned = True
            if self.destination(now) is None:
                self._plan_way_home(now, flying=self._flying)
                self._home_by_mission = True
                self._returning.activate(now)

    @property
    def _return_type(self) -> ReturnType:
        number = round(self._value("RTL_TYPE"))
        # Parameters accept any number: undefined ones count as 0.
        return ReturnType(number) if number in set(ReturnType) else ReturnType.HOME_OR_RALLY

    def _goal(self, now: plan.NavigationState) -> Destination:
        here = local_to_geodetic(np.array(now.position), now.origin)
        return destination(self._plans, now.home, here, self._return_type, valid=self.valid)

    def _plan_way_home(self, now: plan.NavigationState, *, flying: bool) -> None:
        """Store the items for Return; `flying`: a mission was active until now."""
        here = local_to_geodetic(np.array(now.position), now.origin)
        if self._return_type is not ReturnType.MISSION:
            way = self._way_to_landing(now, here)
        elif self.valid:
            way = along_mission(self._plans, now.home, here, flying=flying)
        else:
            way = ()
        # Stored as a mission of its own: the uploaded mission keeps its active item.
        self._way_home.store(plan.MissionType.MISSION, way, 0, 0)

    def _way_to_landing(
        self, now: plan.NavigationState, here: Geodetic
    ) -> tuple[plan.PlanItem, ...]:
        """Return the climb and the complete landing of the mission."""
        begin = landing_start(self._plans.mission)
        if begin is None:
            return ()
        ground = self._goal(now).place
        away = plan.distance_m(ground[:2], here[:2])
        above = return_to_launch.return_height(
            self._value, here.altitude_m - ground.altitude_m, away
        )
        landing = onwards(self._plans, begin)
        altitude = ground.altitude_m + above
        # Above the return altitude already: no climb.
        if altitude <= here.altitude_m:
            return landing
        text = f"RTL Mission land: climb to {math.ceil(altitude)} m"
        # Rounded up, as the operator compares the text with a minimum altitude.
        event = RTL_MISSION_LAND.event(math.ceil(altitude))
        self._crew.say(OperatorText(Severity.INFO, text, event))
        return (at(_N.WAYPOINT, here, altitude), *landing)

    def _check_way_home(self, _now: plan.NavigationState) -> feasibility.FeasibilityResult:
        return feasibility.FeasibilityResult(bool(self._way_home.mission), ())

    def _check(self, now: plan.NavigationState) -> feasibility.FeasibilityResult:
        return feasibility.check(
            self._plans.mission,
            now.home,
            self._value,
            landed=now.landed,
            inside_fence=lambda place: self._fence.inside(place, now.home),
        )


_TAKEOFF, _LAND, _IDLE = TripletKind.TAKEOFF, TripletKind.LAND, TripletKind.IDLE

_REQUIRED = 2
"""PRECISION_LAND_MODE: search for the target."""

_MOVES_M_S = 0.5
"""Minimum speed to turn the nose along the path [m/s] (MPC_YAW_MODE = 3)."""


class MissionMode(interface.FlightMode, modes=(Mode.MISSION,)):
    """Mission mode: follows the triplets of missions with PX4's speeds at and between waypoints."""

    def __init__(self, context: interface.FlightContext, /) -> None:
        self._context = context
        self._triplet: Triplet | None = None
        self._precision = interface.optional_mode(Mode.PRECISION_LAND, context)
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

    def enter(self, _state: Vector, _request: interface.ModeRequest | None, /) -> None:
        """Start; the executor supplies the waypoints."""
        self._triplet, self._lands_precisely = None, False

    def demand(self, state: Vector, time_us: int, /) -> AnyDemand:
        """Return the demand for the active waypoints."""
        context = self._context
        triplet, position, travel = self._path, triple(state, P), context.travel
        if context.standing:
            # The trajectory starts at the vehicle's position at lift-off.
            return automatic.leave_ground(context, state, time_us)
        if triplet is not self._triplet:
            # A speed that the operator changed since then is kept while the mission's speed is
            # unchanged.
            if self._triplet is None or triplet.cruise_m_s != self._triplet.cruise_m_s:
                travel.speed_m_s = triplet.cruise_m_s
            self._triplet = triplet
            # Reported once per triplet; the landing continues without the target.
            if triplet.precision and self._precision is None:
                text = "Precision landing is not available without the add-on extra_modes"
                context.say(OperatorText(Severity.CRITICAL, text))
        if triplet.precision and self._precision is not None:
            # The search starts once, at the current height above the item's place.
            if not self._lands_precisely:
                self._lands_precisely = True
                north, east, down = *triplet.target[:2], position[2]
                required = triplet.precision == _REQUIRED
                self._precision.enter(
                    state, interface.PrecisionRequest((north, east, down), required)
                )
            return self._precision.demand(state, time_us)
        self._lands_precisely = False
        yaw = triplet.yaw if math.isfinite(triplet.yaw) else self._heading(state)
        leg, limits = _leg(triplet, position), self._limits(state)
        if triplet.kind is _LAND:
            speed = automatic.landing_speed(context.value, context.height(state), context.ground_m)
            north, east, _ = triplet.target
            # The ground's height is unknown: descend at a speed until the land detector acts.
            leg = PathSegment((north, east, math.nan), vertical_m_s=speed)
        return travel.fly(state, time_us, leg, yaw=yaw, limits=limits)

    def is_done(self, _state: Vector, /) -> bool:
        """Return whether the mission has ended."""
        return self._context.missions.over

    def _limits(self, state: Vector) -> PathLimits:
        triplet = self._path
        limits = self._context.travel.limits()._replace(acceptance_m=triplet.acceptance_m)
        return (
            automatic.gentle(limits, self._context, state) if triplet.kind is _TAKEOFF else limits
        )

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
        # Near home the direction to it is undefined.
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
    # Waypoints at the same place have no line.
    if length < 1e-6:
        return direct
    unit = [c / length for c in line]
    along = math.fsum(u * (p - s) for u, p, s in zip(unit, position, start, strict=True))
    # Past the waypoint: fly back to it directly, not along the extended line.
    if along > length:
        return PathSegment(target, position, triplet.next)
    # Before the start of the line: fly to the start first.
    if along < 0.0 and math.dist(start, position) > triplet.acceptance_m:
        return PathSegment(start, position, target)
    north, east, down = (s + u * along for s, u in zip(start, unit, strict=True))
    if math.dist((north, east, down), position) > triplet.acceptance_m:
        return PathSegment((north, east, down), position, target)
    return direct
