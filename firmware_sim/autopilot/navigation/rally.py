"""Where Return goes: home, a rally point, or the mission's landing (RTL_TYPE).

Source: PX4 1.16, RTL::findRtlDestination, for a multicopter. RTL_TYPE = 2 has no destination, but a
way along the mission: `way_home`.
"""

from __future__ import annotations

import math
from enum import IntEnum
from typing import NamedTuple

from airl_mav.core.frames import Geodetic
from firmware_sim.autopilot.navigation.geography import distance_m
from firmware_sim.autopilot.navigation.plan import Kind, NavCommand, Plans

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
    """Where to return to."""

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
