"""SET_POSITION_TARGET_LOCAL_NED: offboard setpoints, read as PX4 reads them.

Source: PX4 MavlinkReceiver::handle_message_set_position_target_local_ned, checked against a
running PX4 1.16. Acceleration setpoints are not supported, as the controller lacks them: a message
that commands only an acceleration is invalid here.
"""

from __future__ import annotations

import math

import numpy as np

from airl_mav.core.frames import heading_to_ned, quat_yaw
from firmware_sim.autopilot.autopilot_state import Message, Setpoint, Severity, Vector
from firmware_sim.mavlink.codec import WireMessage, dialect
from firmware_sim.mavlink.services.context import Context

_NAME = "SET_POSITION_TARGET_LOCAL_NED"
_POSITION_SHIFT, _VELOCITY_SHIFT = 0, 3
"""First bit of each vector's three ignore bits (POSITION_TARGET_TYPEMASK)."""


def handle_setpoint(message: WireMessage, context: Context) -> bool:
    """Pass a valid setpoint to the autopilot; report what is wrong with an invalid one."""
    mask: int = message.type_mask
    position = _masked((message.x, message.y, message.z), mask >> _POSITION_SHIFT)
    velocity = _masked((message.vx, message.vy, message.vz), mask >> _VELOCITY_SHIFT)
    frame: int = message.coordinate_frame
    if frame == dialect.MAV_FRAME_BODY_NED:
        position = np.full(3, math.nan)
        velocity = _heading_frame_velocity(velocity, mask, context)
    elif frame != dialect.MAV_FRAME_LOCAL_NED:
        return _reject(context, f"{_NAME} coordinate frame {frame} unsupported")
    if not (np.isfinite(position).any() or np.isfinite(velocity).any()):
        return _reject(context, f"{_NAME} invalid")
    yaw = math.nan if mask & dialect.POSITION_TARGET_TYPEMASK_YAW_IGNORE else message.yaw
    yaw_rate = (
        math.nan if mask & dialect.POSITION_TARGET_TYPEMASK_YAW_RATE_IGNORE else message.yaw_rate
    )
    wire_yaw = message.yaw if math.isnan(yaw_rate) else yaw_rate
    wire = (message.vx, message.vy, message.vz, wire_yaw)
    setpoint = Setpoint(position, velocity, _finite(yaw), _finite(yaw_rate), wire)
    context.port.offer_setpoint(setpoint, context.now_us)
    return True


def _masked(values: tuple[float, float, float], ignore: int) -> Vector:
    """Return the commanded vector (3,); NaN where ignored or not a finite number."""
    return np.array(
        [math.nan if ignore >> i & 1 else _finite(value) for i, value in enumerate(values)]
    )


def _heading_frame_velocity(velocity: Vector, mask: int, context: Context) -> Vector:
    """Turn a BODY_NED velocity (3,) by the present heading; all or nothing, as in PX4."""
    if mask >> _VELOCITY_SHIFT & 0b111:
        return np.full(3, math.nan)
    return heading_to_ned(velocity, quat_yaw(context.port.state().estimate.quaternion))


def _finite(value: float) -> float:
    return value if math.isfinite(value) else math.nan


def _reject(context: Context, text: str) -> bool:
    context.announce(Message(Severity.CRITICAL, text))
    return False
