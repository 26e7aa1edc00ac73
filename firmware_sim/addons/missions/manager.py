"""Missions of a vehicle: Mission mode's executor, and the destination and path of Return.

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

from airl_mav.core.frames import Geodetic, local_to_geodetic
from firmware_sim.addons.missions.executor import MissionExecutor
from firmware_sim.addons.missions.feasibility import FeasibilityResult, check
from firmware_sim.addons.missions.items import STANDING, NavCommand, PlanFrame, Triplet, go_to
from firmware_sim.autopilot.autopilot_state import OperatorText, Severity
from firmware_sim.autopilot.events.definition import define
from firmware_sim.autopilot.flight_modes import Mode
from firmware_sim.autopilot.modes.return_to_launch import return_height
from firmware_sim.autopilot.navigation.fence import FenceMonitor
from firmware_sim.autopilot.navigation.plan import (
    Crew,
    Missions,
    MissionType,
    NavigationState,
    PlanItem,
    Plans,
    distance_m,
)

_N = NavCommand

RTL_MISSION_LAND = define(
    "rtl_mission_land_climb", "RTL Mission Land: climb to {1m_v}", "int32_t rtl_alt"
)
NAN = math.nan

MOST_ITEMS = 1_000
"""Maximum length of a return path: a mission may jump back 65,535 times."""


def landing_start(items: tuple[PlanItem, ...]) -> int | None:
    """Return the index of the mission's landing: DO_LAND_START, else NAV_LAND.

    None if the mission has no landing.
    """
    landings = [index for index, item in enumerate(items) if item.command == _N.LAND]
    if not landings:
        return None
    starts = [index for index, item in enumerate(items) if item.command == _N.DO_LAND_START]
    return min([*starts[:1], landings[0]])


def along_mission(
    plans: Plans, home: Geodetic, here: Geodetic, *, flying: bool
) -> tuple[PlanItem, ...]:
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
    return _back(items, index - 1 if flying else index, home)


def onwards(plans: Plans, index: int) -> tuple[PlanItem, ...]:
    """Return the places from an item to the landing, including remaining jumps."""
    remaining = Plans()
    remaining.store(MissionType.MISSION, plans.mission, 0)
    remaining.jumps_done = dict(plans.jumps_done)
    way: list[PlanItem] = []
    following = go_to(remaining, index)
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


def climb(here: Geodetic, altitude_m: float) -> PlanItem:
    """Return an item for a climb at a place to an altitude above mean sea level [m]."""
    params = (0.0, 0.0, 0.0, NAN)
    return PlanItem(
        _N.WAYPOINT, PlanFrame.GLOBAL, params, here.latitude_deg, here.longitude_deg, altitude_m
    )


def _back(items: tuple[PlanItem, ...], index: int, home: Geodetic) -> tuple[PlanItem, ...]:
    """Return the places from an item back to the take-off, then the landing at home."""
    way: list[PlanItem] = []
    for item in reversed(items[: max(index, 0) + 1]):
        if item.has_position:
            way.append(_passed(item))
        if item.command == _N.TAKEOFF:
            break
    params = (0.0, 0.0, 0.0, NAN)
    landing = PlanItem(
        _N.LAND, PlanFrame.GLOBAL, params, home.latitude_deg, home.longitude_deg, home.altitude_m
    )
    return (*way, landing)


def _passed(item: PlanItem) -> PlanItem:
    """Return an item as a waypoint without a stay; LOITER_TO_ALT is unchanged."""
    _, radius, passing, heading = item.params
    if item.command == _N.LOITER_TO_ALT:
        return replace(item, autocontinue=True)
    own = radius if item.command == _N.WAYPOINT else 0.0
    return replace(
        item, command=_N.WAYPOINT, params=(0.0, own, passing, heading), autocontinue=True
    )


def _nearest(items: tuple[PlanItem, ...], home: Geodetic, here: Geodetic) -> int | None:
    """Return the item with the nearest place in 3D; None = no places."""

    def away(index: int) -> float:
        place = items[index].place(home.altitude_m)
        height = place.altitude_m - here.altitude_m
        return math.hypot(distance_m(place[:2], here[:2]), height)

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
    plans: Plans, home: Geodetic, here: Geodetic, kind: int, *, valid: bool = True
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
        return distance_m(place[:2], here[:2])

    best = Destination(home)
    nearest = math.inf if kind == ReturnType.NOT_HOME else away(home)
    candidates: list[Destination] = []
    if kind in (ReturnType.NOT_HOME, ReturnType.NEAREST) and valid:
        landings = [item for item in plans.mission if item.command == NavCommand.LAND]
        places = [item.place(home.altitude_m) for item in landings[:1]]
        candidates += [Destination(place, by_landing=True) for place in places]
    rally = [
        item.place(home.altitude_m)
        for item in plans.stored(MissionType.RALLY).items
        if item.command == NavCommand.RALLY_POINT
    ]
    far = [place for place in rally if distance_m(place[:2], home[:2]) > OF_HOME_M]
    for candidate in [*candidates, *map(Destination, far)]:
        if away(candidate.place) + NEARER_M < nearest:
            best, nearest = candidate, away(candidate.place)
    return best


class MissionManager(Missions):
    """Executors of Mission and of Return along mission items; `triplet` is the active path."""

    def __init__(
        self, plans: Plans, value: Callable[[str], float], crew: Crew, fence: FenceMonitor
    ) -> None:
        """Store the plans, the look-up for PX4 parameters, the callbacks and the geofence."""
        self._plans, self._value, self._crew, self._fence = plans, value, crew, fence
        self.executor = MissionExecutor(plans, value, crew, self._check)
        """Mission executor, which also holds region of interest and speed."""
        self._way_home = Plans()
        """Mission items flown by Return."""
        self._returning = MissionExecutor(
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
        return self.executor.valid

    @property
    def over(self) -> bool:
        """True if the active mission has ended."""
        return self._flying and self.executor.finished

    def review(self, now: NavigationState, /) -> None:
        """Check the mission after a change of mission, fence or home."""
        self.executor.review(now)

    def look_at(self, place: Geodetic | None, /) -> None:
        """Set the region of interest; None = clear it."""
        self.executor.roi.look_at(place)

    def destination(self, now: NavigationState, /) -> Geodetic | None:
        """Return the destination of Return by RTL_TYPE; None = along mission items."""
        if self._return_type is ReturnType.MISSION:
            return None
        goal = self._goal(now)
        return None if goal.by_landing else goal.place

    def step(self, now: NavigationState, mode: Mode, /, *, armed: bool) -> None:
        """Advance by a period of the navigator."""
        flying = armed and mode is Mode.MISSION
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

    def _step_home(self, now: NavigationState, *, returning: bool) -> None:
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
        return ReturnType(number) if number in set(ReturnType) else ReturnType.HOME_OR_RALLY

    def _goal(self, now: NavigationState) -> Destination:
        here = local_to_geodetic(np.array(now.position), now.origin)
        return destination(self._plans, now.home, here, self._return_type, valid=self.valid)

    def _plan_way_home(self, now: NavigationState, *, flying: bool) -> None:
        """Store the items for Return; `flying`: a mission was active until now."""
        here = local_to_geodetic(np.array(now.position), now.origin)
        if self._return_type is not ReturnType.MISSION:
            way = self._way_to_landing(now, here)
        elif self.valid:
            way = along_mission(self._plans, now.home, here, flying=flying)
        else:
            way = ()
        self._way_home.store(MissionType.MISSION, way, 0, 0)

    def _way_to_landing(self, now: NavigationState, here: Geodetic) -> tuple[PlanItem, ...]:
        """Return the climb and the complete landing of the mission."""
        begin = landing_start(self._plans.mission)
        if begin is None:
            return ()
        ground = self._goal(now).place
        away = distance_m(ground[:2], here[:2])
        above = return_height(self._value, here.altitude_m - ground.altitude_m, away)
        landing = onwards(self._plans, begin)
        altitude = ground.altitude_m + above
        if altitude <= here.altitude_m:
            return landing
        text = f"RTL Mission land: climb to {math.ceil(altitude)} m"
        event = RTL_MISSION_LAND.event(math.ceil(altitude))
        self._crew.say(OperatorText(Severity.INFO, text, event))
        return (climb(here, altitude), *landing)

    def _check_way_home(self, _now: NavigationState) -> FeasibilityResult:
        return FeasibilityResult(bool(self._way_home.mission), ())

    def _check(self, now: NavigationState) -> FeasibilityResult:
        return check(
            self._plans.mission,
            now.home,
            self._value,
            landed=now.landed,
            inside_fence=lambda place: self._fence.inside(place, now.home),
        )
