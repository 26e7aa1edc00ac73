"""HIGH_LATENCY2: the whole vehicle in 42 bytes, for links by satellite; here on request.

Source: PX4 1.16, streams/HIGH_LATENCY2.hpp. PX4 gives the mean or the greatest value since the last
one was sent; here it is the present one.
"""

from __future__ import annotations

import math
from typing import Final

from airl_mav.core.frames import local_to_geodetic, quat_yaw
from firmware_sim.autopilot.autopilot_state import Arming, AutopilotState, Mode
from firmware_sim.autopilot.mode_numbers import custom_mode
from firmware_sim.mavlink.codec import Values, dialect
from firmware_sim.mavlink.streams import units
from firmware_sim.mavlink.streams.sensors import percent

_UINT8_MAX: Final = 255
_INT8_MIN: Final = -128
_NO_TARGET = (0, 0)
"""Altitude and distance of a target: PX4 has them of fixed wings alone."""
_NO_AIRSPEEDS = (0, 0)
_NO_WIND = (0, 0)
_NO_MISSION: Final = 0xFFFF
_CUSTOM = (_INT8_MIN, _INT8_MIN, _INT8_MIN)


def high_latency2(state: AutopilotState) -> Values:
    """Place [1e-7 deg, m], headings [2 deg], speeds [0.2 m/s, 0.1 m/s], charge [%], what fails."""
    estimate, gps = state.estimate, state.gps
    north, east, down = estimate.velocity.tolist()
    armed = state.status.arming is Arming.ARMED
    return (
        units.boot_ms(state.time_us),
        dialect.MAV_TYPE_QUADROTOR,
        dialect.MAV_AUTOPILOT_PX4,
        custom_mode(state.status.mode) >> 16,
        *_place(state),
        _NO_TARGET[0],
        _heading(quat_yaw(estimate.quaternion)),
        _heading(quat_yaw(state.attitude_setpoint)),
        _NO_TARGET[1],
        percent(state.thrust_setpoint) if armed else 0,
        *_NO_AIRSPEEDS,
        _uint8(math.hypot(north, east) * 5.0),
        *_NO_WIND,
        _UINT8_MAX if gps is None else _uint8(gps.eph_m * 10.0),
        _UINT8_MAX if gps is None else _uint8(gps.epv_m * 10.0),
        _INT8_MIN,
        units.saturate(abs(down) * 10.0, 0, 127, 0),
        percent(state.battery.remaining),
        state.mission.current if state.mission.total else _NO_MISSION,
        _failures(state),
        *_CUSTOM,
    )


def _place(state: AutopilotState) -> tuple[int, int, int]:
    """Return latitude and longitude [1e-7 deg] and altitude [m]; zeros while they are unknown."""
    position = state.estimate.position
    if state.origin is None or not all(map(math.isfinite, position.tolist())):
        return 0, 0, 0
    place = local_to_geodetic(position, state.origin)
    return (
        units.deg_e7(place.latitude_deg),
        units.deg_e7(place.longitude_deg),
        units.int16(place.altitude_m),
    )


def _heading(yaw_rad: float) -> int:
    """Return a heading in units of 2 deg."""
    return int(math.degrees(yaw_rad % units.TWO_PI) / 2.0) if math.isfinite(yaw_rad) else 0


def _uint8(value: float) -> int:
    return units.saturate(value, 0, _UINT8_MAX, _UINT8_MAX)


def _failures(state: AutopilotState) -> int:
    """Return the HL_FAILURE_FLAG bits of what has failed."""
    health, status = state.health, state.status
    offboard_lost = status.failsafe and status.intended_mode is Mode.OFFBOARD
    failed = {
        dialect.HL_FAILURE_FLAG_GPS: not health.gps,
        dialect.HL_FAILURE_FLAG_ABSOLUTE_PRESSURE: not health.baro,
        dialect.HL_FAILURE_FLAG_3D_ACCEL: not health.accel,
        dialect.HL_FAILURE_FLAG_3D_GYRO: not health.gyro,
        dialect.HL_FAILURE_FLAG_3D_MAG: not health.mag,
        dialect.HL_FAILURE_FLAG_BATTERY: not health.battery,
        dialect.HL_FAILURE_FLAG_RC_RECEIVER: state.sticks is None,
        dialect.HL_FAILURE_FLAG_OFFBOARD_LINK: offboard_lost,
        dialect.HL_FAILURE_FLAG_GEOFENCE: any(state.fence.breached),
        dialect.HL_FAILURE_FLAG_ESTIMATOR: not (health.attitude and health.position),
    }
    return sum(bit for bit, has_failed in failed.items() if has_failed)
