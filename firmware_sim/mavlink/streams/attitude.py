"""ATTITUDE, ATTITUDE_QUATERNION, ATTITUDE_TARGET: how the vehicle points, and how it should."""

from __future__ import annotations

from airl_mav.frames import quat_to_euler
from firmware_sim.autopilot.state import AutopilotState
from firmware_sim.mavlink.codec import WireMessage, dialect
from firmware_sim.mavlink.streams.units import boot_ms

_NO_ROTATION_OFFSET = (0.0, 0.0, 0.0, 0.0)
"""PX4 saves bytes: zeros mean the identity (tailsitters alone differ)."""


def attitude(state: AutopilotState) -> WireMessage:
    """Euler angles [rad] and body rates [rad/s]."""
    estimate = state.estimate
    return dialect.MAVLink_attitude_message(
        boot_ms(estimate.time_us),
        *quat_to_euler(estimate.quaternion),
        *estimate.angular_velocity.tolist(),
    )


def attitude_quaternion(state: AutopilotState) -> WireMessage:
    """Quaternion w, x, y, z (body FRD -> NED) and body rates [rad/s]."""
    estimate = state.estimate
    return dialect.MAVLink_attitude_quaternion_message(
        boot_ms(estimate.time_us),
        *estimate.quaternion.tolist(),
        *estimate.angular_velocity.tolist(),
        _NO_ROTATION_OFFSET,
    )


def attitude_target(state: AutopilotState) -> WireMessage:
    """What the attitude and rate controllers track; collective thrust 0..1."""
    return dialect.MAVLink_attitude_target_message(
        boot_ms(state.time_us),
        0,
        state.attitude_setpoint.tolist(),
        *state.rate_setpoint.tolist(),
        state.thrust_setpoint,
    )
