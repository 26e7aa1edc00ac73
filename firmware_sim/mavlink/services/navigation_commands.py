"""Commands that send the vehicle somewhere: to a place, round a place, at a speed.

Source: PX4 1.16, Commander.cpp and Navigator, checked against a running one. PX4 does not look
at the frame: every altitude is above mean sea level. MAVSDK relies on it, whose do_orbit sends such
an altitude in a frame above home.
"""

from __future__ import annotations

import math
from dataclasses import replace

from airl_mav.core.frames import Geodetic, geodetic_to_local
from airl_mav.vehicle.rotation import Vec
from firmware_sim.autopilot.autopilot_state import Message, Mode, Result, Severity
from firmware_sim.autopilot.requests import OrbitRequest, Place, Reposition
from firmware_sim.mavlink.codec import dialect
from firmware_sim.mavlink.services.command import Action, Command
from firmware_sim.mavlink.services.context import Context

NAN = math.nan

_CHANGE_MODE: int = dialect.MAV_DO_REPOSITION_FLAGS_CHANGE_MODE
_GROUND_SPEED: int = dialect.SPEED_TYPE_GROUNDSPEED


def _reposition(command: Command, context: Context) -> Result:
    """Parameter 1: speed [m/s], 2: flags, 4: heading [rad], 5..7: place. NaN = as it is."""
    if command.integer(2) != _CHANGE_MODE:
        return Result.UNSUPPORTED
    speed, yaw = command.params[0], command.params[3]
    speed = speed if math.isfinite(speed) and speed > 0.0 else NAN
    place = Place(local_place(command, context), yaw if math.isfinite(yaw) else NAN)
    if all(map(math.isnan, (*place.position, place.yaw))):
        return context.port.set_mode(Mode.HOLD)
    return context.port.set_mode(Mode.HOLD, Reposition(place, speed))


def _change_altitude(command: Command, context: Context) -> Result:
    """Parameter 1: altitude [m] above mean sea level."""
    nowhere = (NAN, NAN, NAN, NAN, NAN, NAN)
    above = replace(command, params=(*nowhere, command.params[0]))
    place = Place(local_place(above, context), NAN)
    return context.port.set_mode(Mode.HOLD, Reposition(place, altitude_alone=True))


def _change_speed(command: Command, context: Context) -> Result:
    """Parameter 1: SPEED_TYPE, 2: speed [m/s]."""
    speed = command.params[1]
    if command.integer(1) == _GROUND_SPEED and speed > 0.0 and math.isfinite(speed):
        context.port.change_speed(speed)
    return Result.ACCEPTED


def _orbit(command: Command, context: Context) -> Result:
    """Parameter 1: radius [m], 2: speed [m/s], 3: ORBIT_YAW_BEHAVIOUR, 5..7: centre."""
    radius, speed = (p if math.isfinite(p) else NAN for p in command.params[:2])
    request = OrbitRequest(local_place(command, context), radius, speed, command.integer(3))
    result = context.port.set_mode(Mode.ORBIT, request)
    if result is not Result.ACCEPTED:
        context.announce(Message(Severity.CRITICAL, "Orbit command rejected"))
    return result


def local_place(command: Command, context: Context) -> Vec:
    """Return parameters 5..7 in local NED [m]; NaN where nothing is given or known."""
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


ACTIONS: dict[int, Action] = {
    dialect.MAV_CMD_DO_REPOSITION: _reposition,
    dialect.MAV_CMD_DO_CHANGE_ALTITUDE: _change_altitude,
    dialect.MAV_CMD_DO_CHANGE_SPEED: _change_speed,
    dialect.MAV_CMD_DO_ORBIT: _orbit,
}
