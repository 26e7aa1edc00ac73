"""ATTITUDE, ATTITUDE_QUATERNION, ATTITUDE_TARGET: how the vehicle points, and how it should."""

from __future__ import annotations

import math

from airl_mav.core.kernels import kernel
from airl_mav.vehicle.rotation import yaw_of
from firmware_sim.autopilot.autopilot_state import AutopilotState, Vector
from firmware_sim.mavlink.codec import Values
from firmware_sim.mavlink.streams.units import boot_ms

_NO_ROTATION_OFFSET = (0.0, 0.0, 0.0, 0.0)
"""PX4 saves bytes: zeros mean the identity (tailsitters alone differ)."""


def attitude(state: AutopilotState) -> Values:
    """Euler angles [rad] and body rates [rad/s]."""
    estimate = state.estimate
    angles, rates = _euler(estimate.quaternion), estimate.angular_velocity.tolist()
    return boot_ms(estimate.time_us), *angles, *rates


def attitude_quaternion(state: AutopilotState) -> Values:
    """Quaternion w, x, y, z (body FRD -> NED) and body rates [rad/s]."""
    estimate = state.estimate
    quaternion, rates = estimate.quaternion.tolist(), estimate.angular_velocity.tolist()
    return boot_ms(estimate.time_us), *quaternion, *rates, *_NO_ROTATION_OFFSET


def attitude_target(state: AutopilotState) -> Values:
    """What the attitude and rate controllers track; collective thrust 0..1."""
    type_mask = 0
    quaternion, rates = state.attitude_setpoint.tolist(), state.rate_setpoint.tolist()
    return boot_ms(state.time_us), type_mask, *quaternion, *rates, state.thrust_setpoint


@kernel
def _euler(quaternion: Vector) -> tuple[float, float, float]:
    """Return roll, pitch, yaw [rad] of a quaternion (4,), as `frames.quat_to_euler`."""
    w, x, y, z = quaternion[0], quaternion[1], quaternion[2], quaternion[3]
    roll = math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    pitch = math.asin(min(1.0, max(-1.0, 2.0 * (w * y - z * x))))
    return roll, pitch, yaw_of((w, x, y, z))
