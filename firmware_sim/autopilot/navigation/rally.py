"""Where Return goes: home, a rally point, or the mission's landing (RTL_TYPE).

Source: PX4 1.16, RTL::findRtlDestination, for a multicopter. With RTL_TYPE = 2 PX4 follows the
mission's own path; here the vehicle flies straight to the mission's landing, or home.
"""

from __future__ import annotations

import math
from enum import IntEnum

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
    """The mission's landing; home where it has none."""
    NEAREST = 3
    """Home, the mission's landing or a rally point."""


def destination(plans: Plans, home: Geodetic, here: Geodetic, kind: int) -> Geodetic:
    """Return where to return to.

    Args:
        plans: The rally points and the mission.
        home: Its altitude is the ground's, as is that of what is returned.
        here: Where the vehicle is.
        kind: RTL_TYPE; a number that it does not have counts as 0.
    """

    def away(place: Geodetic) -> float:
        return distance_m(place[:2], here[:2])

    not_home = kind in (ReturnType.NOT_HOME, ReturnType.MISSION)
    best, nearest = home, math.inf if not_home else away(home)
    candidates: list[Geodetic] = []
    if kind in (ReturnType.NOT_HOME, ReturnType.MISSION, ReturnType.NEAREST):
        landings = (item for item in plans.mission if item.command == NavCommand.LAND)
        candidates += [item.place(home.altitude_m) for item in list(landings)[:1]]
    if kind != ReturnType.MISSION:
        rally = [
            item.place(home.altitude_m)
            for item in plans.stored(Kind.RALLY).items
            if item.command == NavCommand.RALLY_POINT
        ]
        candidates += [place for place in rally if distance_m(place[:2], home[:2]) > OF_HOME_M]
    for place in candidates:
        if away(place) + NEARER_M < nearest:
            best, nearest = place, away(place)
    return best
