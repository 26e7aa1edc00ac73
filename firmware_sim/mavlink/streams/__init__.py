"""Streamed messages: tables of message names with their builder functions.

A new message is a builder function and a line in `BUILDERS` or `VEHICLE_BUILDERS`, or in a module
of an add-on's table STREAMS.

Sources of fields, units and "unknown" values: MAVLink common.xml and PX4
src/modules/mavlink/streams/*.hpp.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache
from types import MappingProxyType

from airl_mav.core.addons import entries, load
from firmware_sim.autopilot.autopilot import BuiltinAutopilot
from firmware_sim.autopilot.snapshot import AutopilotState
from firmware_sim.interfaces import TrueState
from firmware_sim.mavlink.codec import SYSTEM_ID, Values
from firmware_sim.mavlink.streams import sensors, status

Builder = Callable[[AutopilotState], "Values | None"]
"""Returns one message's fields, in order of definition, from a snapshot; None = no content yet.
Plain values: creating message objects takes longer than all the rest."""


def no_content(state: AutopilotState) -> None:
    """Return None: the stream has no content."""


_PACKED = (
    *("ATTITUDE", "ATTITUDE_QUATERNION", "LOCAL_POSITION_NED", "ODOMETRY"),
    *("GLOBAL_POSITION_INT", "HIGHRES_IMU", "ALTITUDE", "ATTITUDE_TARGET"),
    *("POSITION_TARGET_LOCAL_NED", "POSITION_TARGET_GLOBAL_INT"),
    *("SERVO_OUTPUT_RAW", "VFR_HUD", "GPS_RAW_INT"),
)

BUILDERS: Mapping[str, Builder | None] = MappingProxyType(
    {
        "HEARTBEAT": status.heartbeat,
        **dict.fromkeys(_PACKED),
        "EXTENDED_SYS_STATE": status.extended_sys_state,
        "SYS_STATUS": None,
        "ESTIMATOR_STATUS": status.estimator_status,
        "SCALED_PRESSURE": sensors.scaled_pressure,
        "MISSION_CURRENT": status.mission_current,
        "HOME_POSITION": status.home_position,
        "GPS_GLOBAL_ORIGIN": status.gps_global_origin,
        "ORBIT_EXECUTION_STATUS": status.orbit_execution_status,
        "AUTOPILOT_STATE_FOR_GIMBAL_DEVICE": status.autopilot_state_for_gimbal_device,
        "CURRENT_MODE": status.current_mode,
        "ESC_INFO": None,
        "ESC_STATUS": None,
        **dict.fromkeys(("DISTANCE_SENSOR", "OPTICAL_FLOW_RAD"), no_content),
    }
)
"""Streams that need only the snapshot. None = packed by compiled code (`telemetry`). The server
adds the streams of further sensors (`sensor_table`)."""


@cache
def addon_builders() -> dict[str, Builder]:
    """Return the streams of add-ons (table STREAMS: modules with BUILDERS)."""
    modules = map(load, entries("firmware_sim", "STREAMS").values())
    return {name: build for module in modules for name, build in module.BUILDERS.items()}


class Vehicle:
    """Source of the streams that need more than the snapshot, for any attached autopilot."""

    port: BuiltinAutopilot

    def __init__(self, boot_unix_us: int) -> None:
        """Start without an autopilot; simulated time 0 is at `boot_unix_us` [µs since 1970]."""
        self.boot_unix_us = boot_unix_us
        self.system_id = SYSTEM_ID
        self.vibration = sensors.VibrationMeter()
        self.truth: Callable[[], TrueState] | None = None

    def attach(
        self, port: BuiltinAutopilot, truth: Callable[[], TrueState] | None, system_id: int
    ) -> None:
        """Attach another autopilot, with its vehicle's true state; None = unavailable."""
        self.port, self.truth, self.system_id = port, truth, system_id
        self.vibration = sensors.VibrationMeter()


VEHICLE_BUILDERS: Mapping[str, Callable[[Vehicle, AutopilotState], Values | None]] = (
    MappingProxyType(
        {
            "AUTOPILOT_VERSION": lambda vehicle, _state: status.autopilot_version(
                vehicle.port.parameters.release.flight_sw_version
            ),
            "SYSTEM_TIME": lambda vehicle, state: status.system_time(state, vehicle.boot_unix_us),
            "VIBRATION": lambda vehicle, state: vehicle.vibration.message(state),
            "BATTERY_STATUS": lambda vehicle, state: sensors.battery_status(
                state, vehicle.port.parameters
            ),
            "TIME_ESTIMATE_TO_TARGET": lambda vehicle, state: status.time_estimate_to_target(
                state, vehicle.port.parameters.value
            ),
            "HIL_STATE_QUATERNION": lambda vehicle, _state: (
                None
                if (truth := vehicle.truth and vehicle.truth()) is None
                else status.hil_state_quaternion(truth, truth.time_us)
            ),
            "MAG_CAL_REPORT": lambda vehicle, _state: sensors.mag_cal_report(
                vehicle.port.parameters.value
            ),
            "MANUAL_CONTROL": lambda vehicle, state: status.manual_control(
                state, vehicle.system_id
            ),
        }
    )
)
"""Streams that need more than the snapshot. Shared by all links, so each message is built once per
tick."""
