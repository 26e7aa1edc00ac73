"""Streams of PX4's in which this vehicle has nothing to say: it lacks the device.

A real PX4 accepts a rate for them and sends nothing, and so does this. Source: what a running PX4
1.16 accepts in SET_MESSAGE_INTERVAL.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType

from firmware_sim.autopilot.autopilot_state import AutopilotState

_NAMES = (
    *("GPS_STATUS", "NAV_CONTROLLER_OUTPUT", "COMMAND_LONG"),
    "CAMERA_TRIGGER",
    *("SCALED_IMU2", "SCALED_IMU3", "GPS2_RAW"),
    *("SCALED_PRESSURE3", "LANDING_TARGET", "EFI_STATUS", "WIND_COV"),
    *("GPS_RTCM_DATA", "ADSB_VEHICLE", "DEBUG_VECT", "NAMED_VALUE_FLOAT"),
    *("STATUSTEXT", "DEBUG", "CAMERA_IMAGE_CAPTURED", "MOUNT_ORIENTATION"),
    *("GIMBAL_MANAGER_INFORMATION", "GIMBAL_MANAGER_STATUS", "GIMBAL_DEVICE_INFORMATION"),
    *("GIMBAL_DEVICE_SET_ATTITUDE", "GIMBAL_DEVICE_ATTITUDE_STATUS"),
    *("OBSTACLE_DISTANCE", "RAW_RPM", "DEBUG_FLOAT_ARRAY"),
    "FIGURE_EIGHT_EXECUTION_STATUS",
    *("OPEN_DRONE_ID_BASIC_ID", "OPEN_DRONE_ID_LOCATION", "OPEN_DRONE_ID_SYSTEM"),
)


def nothing(state: AutopilotState) -> None:
    """There is nothing to say."""


SILENT: Mapping[str, Callable[[AutopilotState], None]] = MappingProxyType(
    dict.fromkeys(_NAMES, nothing)
)
