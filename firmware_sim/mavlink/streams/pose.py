"""Orbit, home and origin of the vehicle, and its true state for comparison."""

from __future__ import annotations

import math

import numpy as np

from airl_mav.core.frames import HOME, Geodetic, geodetic_to_local, local_to_geodetic
from firmware_sim.autopilot.autopilot_state import AutopilotState
from firmware_sim.interfaces import TrueState
from firmware_sim.mavlink.codec import Values, dialect
from firmware_sim.mavlink.streams import units

_NO_APPROACH = (0.0, 0.0, 0.0)
"""Approach vector of HOME_POSITION: no special approach."""


def orbit_execution_status(state: AutopilotState) -> Values | None:
    """Return the current orbit, with its global centre; None in other modes."""
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
    """Return home in global coordinates and in local NED; None if unset."""
    home, origin = state.home, state.origin
    if home is None:
        return None
    # Without an origin the home position has no local coordinates.
    local = (
        [math.nan, math.nan, math.nan]
        if origin is None
        else geodetic_to_local(home, origin).tolist()
    )
    return *_wire(home), *local, *_heading(state.home_yaw), *_NO_APPROACH, state.time_us


def gps_global_origin(state: AutopilotState) -> Values | None:
    """Return the origin of local NED in global coordinates; None if unset."""
    return None if state.origin is None else (*_wire(state.origin), state.time_us)


def _wire(place: Geodetic) -> Values:
    """Return latitude, longitude [degE7] and altitude [mm]."""
    return (
        units.deg_e7(place.latitude_deg),
        units.deg_e7(place.longitude_deg),
        units.mm(place.altitude_m),
    )


def _heading(yaw: float) -> Values:
    """Return a level attitude w, x, y, z with a heading [rad]."""
    return math.cos(0.5 * yaw), 0.0, 0.0, math.sin(0.5 * yaw)


# HIL_STATE_QUATERNION is sent on request only, as PX4 SITL sends its simulator's state. Real
# firmware receives it from the same function. No flight code reads it. Source: PX4 1.16,
# streams/HIL_STATE_QUATERNION.hpp.

_NO_AIRSPEEDS = (0, 0)
_NO_ACCELERATION = (0, 0, 0)
"""Placeholder: `TrueState` has no acceleration, and PX4 only logs it."""


def hil_state_quaternion(truth: TrueState, time_us: int) -> Values:
    """Return attitude (w, x, y, z, body -> NED), rates [rad/s], position and velocity [cm/s].

    Args:
        truth: True state.
        time_us: Time stamp on the receiver's clock [µs].
    """
    place = local_to_geodetic(truth.position, HOME)
    return (
        time_us,
        *truth.quaternion.tolist(),
        *truth.angular_velocity.tolist(),
        units.deg_e7(place.latitude_deg),
        units.deg_e7(place.longitude_deg),
        units.mm(place.altitude_m),
        *(units.cm_s(v) for v in truth.velocity.tolist()),
        *_NO_AIRSPEEDS,
        *_NO_ACCELERATION,
    )
