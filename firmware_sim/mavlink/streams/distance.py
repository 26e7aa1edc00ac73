"""Distance and optical flow sensors: height above ground, and ground motion.

Source: PX4 1.16, streams/DISTANCE_SENSOR.hpp, ALTITUDE.hpp and OPTICAL_FLOW_RAD.hpp.
"""

from __future__ import annotations

import math

from airl_mav.core.constants import US_PER_S
from firmware_sim.autopilot.autopilot_state import AutopilotState
from firmware_sim.mavlink.codec import Values
from firmware_sim.mavlink.streams import units

NEW_US = 200_000
"""Maximum age of a sent measurement [µs]: the longest time that PX4's estimator waits for the next.
PX4 sends a measurement once."""

_CM, _CM2 = 1e2, 1e4
_FIRST = 0
_LASER, _KINDS = 0, (0, 1, 2)
"""MAV_DISTANCE_SENSOR values: laser, ultrasound, infrared. Other types are sent as laser."""
_NO_FIELD_OF_VIEW = (0.0, 0.0)
_NO_QUATERNION = (0.0, 0.0, 0.0, 0.0)
_QUALITY_NOT_TOLD = 0
_TEMPERATURE, _NO_DISTANCE_US, _NO_DISTANCE_M = 0, 0, -1.0


def distance_sensor(state: AutopilotState) -> Values | None:
    """Return the newest distance [cm]; None if outdated. PX4 does not send its quality."""
    told = state.distance
    if told is None or state.time_us - state.distance_us > NEW_US:
        return None
    return (
        units.boot_ms(state.distance_us),
        _whole(told.least_m * _CM),
        _whole(told.greatest_m * _CM),
        _whole(told.distance_m * _CM),
        told.kind if told.kind in _KINDS else _LASER,
        _FIRST,
        told.orientation,
        units.saturate(math.floor(told.variance_m2 * _CM2), 0, 255, 0),
        *_NO_FIELD_OF_VIEW,
        *_NO_QUATERNION,
        _QUALITY_NOT_TOLD,
    )


def clearance(state: AutopilotState, down: float) -> tuple[float, float]:
    """Return the local terrain altitude and the height above it [m]; NaN = unknown."""
    ground = state.clearance
    if ground is None or not ground.valid:
        return math.nan, math.nan
    return -down - ground.dist_bottom_m, ground.dist_bottom_m


def _whole(value: float) -> int:
    """Return a number for a uint16 field, truncated as in C."""
    return units.uint16(math.floor(value + 1e-9), unknown=0)


def optical_flow_rad(state: AutopilotState) -> Values | None:
    """Return the newest flow and rotation [rad]; None if outdated."""
    told = state.flow
    if told is None or state.time_us - state.flow_us > NEW_US:
        return None
    return (
        state.flow_us,
        _FIRST,
        round(told.interval_s * US_PER_S),
        *told.flow.tolist(),
        *told.turned.tolist(),
        _TEMPERATURE,
        told.quality,
        _NO_DISTANCE_US,
        _NO_DISTANCE_M,
    )
