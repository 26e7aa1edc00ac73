"""Destination of Return, and its way along the mission: items and their order.

Source: PX4 1.16, RTL::findRtlDestination, RtlMissionFast, RtlMissionFastReverse and
RtlDirectMissionLand, for a multicopter. They fly the places of a mission alone: no waits, no
commands. RTL_TYPE = 2 has no destination, but a way along the mission.
"""

from __future__ import annotations

import math
from dataclasses import replace
from enum import IntEnum
from typing import NamedTuple

from airl_mav.core.frames import Geodetic
from firmware_sim.autopilot.navigation.plan import (
    Frame,
    Kind,
    NavCommand,
    PlanItem,
    Plans,
    distance_m,
    go_to,
)

_N = NavCommand
NAN = math.nan

MOST_ITEMS = 1_000
"""Of a way home: a mission may jump back 65,535 times."""


def landing_start(items: tuple[PlanItem, ...]) -> int | None:
    """Return where the mission's landing begins: at DO_LAND_START, else at its NAV_LAND.

    None where it has no landing.
    """
    landings = [index for index, item in enumerate(items) if item.command == _N.LAND]
    if not landings:
        return None
    starts = [index for index, item in enumerate(items) if item.command == _N.DO_LAND_START]
    return min([*starts[:1], landings[0]])


def along_mission(
    plans: Plans, home: Geodetic, here: Geodetic, *, flying: bool
) -> tuple[PlanItem, ...]:
    """Return the way of RTL_TYPE 2: on to the mission's landing, else back to where it began.

    Args:
        plans: The mission, and the item that is flown.
        home: Where a way back ends.
        here: Where the vehicle is.
        flying: Whether the mission is being flown; else it begins at the nearest item.
    """
    items = plans.mission
    index = plans.current if flying else _nearest(items, home, here)
    if index is None:
        return ()
    if landing_start(items) is not None:
        return onwards(plans, index)
    return _back(items, index - 1 if flying else index, home)


def onwards(plans: Plans, index: int) -> tuple[PlanItem, ...]:
    """Return the places from an item on, up to the landing; jumps that are left are taken."""
    left = Plans()
    left.store(Kind.MISSION, plans.mission, 0)
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
    """Return the item that climbs to an altitude above mean sea level [m], at a place."""
    params = (0.0, 0.0, 0.0, NAN)
    return PlanItem(
        _N.WAYPOINT, Frame.GLOBAL, params, here.latitude_deg, here.longitude_deg, altitude_m
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
        _N.LAND, Frame.GLOBAL, params, home.latitude_deg, home.longitude_deg, home.altitude_m
    )
    return (*way, landing)


def _passed(item: PlanItem) -> PlanItem:
    """Return an item as a place that is passed without a stay; LOITER_TO_ALT stays what it is."""
    _, radius, passing, heading = item.params
    if item.command == _N.LOITER_TO_ALT:
        return replace(item, autocontinue=True)
    own = radius if item.command == _N.WAYPOINT else 0.0
    return replace(
        item, command=_N.WAYPOINT, params=(0.0, own, passing, heading), autocontinue=True
    )


def _nearest(items: tuple[PlanItem, ...], home: Geodetic, here: Geodetic) -> int | None:
    """Return the item whose place is nearest, height counted; None = no item has one."""

    def away(index: int) -> float:
        place = items[index].place(home.altitude_m)
        height = place.altitude_m - here.altitude_m
        return math.hypot(distance_m(place[:2], here[:2]), height)

    places = [index for index, item in enumerate(items) if item.has_position]
    return min(places, key=away, default=None)


NEARER_M = 2.0
"""A place must be nearer than another one by this much to be preferred [m]."""

OF_HOME_M = 10.0
"""Rally points as near to home as this are home's [m]."""


class ReturnType(IntEnum):
    """RTL_TYPE."""

    HOME_OR_RALLY = 0
    NOT_HOME = 1
    """The mission's landing or a rally point; home only where there is neither."""
    MISSION = 2
    """Along the mission to its landing; where it has none, back along it and home."""
    NEAREST = 3
    """Home, the mission's landing or a rally point."""


class Destination(NamedTuple):
    """Destination of Return."""

    place: Geodetic
    """Its altitude is the ground's."""
    by_landing: bool = False
    """Whether it is the mission's landing, which is flown from its beginning."""


def destination(
    plans: Plans, home: Geodetic, here: Geodetic, kind: int, *, valid: bool = True
) -> Destination:
    """Return where to return to.

    Args:
        plans: The rally points and the mission.
        home: Its altitude is the ground's, as is that of what is returned.
        here: Where the vehicle is.
        kind: RTL_TYPE; a number that it does not have counts as 0.
        valid: Whether the mission can be flown; else its landing does not count.
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
        for item in plans.stored(Kind.RALLY).items
        if item.command == NavCommand.RALLY_POINT
    ]
    far = [place for place in rally if distance_m(place[:2], home[:2]) > OF_HOME_M]
    for candidate in [*candidates, *map(Destination, far)]:
        if away(candidate.place) + NEARER_M < nearest:
            best, nearest = candidate, away(candidate.place)
    return best
