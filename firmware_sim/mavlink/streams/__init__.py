"""The streamed messages: a table from message name to the function that builds it.

Sources of fields, units and "unknown" values: MAVLink common.xml and PX4
src/modules/mavlink/streams/*.hpp.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType

from firmware_sim.autopilot.autopilot_state import AutopilotState
from firmware_sim.mavlink.codec import Values
from firmware_sim.mavlink.streams import attitude, position, sensors, status

Builder = Callable[[AutopilotState], "Values | None"]
"""Returns one message's fields, in the order of its definition, from a snapshot; None = there is
nothing to say yet. Plain values, because message objects would cost more than all the rest."""

BUILDERS: Mapping[str, Builder] = MappingProxyType(
    {
        "HEARTBEAT": status.heartbeat,
        "ATTITUDE": attitude.attitude,
        "ATTITUDE_QUATERNION": attitude.attitude_quaternion,
        "LOCAL_POSITION_NED": position.local_position_ned,
        "ODOMETRY": position.odometry,
        "GLOBAL_POSITION_INT": position.global_position_int,
        "HIGHRES_IMU": sensors.highres_imu,
        "ALTITUDE": position.altitude,
        "ATTITUDE_TARGET": attitude.attitude_target,
        "POSITION_TARGET_LOCAL_NED": position.position_target_local_ned,
        "SERVO_OUTPUT_RAW": sensors.servo_output_raw,
        "VFR_HUD": position.vfr_hud,
        "GPS_RAW_INT": sensors.gps_raw_int,
        "EXTENDED_SYS_STATE": status.extended_sys_state,
        "SYS_STATUS": status.sys_status,
        "ESTIMATOR_STATUS": status.estimator_status,
        "SCALED_PRESSURE": sensors.scaled_pressure,
        "MISSION_CURRENT": status.mission_current,
        "HOME_POSITION": position.home_position,
        "GPS_GLOBAL_ORIGIN": position.gps_global_origin,
        "AUTOPILOT_VERSION": status.autopilot_version,
    }
)
"""Streams that need the snapshot only; the server adds those that need more."""
