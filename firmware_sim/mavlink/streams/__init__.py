"""Streamed messages: a table of message names with their builder functions.

Sources of fields, units and "unknown" values: MAVLink common.xml and PX4
src/modules/mavlink/streams/*.hpp.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType

from firmware_sim.autopilot.autopilot_state import AutopilotState
from firmware_sim.mavlink.codec import Values
from firmware_sim.mavlink.streams import information, pose, sensor_streams, status

Builder = Callable[[AutopilotState], "Values | None"]
"""Returns one message's fields, in order of definition, from a snapshot; None = no content yet.
Plain values: creating message objects takes longer than all the rest."""

_SILENT = (
    *("GPS_STATUS", "NAV_CONTROLLER_OUTPUT", "COMMAND_LONG"),
    *("CAMERA_TRIGGER", "SCALED_IMU2", "SCALED_IMU3", "GPS2_RAW"),
    *("SCALED_PRESSURE3", "LANDING_TARGET", "EFI_STATUS", "WIND_COV"),
    *("GPS_RTCM_DATA", "ADSB_VEHICLE", "DEBUG_VECT", "NAMED_VALUE_FLOAT"),
    *("STATUSTEXT", "DEBUG", "CAMERA_IMAGE_CAPTURED", "MOUNT_ORIENTATION"),
    *("GIMBAL_MANAGER_INFORMATION", "GIMBAL_MANAGER_STATUS", "GIMBAL_DEVICE_INFORMATION"),
    *("GIMBAL_DEVICE_SET_ATTITUDE", "GIMBAL_DEVICE_ATTITUDE_STATUS"),
    *("OBSTACLE_DISTANCE", "RAW_RPM", "DEBUG_FLOAT_ARRAY", "FIGURE_EIGHT_EXECUTION_STATUS"),
    *("OPEN_DRONE_ID_BASIC_ID", "OPEN_DRONE_ID_LOCATION", "OPEN_DRONE_ID_SYSTEM"),
)
"""Streams of PX4 without content here, because the vehicle lacks the device.

A real PX4 accepts a rate for these streams and sends nothing, as does this simulator. Source: the
ids accepted by SET_MESSAGE_INTERVAL on a running PX4 1.16."""


def _nothing(state: AutopilotState) -> None:
    """Return None: the stream has no content."""


SILENT: Mapping[str, Builder] = MappingProxyType(dict.fromkeys(_SILENT, _nothing))

_PACKED = (
    *("ATTITUDE", "ATTITUDE_QUATERNION", "LOCAL_POSITION_NED", "ODOMETRY"),
    *("GLOBAL_POSITION_INT", "HIGHRES_IMU", "ALTITUDE", "ATTITUDE_TARGET"),
    *("POSITION_TARGET_LOCAL_NED", "POSITION_TARGET_GLOBAL_INT"),
    *("SERVO_OUTPUT_RAW", "VFR_HUD", "GPS_RAW_INT"),
)

BUILDERS: Mapping[str, Builder | None] = MappingProxyType(
    {
        **SILENT,
        "HEARTBEAT": status.heartbeat,
        **dict.fromkeys(_PACKED),
        "EXTENDED_SYS_STATE": status.extended_sys_state,
        "SYS_STATUS": None,
        "ESTIMATOR_STATUS": status.estimator_status,
        "SCALED_PRESSURE": sensor_streams.scaled_pressure,
        # PX4's simulator sends one measurement to two barometers.
        "SCALED_PRESSURE2": sensor_streams.scaled_pressure,
        "MISSION_CURRENT": status.mission_current,
        "FENCE_STATUS": status.fence_status,
        "HOME_POSITION": pose.home_position,
        "GPS_GLOBAL_ORIGIN": pose.gps_global_origin,
        "AUTOPILOT_VERSION": status.autopilot_version,
        "ORBIT_EXECUTION_STATUS": pose.orbit_execution_status,
        "AUTOPILOT_STATE_FOR_GIMBAL_DEVICE": status.autopilot_state_for_gimbal_device,
        "CURRENT_MODE": information.current_mode,
        "ESC_INFO": None,
        "ESC_STATUS": None,
        "ACTUATOR_OUTPUT_STATUS": sensor_streams.actuator_output_status,
        "HIL_ACTUATOR_CONTROLS": sensor_streams.hil_actuator_controls,
        "SCALED_IMU": sensor_streams.scaled_imu,
        "FLIGHT_INFORMATION": information.flight_information,
        "PROTOCOL_VERSION": information.protocol_version,
        "HIGH_LATENCY2": status.high_latency2,
        # Last, because start times of streams depend on their order.
        **dict.fromkeys(("DISTANCE_SENSOR", "OPTICAL_FLOW_RAD"), _nothing),
    }
)
"""Streams that need only the snapshot; the server adds the others, of sensors (`sensor_table`) too.
None = packed by compiled code (`telemetry`)."""
