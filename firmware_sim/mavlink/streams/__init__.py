"""The streamed messages: a table from message name to the function that builds it.

Sources of fields, units and "unknown" values: MAVLink common.xml and PX4
src/modules/mavlink/streams/*.hpp.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType

from firmware_sim.autopilot.autopilot_state import AutopilotState
from firmware_sim.mavlink.codec import Values
from firmware_sim.mavlink.streams import (
    actuators,
    distance,
    flight_modes,
    gimbal,
    high_latency,
    information,
    optical_flow,
    pose,
    sensors,
    status,
)
from firmware_sim.mavlink.streams.silent import SILENT

Builder = Callable[[AutopilotState], "Values | None"]
"""Returns one message's fields, in the order of its definition, from a snapshot; None = there is
nothing to say yet. Plain values, because message objects would cost more than all the rest."""

BUILDERS: Mapping[str, Builder | None] = MappingProxyType(
    {
        **SILENT,
        "HEARTBEAT": status.heartbeat,
        "ATTITUDE": None,
        "ATTITUDE_QUATERNION": None,
        "LOCAL_POSITION_NED": None,
        "ODOMETRY": None,
        "GLOBAL_POSITION_INT": None,
        "HIGHRES_IMU": None,
        "ALTITUDE": None,
        "ATTITUDE_TARGET": None,
        "POSITION_TARGET_LOCAL_NED": None,
        "POSITION_TARGET_GLOBAL_INT": None,
        "SERVO_OUTPUT_RAW": None,
        "VFR_HUD": None,
        "GPS_RAW_INT": None,
        "EXTENDED_SYS_STATE": status.extended_sys_state,
        "SYS_STATUS": None,
        "ESTIMATOR_STATUS": status.estimator_status,
        "SCALED_PRESSURE": sensors.scaled_pressure,
        # PX4's simulator hands one measurement to two barometers.
        "SCALED_PRESSURE2": sensors.scaled_pressure,
        "MISSION_CURRENT": status.mission_current,
        "FENCE_STATUS": status.fence_status,
        "HOME_POSITION": pose.home_position,
        "GPS_GLOBAL_ORIGIN": pose.gps_global_origin,
        "AUTOPILOT_VERSION": status.autopilot_version,
        "ORBIT_EXECUTION_STATUS": pose.orbit_execution_status,
        "AUTOPILOT_STATE_FOR_GIMBAL_DEVICE": gimbal.autopilot_state_for_gimbal_device,
        "CURRENT_MODE": flight_modes.current_mode,
        "ESC_INFO": None,
        "ESC_STATUS": None,
        "ACTUATOR_OUTPUT_STATUS": actuators.actuator_output_status,
        "HIL_ACTUATOR_CONTROLS": actuators.hil_actuator_controls,
        "SCALED_IMU": sensors.scaled_imu,
        "FLIGHT_INFORMATION": information.flight_information,
        "PROTOCOL_VERSION": information.protocol_version,
        "HIGH_LATENCY2": high_latency.high_latency2,
        # Last, as it came last: where streams begin depends on their order.
        "DISTANCE_SENSOR": distance.distance_sensor,
        "OPTICAL_FLOW_RAD": optical_flow.optical_flow_rad,
    }
)
"""Streams that need the snapshot only; the server adds those that need more. None:
compiled code packs it (`telemetry`)."""
