"""Default stream rates of the links, as measured on a real PX4 1.16 SITL.

Messages that PX4 sends and we do not are left out: EVENT and CURRENT_EVENT_SEQUENCE,
LINK_NODE_STATUS (its counts depend on when clients speak, and a flight's telemetry must not),
OPEN_DRONE_ID_*. The tables' order is the order on the wire when several messages are due in the
same tick.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from airl_mav.core.constants import US_PER_S

ONBOARD_HZ: Mapping[str, float] = MappingProxyType(
    {
        "HEARTBEAT": 1.0,
        "TIMESYNC": 10.0,
        "ATTITUDE": 100.0,
        "ATTITUDE_QUATERNION": 50.0,
        "LOCAL_POSITION_NED": 30.0,
        "ODOMETRY": 30.0,
        "GLOBAL_POSITION_INT": 50.0,
        "HIGHRES_IMU": 50.0,
        "ALTITUDE": 10.0,
        "ATTITUDE_TARGET": 10.0,
        "POSITION_TARGET_LOCAL_NED": 10.0,
        "POSITION_TARGET_GLOBAL_INT": 10.0,
        "SERVO_OUTPUT_RAW": 10.0,
        "VFR_HUD": 10.0,
        "GPS_RAW_INT": 10.0,
        "EXTENDED_SYS_STATE": 5.0,
        "SYS_STATUS": 5.0,
        "ESTIMATOR_STATUS": 1.0,
        "PING": 1.0,
        "SCALED_PRESSURE": 1.0,
        "SYSTEM_TIME": 1.0,
        "MISSION_CURRENT": 1.0,
        "BATTERY_STATUS": 0.5,
        "HOME_POSITION": 0.5,
        "VIBRATION": 0.5,
        "CURRENT_MODE": 0.5,
        "TIME_ESTIMATE_TO_TARGET": 0.5,
        "ORBIT_EXECUTION_STATUS": 5.0,
        "ESC_INFO": 10.0,
        "ESC_STATUS": 10.0,
        "RC_CHANNELS": 20.0,
        "DISTANCE_SENSOR": 10.0,
        "OPTICAL_FLOW_RAD": 10.0,
    }
)
"""Onboard (API) link, 14580 -> 14540 [Hz]."""

GCS_HZ: Mapping[str, float] = MappingProxyType(
    {
        "HEARTBEAT": 1.0,
        "ATTITUDE": 50.0,
        "ATTITUDE_QUATERNION": 50.0,
        "LOCAL_POSITION_NED": 50.0,
        "GLOBAL_POSITION_INT": 50.0,
        "ATTITUDE_TARGET": 50.0,
        "POSITION_TARGET_LOCAL_NED": 50.0,
        "POSITION_TARGET_GLOBAL_INT": 1.0,
        "SERVO_OUTPUT_RAW": 50.0,
        "GPS_RAW_INT": 5.0,
        "VFR_HUD": 4.0,
        "ALTITUDE": 1.0,
        "EXTENDED_SYS_STATE": 1.0,
        "SCALED_PRESSURE": 1.0,
        "SYS_STATUS": 1.0,
        "MISSION_CURRENT": 1.0,
        "BATTERY_STATUS": 0.5,
        "ESTIMATOR_STATUS": 0.5,
        "HOME_POSITION": 0.5,
        "PING": 0.1,
        "VIBRATION": 0.1,
        "CURRENT_MODE": 0.5,
        "TIME_ESTIMATE_TO_TARGET": 0.5,
        "ORBIT_EXECUTION_STATUS": 5.0,
        "ESC_INFO": 1.0,
        "ESC_STATUS": 1.0,
        "RC_CHANNELS": 5.0,
        "DISTANCE_SENSOR": 0.5,
        "OPTICAL_FLOW_RAD": 1.0,
    }
)
"""Ground station link, 18570 -> 14550 [Hz]."""


PAYLOAD_RATE = 0.1432
"""PX4 gives the payload link 4,000 bytes a second, and slows its streams down to fit. Measured."""

PAYLOAD_HZ: Mapping[str, float] = MappingProxyType(
    {
        name: hz if name in ("HEARTBEAT", "PING", "MISSION_CURRENT", "GPS_RAW_INT") else slowed
        for name, hz, slowed in ((name, hz, hz * PAYLOAD_RATE) for name, hz in ONBOARD_HZ.items())
    }
)
"""Payload link, 14280 -> 14030 [Hz]: PX4's onboard mode, slower."""

GIMBAL_HZ: Mapping[str, float] = MappingProxyType(
    {"HEARTBEAT": 1.0, "AUTOPILOT_STATE_FOR_GIMBAL_DEVICE": 20.0, "MISSION_CURRENT": 1.0}
)
"""Gimbal link, 13030 -> 13280 [Hz]."""


def interval_us(rate_hz: float) -> int:
    """Return the interval of a rate [µs]; 0 Hz gives 0 (off)."""
    return round(US_PER_S / rate_hz) if rate_hz > 0.0 else 0
