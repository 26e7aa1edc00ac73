"""Destination of Return, and its path along the mission as items.

Source: PX4 1.16, RTL::findRtlDestination, RtlMissionFast, RtlMissionFastReverse and
RtlDirectMissionLand, for a multicopter. They fly only the places of a mission, without waits and
commands. RTL_TYPE = 2 has no destination but a path along the mission.
"""

from __future__ import annotations

import math
from dataclasses import replace
from enum import IntEnum
from typing import NamedTuple

from airl_mav.core.frames import Geodetic
from firmware_sim.autopilot.navigation.plan import (
    MissionType,
    NavCommand,
    PlanFrame,
    PlanItem,
    Plans,
    distance_m,
    go_to,
)

_N = NavCommand
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
    left = Plans()
    left.store(MissionType.MISSION, plans.mission, 0)
    left.jumps_done = dict(plans.jumps_done)
    way: list[PlanItem] = []
    following = go_to(left, index)
    for _ in range(MOST_ITEMS):
        if following is None:
            break
        item = plans.mission[following]
        if item.command == _N.LAND:
            return (*way, item)
        if item.has_position:
            way.append(_passed(item))
        following = go_to(left, following + 1)
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
