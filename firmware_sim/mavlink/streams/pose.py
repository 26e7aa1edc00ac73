"""Where the vehicle is and how it points, where and how it should, its origin and home."""

from __future__ import annotations

import math

import numpy as np

from airl_mav.core.constants import GRAVITY_M_S2
from airl_mav.core.frames import Geodetic, geodetic_to_local, local_to_geodetic, quat_yaw
from airl_mav.vehicle.rotation import Vec, rotate
from firmware_sim.autopilot.autopilot_state import AutopilotState
from firmware_sim.mavlink.codec import Values, dialect
from firmware_sim.mavlink.streams import units

_NO_APPROACH = (0.0, 0.0, 0.0)
"""HOME_POSITION: there is no special way to land."""


def position_target_global_int(state: AutopilotState) -> Values | None:
    """Where an automatic mode is going, and how fast the vehicle shall be now; else nothing."""
    target, origin = state.destination, state.origin
    if target is None or origin is None or not all(map(math.isfinite, target)):
        return None
    place = local_to_geodetic(np.array(target), origin)
    yaw, nothing_ignored = state.setpoint.yaw, 0
    return (
        units.boot_ms(state.time_us),
        dialect.MAV_FRAME_GLOBAL_INT,
        nothing_ignored,
        units.deg_e7(place.latitude_deg),
        units.deg_e7(place.longitude_deg),
        place.altitude_m,
        *state.setpoint.velocity.tolist(),
        *_acceleration(state),
        yaw if math.isfinite(yaw) else quat_yaw(state.attitude_setpoint),
        0.0,
    )


def orbit_execution_status(state: AutopilotState) -> Values | None:
    """The circle that is flown: its centre on the globe; nothing in other modes."""
    orbit, origin = state.orbit, state.origin
    if orbit is None or origin is None:
        return None
    centre = local_to_geodetic(np.array(orbit.centre), origin)
    return (
        state.time_us,
        orbit.radius_m,
        dialect.MAV_FRAME_GLOBAL,
        units.deg_e7(centre.latitude_deg),
        units.deg_e7(centre.longitude_deg),
        centre.altitude_m,
    )


def home_position(state: AutopilotState) -> Values | None:
    """Home on the globe and in local NED; nothing before it is set."""
    home, origin = state.home, state.origin
    if home is None:
        return None
    local = (
        [math.nan, math.nan, math.nan]
        if origin is None
        else geodetic_to_local(home, origin).tolist()
    )
    return *_wire(home), *local, *_heading(state.home_yaw), *_NO_APPROACH, state.time_us


def gps_global_origin(state: AutopilotState) -> Values | None:
    """The point of the globe where local NED is zero; nothing before it is set."""
    return None if state.origin is None else (*_wire(state.origin), state.time_us)


def _wire(place: Geodetic) -> Values:
    """Return latitude, longitude [degE7] and altitude [mm]."""
    return (
        units.deg_e7(place.latitude_deg),
        units.deg_e7(place.longitude_deg),
        units.mm(place.altitude_m),
    )


def _acceleration(state: AutopilotState) -> Vec:
    """Return the acceleration NED [m/s²] that the thrust setpoint stands for, gravity apart."""
    w, x, y, z = state.attitude_setpoint.tolist()
    north, east, down = rotate((w, x, y, z), (0.0, 0.0, state.thrust_setpoint / state.hover_thrust))
    return -GRAVITY_M_S2 * north, -GRAVITY_M_S2 * east, GRAVITY_M_S2 * (1.0 - down)


def _heading(yaw: float) -> Values:
    """Return a level attitude w, x, y, z with a heading [rad]."""
    return math.cos(0.5 * yaw), 0.0, 0.0, math.sin(0.5 * yaw)
