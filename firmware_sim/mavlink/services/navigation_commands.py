"""Commands for navigation, missions, home, origin, and the region of interest.

Source: PX4 1.16, Commander.cpp and Navigator, checked against a running PX4. PX4 ignores the frame:
every altitude is above mean sea level. MAVSDK relies on this: do_orbit sends such an altitude in a
frame above home.
"""

from __future__ import annotations

import math
from dataclasses import replace

from airl_mav.core.frames import Geodetic, geodetic_to_local
from airl_mav.vehicle.rotation import Vec
from firmware_sim.autopilot.autopilot_state import Mode, OperatorText, Result, Severity
from firmware_sim.autopilot.navigation.plan import NavCommand
from firmware_sim.autopilot.requests import OrbitRequest, PositionYaw, Reposition
from firmware_sim.mavlink.codec import WireMessage, dialect
from firmware_sim.mavlink.services.context import Action, Context, VehicleCommand

NAN = math.nan

_CHANGE_MODE: int = dialect.MAV_DO_REPOSITION_FLAGS_CHANGE_MODE
_GROUND_SPEED: int = dialect.SPEED_TYPE_GROUNDSPEED
_ROI_LOCATION = 3
"""Value of MAV_ROI_LOCATION."""

_LOWEST_M, _HIGHEST_M = -12_000.0, 100_000.0
"""Range of valid origin altitudes above mean sea level, as in EKF2 [m]."""


def _reposition(command: VehicleCommand, context: Context) -> Result:
    """Handle parameters 1: speed [m/s], 2: flags, 4: heading [rad], 5..7: position; NaN = keep."""
    if command.integer(2) != _CHANGE_MODE:
        return Result.UNSUPPORTED
    speed, yaw = command.params[0], command.params[3]
    speed = speed if math.isfinite(speed) and speed > 0.0 else NAN
    place = PositionYaw(local_place(command, context), yaw if math.isfinite(yaw) else NAN)
    if all(map(math.isnan, (*place.position, place.yaw))):
        return context.port.set_mode(Mode.HOLD)
    return context.port.set_mode(Mode.HOLD, Reposition(place, speed))


def _change_altitude(command: VehicleCommand, context: Context) -> Result:
    """Handle parameter 1: altitude [m] above mean sea level."""
    nowhere = (NAN, NAN, NAN, NAN, NAN, NAN)
    above = replace(command, params=(*nowhere, command.params[0]))
    place = PositionYaw(local_place(above, context), NAN)
    return context.port.set_mode(Mode.HOLD, Reposition(place, altitude_alone=True))


def _change_speed(command: VehicleCommand, context: Context) -> Result:
    """Handle parameters 1: SPEED_TYPE, 2: speed [m/s]."""
    speed = command.params[1]
    if command.integer(1) == _GROUND_SPEED and speed > 0.0 and math.isfinite(speed):
        context.port.change_speed(speed)
    return Result.ACCEPTED


def _orbit(command: VehicleCommand, context: Context) -> Result:
    """Handle parameters 1: radius [m], 2: speed [m/s], 3: ORBIT_YAW_BEHAVIOUR, 5..7: centre."""
    radius, speed = (p if math.isfinite(p) else NAN for p in command.params[:2])
    request = OrbitRequest(local_place(command, context), radius, speed, command.integer(3))
    result = context.port.set_mode(Mode.ORBIT, request)
    if result is not Result.ACCEPTED:
        context.announce(OperatorText(Severity.CRITICAL, "Orbit command rejected"))
    return result


def local_place(command: VehicleCommand, context: Context) -> Vec:
    """Return parameters 5 to 7 in local NED [m]; NaN if unset or unknown."""
    latitude, longitude, altitude = command.params[4:]
    state = context.port.state()
    origin = state.origin
    if origin is None:
        return NAN, NAN, NAN
    down = origin.altitude_m - altitude if math.isfinite(altitude) else NAN
    if not (math.isfinite(latitude) and math.isfinite(longitude)):
        return NAN, NAN, down
    north, east, _ = geodetic_to_local(
        Geodetic(latitude, longitude, origin.altitude_m), origin
    ).tolist()
    return north, east, down


def _start(command: VehicleCommand, context: Context) -> Result:
    """Handle parameter 1: first item; -1 = continue the mission."""
    index = command.params[0]
    if not math.isfinite(index):
        return Result.DENIED
    return context.port.start_mission(int(index))


def _start_landing(_command: VehicleCommand, context: Context) -> Result:
    """Go to the mission's landing: DO_LAND_START, or the first landing; CANCELLED without one."""
    commands = [item.command for item in context.port.plans.mission]
    for marker in (NavCommand.DO_LAND_START, NavCommand.LAND):
        if marker in commands:
            return context.port.start_mission(commands.index(marker))
    return Result.CANCELLED


def _set_home(command: VehicleCommand, context: Context) -> Result:
    """Handle parameter 1: 1 = current position; otherwise parameters 5 to 7 are the position."""
    if command.params[0] > 0.5:
        return context.port.set_home(None)
    place = Geodetic(*command.params[4:7])
    if not all(math.isfinite(value) for value in place):
        return Result.DENIED
    return context.port.set_home(place)


def _look(command: VehicleCommand, context: Context) -> Result:
    """Handle DO_SET_ROI_LOCATION, DO_SET_ROI (parameter 1: MAV_ROI) and DO_SET_ROI_NONE."""
    place = Geodetic(*command.params[4:7])
    located = command.number == NavCommand.DO_SET_ROI_LOCATION or (
        command.number != NavCommand.DO_SET_ROI_NONE and command.params[0] == _ROI_LOCATION
    )
    valid = math.isfinite(place.latitude_deg) and math.isfinite(place.longitude_deg)
    context.port.look_at(place if located and valid else None)
    return Result.ACCEPTED


def handle_set_origin(message: WireMessage, context: Context) -> bool:
    """Handle SET_GPS_GLOBAL_ORIGIN: move the origin of local NED.

    Requires this system id and a valid position. Like PX4 1.16, always reply GPS_GLOBAL_ORIGIN.
    """
    meant: bool = message.target_system == context.system_id
    place = Geodetic(message.latitude / 1e7, message.longitude / 1e7, message.altitude / 1e3)
    if meant and _is_on_the_globe(place):
        context.port.set_origin(place)
    context.link.send_stream("GPS_GLOBAL_ORIGIN", context.port.state())
    return meant


def _is_on_the_globe(place: Geodetic) -> bool:
    latitude, longitude, altitude = place
    return abs(latitude) <= 90.0 and abs(longitude) <= 180.0 and _LOWEST_M < altitude < _HIGHEST_M


ACTIONS: dict[int, Action] = {
    dialect.MAV_CMD_DO_REPOSITION: _reposition,
    dialect.MAV_CMD_DO_CHANGE_ALTITUDE: _change_altitude,
    dialect.MAV_CMD_DO_CHANGE_SPEED: _change_speed,
    dialect.MAV_CMD_DO_ORBIT: _orbit,
    dialect.MAV_CMD_MISSION_START: _start,
    dialect.MAV_CMD_DO_LAND_START: _start_landing,
    dialect.MAV_CMD_DO_SET_HOME: _set_home,
    dialect.MAV_CMD_DO_SET_ROI_LOCATION: _look,
    dialect.MAV_CMD_DO_SET_ROI_NONE: _look,
    dialect.MAV_CMD_DO_SET_ROI: _look,
    dialect.MAV_CMD_NAV_ROI: _look,
    # Effective only as a mission item.
    dialect.MAV_CMD_DO_SET_ROI_WPNEXT_OFFSET: _look,
}
