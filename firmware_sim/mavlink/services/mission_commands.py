"""Commands about missions, home and what the vehicle looks at.

Answers and refusals follow PX4 1.16 (Commander, Navigator).
"""

from __future__ import annotations

import math

from airl_mav.core.frames import Geodetic
from firmware_sim.autopilot.autopilot_state import Result
from firmware_sim.autopilot.navigation.plan import NavCommand
from firmware_sim.mavlink.codec import dialect
from firmware_sim.mavlink.services.command import Action, Command
from firmware_sim.mavlink.services.context import Context

_ROI_LOCATION = 3
"""MAV_ROI_LOCATION."""


def _start(command: Command, context: Context) -> Result:
    """Parameter 1: the first item; -1 = as the mission stands."""
    index = command.params[0]
    if not math.isfinite(index):
        return Result.DENIED
    return context.port.start_mission(int(index))


def _start_landing(_command: Command, context: Context) -> Result:
    """Go to the mission's landing: DO_LAND_START, or the first landing; CANCELLED without one."""
    commands = [item.command for item in context.port.plans.mission]
    for marker in (NavCommand.DO_LAND_START, NavCommand.LAND):
        if marker in commands:
            return context.port.start_mission(commands.index(marker))
    return Result.CANCELLED


def _set_home(command: Command, context: Context) -> Result:
    """Parameter 1: 1 = the present place; else parameters 5 to 7 are the place."""
    if command.params[0] > 0.5:
        return context.port.set_home(None)
    place = Geodetic(*command.params[4:7])
    if not all(math.isfinite(value) for value in place):
        return Result.DENIED
    return context.port.set_home(place)


def _look(command: Command, context: Context) -> Result:
    """DO_SET_ROI_LOCATION, DO_SET_ROI (parameter 1: MAV_ROI) and DO_SET_ROI_NONE."""
    place = Geodetic(*command.params[4:7])
    located = command.number == NavCommand.DO_SET_ROI_LOCATION or (
        command.number != NavCommand.DO_SET_ROI_NONE and command.params[0] == _ROI_LOCATION
    )
    valid = math.isfinite(place.latitude_deg) and math.isfinite(place.longitude_deg)
    context.port.look_at(place if located and valid else None)
    return Result.ACCEPTED


ACTIONS: dict[int, Action] = {
    dialect.MAV_CMD_MISSION_START: _start,
    dialect.MAV_CMD_DO_LAND_START: _start_landing,
    dialect.MAV_CMD_DO_SET_HOME: _set_home,
    dialect.MAV_CMD_DO_SET_ROI_LOCATION: _look,
    dialect.MAV_CMD_DO_SET_ROI_NONE: _look,
    dialect.MAV_CMD_DO_SET_ROI: _look,
    dialect.MAV_CMD_NAV_ROI: _look,
    # It is followed only as a mission's item.
    dialect.MAV_CMD_DO_SET_ROI_WPNEXT_OFFSET: _look,
}
