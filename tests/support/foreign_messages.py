"""Messages by which a foreign system acts on the vehicle, by the name of the recorded effect."""

from __future__ import annotations

import math
import struct
from typing import Any

from firmware_sim.mavlink.codec import dialect

LEVEL = (1.0, 0.0, 0.0, 0.0)
UNKNOWN = (math.nan,) * 21
SHELL = dialect.SERIAL_CONTROL_DEV_SHELL


def ftp(opcode: int, data: bytes = b"") -> Any:
    """Return a FILE_TRANSFER_PROTOCOL request to the vehicle."""
    head = struct.pack("<HBBBBBxI", 1, 0, opcode, len(data), 0, 0, 0)
    body = list((head + data).ljust(251, b"\0"))
    return dialect.MAVLink_file_transfer_protocol_message(0, 1, 1, body)


def _parameter(name: bytes, value: float) -> Any:
    return dialect.MAVLink_param_set_message(1, 1, name, value, dialect.MAV_PARAM_TYPE_REAL32)


FOREIGN: dict[str, list[Any]] = {
    "ODOMETRY": [
        dialect.MAVLink_odometry_message(
            *(1, dialect.MAV_FRAME_LOCAL_NED, dialect.MAV_FRAME_BODY_FRD, 1.0, 2.0, -3.0, LEVEL),
            *(0.0, 0.0, 0.0, math.nan, math.nan, math.nan, UNKNOWN, UNKNOWN, 0),
            *(dialect.MAV_ESTIMATOR_TYPE_VIO, 80),
        )
    ],
    "VISION_POSITION_ESTIMATE": [
        dialect.MAVLink_vision_position_estimate_message(
            1, 1.0, 2.0, -3.0, 0.0, 0.0, 0.0, UNKNOWN, 0
        )
    ],
    "DISTANCE_SENSOR": [dialect.MAVLink_distance_sensor_message(0, 10, 3000, 200, 0, 1, 25, 0)],
    "OPTICAL_FLOW_RAD": [
        dialect.MAVLink_optical_flow_rad_message(
            *(0, 1, 10_000, 0.1, 0.1, 0.0, 0.0, 0.0, 2000, 200, 0, 1.0)
        )
    ],
    "OBSTACLE_DISTANCE": [
        dialect.MAVLink_obstacle_distance_message(
            *(0, 0, [100] * 72, 5, 20, 500, 5.0, 0.0, dialect.MAV_FRAME_BODY_FRD)
        )
    ],
    "LANDING_TARGET": [
        dialect.MAVLink_landing_target_message(
            *(0, 1, dialect.MAV_FRAME_LOCAL_NED, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 1.0, 0.0),
            *(LEVEL, 0, 1),
        )
    ],
    "SET_GPS_GLOBAL_ORIGIN": [
        dialect.MAVLink_set_gps_global_origin_message(1, 473_977_420, 85_455_940, 489_400)
    ],
    "MISSION_ITEM_INT": [
        dialect.MAVLink_mission_count_message(1, 1, 1, 0),
        dialect.MAVLink_mission_item_int_message(
            *(1, 1, 0, 3, 16, 0, 1, 0.0, 0.0, 0.0, 0.0, 473_977_420, 85_455_940, 10.0, 0)
        ),
    ],
    "SERIAL_CONTROL": [
        dialect.MAVLink_serial_control_message(
            *(SHELL, 0, 0, 0, 24, list(b"param set NAV_DLL_ACT 0\n".ljust(70, b"\0")))
        )
    ],
    "FILE_TRANSFER_PROTOCOL": [ftp(9, b"/fs/microsd/d")],
    "FOLLOW_TARGET": [
        dialect.MAVLink_follow_target_message(
            *(0, 1, 473_977_420, 85_455_940, 500.0, *[[0.0] * 3] * 2, LEVEL, *[[0.0] * 3] * 2, 0)
        )
    ],
    "COMMAND_LONG MAV_CMD_DO_CHANGE_SPEED": [
        dialect.MAVLink_command_long_message(1, 1, 178, 0, 1.0, 3.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    ],
    "MISSION_CLEAR_ALL": [dialect.MAVLink_mission_clear_all_message(1, 1, 0)],
    "MANUAL_CONTROL": [dialect.MAVLink_manual_control_message(1, 0, 0, 500, 0, 0)],
}
"""In the order in which they are sent in one flight."""

CHANGED: dict[str, Any] = {
    "PARAM_SET MPC_XY_VEL_MAX": _parameter(b"MPC_XY_VEL_MAX", 6.5),
    "PARAM_SET COM_DISARM_LAND": _parameter(b"COM_DISARM_LAND", 3.5),
}
"""Changes of parameters."""
