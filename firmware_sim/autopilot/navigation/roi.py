"""The region of interest: what the vehicle turns to while it flies elsewhere.

Source: PX4 1.16, Navigator (vehicle_roi) and MissionBase::heading_sp_update.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from enum import Enum, auto

from airl_mav.core.frames import Geodetic, wrap_pi
from airl_mav.vehicle.rotation import Vec
from firmware_sim.autopilot.navigation.plan import Frame, NavCommand, PlanItem

_MODE_LOCATION = 3
"""MAV_ROI_LOCATION."""


class _Look(Enum):
    NOWHERE = auto()
    PLACE = auto()
    WAYPOINT = auto()


class RegionOfInterest:
    """What to look at."""

    def __init__(self) -> None:
        self._look = _Look.NOWHERE
        self._place = Geodetic(0.0, 0.0, 0.0)
        self._offset = 0.0

    def reset(self) -> None:
        """Look at nothing in particular."""
        self._look = _Look.NOWHERE

    def look_at(self, place: Geodetic) -> None:
        """Look at a place (MAV_CMD_DO_SET_ROI_LOCATION)."""
        self._look, self._place = _Look.PLACE, place

    def command(self, item: PlanItem) -> None:
        """Carry out a mission item, where it is about the region of interest."""
        if item.command == NavCommand.DO_SET_ROI_NONE:
            self.reset()
        elif item.command == NavCommand.DO_SET_ROI_LOCATION:
            self.look_at(Geodetic(item.x, item.y, item.z))
        elif item.command == NavCommand.DO_SET_ROI_WPNEXT_OFFSET:
            offset = math.radians(item.z)
            self._look = _Look.WAYPOINT
            self._offset = offset if math.isfinite(offset) else 0.0
        elif item.command == NavCommand.DO_SET_ROI:
            located = item.frame != Frame.MISSION and item.params[0] == _MODE_LOCATION
            if located:
                self.look_at(Geodetic(item.x, item.y, item.z))
            else:
                self.reset()

    def heading(
        self, position: Vec, target: Vec, local: Callable[[Geodetic], Vec], nearest_m: float
    ) -> float | None:
        """Return the heading [rad] towards it; None = any, or it is nearer than `nearest_m`.

        `position` and `target`, where the vehicle is flying to, are local NED [m], and `local`
        turns a place into that.
        """
        if self._look is _Look.NOWHERE:
            return None
        at = local(self._place) if self._look is _Look.PLACE else target
        north, east = at[0] - position[0], at[1] - position[1]
        if math.hypot(north, east) <= nearest_m:
            return None
        offset = self._offset if self._look is _Look.WAYPOINT else 0.0
        return wrap_pi(math.atan2(east, north) + offset)
