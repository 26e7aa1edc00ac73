"""AUTOPILOT_VERSION: the identity and the true capabilities of the built-in autopilot."""

from __future__ import annotations

from firmware_sim.autopilot.autopilot_state import AutopilotState
from firmware_sim.mavlink.codec import Values, dialect

CAPABILITIES: int = (
    dialect.MAV_PROTOCOL_CAPABILITY_PARAM_FLOAT
    | dialect.MAV_PROTOCOL_CAPABILITY_COMMAND_INT
    | dialect.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE
    | dialect.MAV_PROTOCOL_CAPABILITY_SET_POSITION_TARGET_LOCAL_NED
    | dialect.MAV_PROTOCOL_CAPABILITY_MAVLINK2
)
"""Of a real PX4's 0xE8FF only what is true here: no missions, fence, rally points, FTP, attitude
setpoints or flight termination."""

FIRMWARE_VERSION = 1 << 24 | 16 << 16 | 0 << 8 | 255
"""The PX4 release whose behaviour is emulated: 1.16.0, FIRMWARE_VERSION_TYPE_OFFICIAL."""

BOARD_VERSION = 1
"""As PX4 SITL reports."""

CUSTOM_VERSION = b"airl-mav"
"""Where a real PX4 puts the first 8 bytes of its git hash."""

UID = 0x4149_524C_4D41_5601
"""Constant hardware id: every emulated vehicle is the same piece of hardware."""


def autopilot_version(state: AutopilotState) -> Values:  # noqa: ARG001 - a stream builder
    """Return AUTOPILOT_VERSION."""
    os_version = vendor = product = 0
    middleware_custom_version = os_custom_version = (0,) * 8
    return (
        CAPABILITIES,
        FIRMWARE_VERSION,
        FIRMWARE_VERSION,
        os_version,
        BOARD_VERSION,
        *CUSTOM_VERSION,
        *middleware_custom_version,
        *os_custom_version,
        vendor,
        product,
        UID,
    )
