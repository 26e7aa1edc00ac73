"""Events of the health and arming checks: reasons against arming, by mode.

Names, texts, components and levels: PX4 1.16, commander/HealthAndArmingChecks.
"""

from __future__ import annotations

from typing import NamedTuple

from firmware_sim.autopilot.events.definition import (
    Argument,
    Component,
    Definition,
    Level,
    arguments,
)

_ABOUT = arguments("navigation_mode_group_t modes, uint8_t health_component_index")
"""First arguments of every check: affected modes and component."""

_FIRST = arguments("uint8_t instance")


class CheckEvent(NamedTuple):
    """Event of a check, with its component."""

    definition: Definition
    component: Component
    values: tuple[float, ...] = ()
    """Additional arguments."""

    @property
    def is_health(self) -> bool:
        """True for a hardware fault, False for an unmet arming requirement."""
        return self.definition.group == "health"


def _check(
    name: str,
    message: str,
    component: Component,
    level: Level = Level.ERROR,
    description: str = "",
    parameters: str = "",
) -> CheckEvent:
    """Return a check; `parameters` configure it if there is no description."""
    if parameters:
        named = " and ".join(f"<param>{each}</param>" for each in parameters.split())
        description = f"Configured by {named}."
    return CheckEvent(
        Definition(name, message, _ABOUT, level, description=description, group="arming_check"),
        component,
    )


def _health(
    name: str,
    message: str,
    component: Component,
    *extra: Argument,
    level: Level = Level.ERROR,
) -> CheckEvent:
    definition = Definition(name, message, _ABOUT + extra, level, group="health")
    return CheckEvent(definition, component, (0,) * len(extra))


_C, _L = Component, Level
_SYSTEM, _ESTIMATE = Component.SYSTEM, Component.LOCAL_POSITION_ESTIMATE
_NOT_ENOUGH = "The available positioning data is not enough for the mode."

ACCEL_NO_DATA = _health(
    "check_accel_no_data", "No valid data from Accelerometer {3}", _C.ACCEL, *_FIRST
)
GYRO_NO_DATA = _health("check_gyro_no_data", "No valid data from Gyro {3}", _C.GYRO, *_FIRST)
BARO_NO_DATA = _health(
    "check_baro_no_data", "No valid data from barometer {3}", _C.ABSOLUTE_PRESSURE, *_FIRST
)
MAG_NO_DATA = _health(
    "check_mag_no_data", "No valid data from Compass {3}", _C.MAGNETOMETER, *_FIRST
)
GPS_FIX_TOO_LOW = _check(
    "check_estimator_gps_fix_too_low", "GPS fix too low", _C.GPS, parameters="COM_ARM_WO_GPS"
)
DISTANCE_SENSOR_MISSING = _health(
    "check_distance_sensor_missing", "Distance sensor {3} missing", _C.DISTANCE_SENSOR, *_FIRST
)
DISTANCE_SENSOR_INVALID = _health(
    "check_distance_sensor_invalid",
    "No valid data from distance sensor {3}",
    _C.DISTANCE_SENSOR,
    *_FIRST,
)
BATTERY_LOW = _check(
    "check_battery_low",
    "Low battery",
    _C.BATTERY,
    _L.WARNING,
    "The charge is below <param>BAT_LOW_THR</param>.",
)
BATTERY_CRITICAL = _check(
    "check_battery_critical",
    "Critical battery",
    _C.BATTERY,
    _L.CRITICAL,
    "The charge is below <param>BAT_CRIT_THR</param>.",
)
BATTERY_EMERGENCY = _check(
    "check_battery_emergency",
    "Emergency battery level",
    _C.BATTERY,
    _L.CRITICAL,
    "The charge is below <param>BAT_EMERGEN_THR</param>.",
)
BATTERY_UNHEALTHY = _health("check_battery_unhealthy", "Battery unhealthy", _C.BATTERY)
BATTERY_TIME_LOW = _check(
    "check_battery_rem_flight_time_low", "Remaining flight time low", _C.BATTERY
)
ESTIMATOR_MISSING = _check(
    "check_estimator_missing_data", "Waiting for estimator to initialize", _ESTIMATE, _L.INFO
)
HEADING_UNSTABLE = _check(
    "check_estimator_heading_not_stable", "Heading estimate not stable", _ESTIMATE
)
_MAG_INTERFERENCE = Definition(
    "check_estimator_mag_interference",
    "Strong magnetic interference",
    _ABOUT
    + arguments("float strength, float strength_ref, float inclination, float inclination_ref"),
    Level.WARNING,
    description="Configured by <param>COM_ARM_MAG_STR</param>.",
    group="arming_check",
)
MAG_INTERFERENCE = CheckEvent(_MAG_INTERFERENCE, _ESTIMATE, (float("nan"),) * 4)
"""Field strength [gauss] and inclination [deg], measured and expected: not available here."""
ROLLED = _check(
    "check_failure_detector_roll",
    "Attitude failure detected",
    _SYSTEM,
    _L.CRITICAL,
    "Roll exceeds <param>FD_FAIL_R</param>.",
)
PITCHED = _check(
    "check_failure_detector_pitch",
    "Attitude failure detected",
    _SYSTEM,
    _L.CRITICAL,
    "Pitch exceeds <param>FD_FAIL_P</param>.",
)
MOTOR_FAILED = _health(
    "check_failure_detector_motor", "Motor failure detected", _C.MOTORS_ESCS, level=_L.CRITICAL
)
FENCE_DISTANCE = _check(
    "check_gf_violation_max_hor_dist",
    "Geofence violation: exceeding maximum distance to Home",
    _SYSTEM,
    parameters="GF_ACTION GF_MAX_HOR_DIST",
)
FENCE_ALTITUDE = _check(
    "check_gf_violation_max_alt",
    "Geofence violation: exceeding maximum altitude above Home",
    _SYSTEM,
    parameters="GF_ACTION GF_MAX_VER_DIST",
)
FENCE_CUSTOM = _check(
    "check_gf_violation_custom_gf",
    "Geofence violation: approaching or outside geofence",
    _SYSTEM,
    parameters="GF_ACTION",
)
FENCE_NO_HOME = _check("check_gf_no_home", "Geofence RTL requires valid home", _SYSTEM)
MISSION_FAILURE = _check("check_mission_failure", "Mission cannot be completed", _SYSTEM)
FLIGHT_TIME = _check(
    "check_flight_time_limit", "Maximum flight time reached", _SYSTEM, parameters="COM_FLT_TIME_MAX"
)
NO_GCS = _check(
    "check_rc_dl_no_dllink",
    "No connection to the ground control station",
    _C.COMMUNICATION_LINKS,
    parameters="NAV_DLL_ACT",
)
TERMINATED = _check(
    "check_system_flight_term_active", "Flight termination active", _SYSTEM, _L.CRITICAL
)
NO_GLOBAL_POSITION = _check(
    "check_system_no_global_pos",
    "Global position estimate required",
    _SYSTEM,
    parameters="COM_ARM_WO_GPS",
)
NO_HOME = _check(
    "check_system_no_home_pos", "Home position required", _SYSTEM, parameters="COM_ARM_WO_GPS"
)
MODE_CANNOT_ARM = _check(
    "check_modes_cannot_takeoff",
    "Mode not suitable for arming",
    _SYSTEM,
    _L.INFO,
    "Switch to another mode first.",
)
MODE_ATTITUDE = _check(
    "check_modes_attitude",
    "No valid attitude estimate",
    _C.ATTITUDE_ESTIMATE,
    _L.CRITICAL,
    "Wait until the estimator has initialized.",
)
MODE_LOCAL_POSITION = _check(
    "check_modes_local_pos",
    "Navigation error: No valid position estimate",
    _ESTIMATE,
    description=_NOT_ENOUGH,
)
MODE_GLOBAL_POSITION = _check(
    "check_modes_global_pos",
    "Navigation error: No valid global position estimate",
    _C.GLOBAL_POSITION_ESTIMATE,
    description=_NOT_ENOUGH,
)
MODE_ALTITUDE = _check(
    "check_modes_local_alt",
    "Navigation error: No valid altitude estimate",
    _SYSTEM,
    _L.CRITICAL,
    _NOT_ENOUGH,
)
MODE_MISSION = _check(
    "check_modes_mission", "No valid mission available", _SYSTEM, _L.INFO, "Upload a mission first."
)
MODE_OFFBOARD = _check(
    "check_modes_offboard_signal",
    "No offboard signal",
    _SYSTEM,
    description="Setpoints are not sent, or the commanded quantity is not estimated.",
)
MODE_HOME = _check("check_modes_home_position", "Home position not set", _SYSTEM, _L.INFO)
MODE_MANUAL = _check(
    "check_modes_manual_control",
    "No manual control input",
    _C.REMOTE_CONTROL,
    _L.WARNING,
    "Connect sticks, or choose a mode that needs none.",
)


def _summary(name: str, message: str, group: str, listed: str) -> Definition:
    return Definition(name, message, arguments(listed), Level.PROTOCOL, None, "", group, "summary")


ARMING_SUMMARY = _summary(
    "commander_arming_check_summary",
    "Arming check summary event",
    "arming_check",
    "uint8_t chunk_idx, health_component_t error, health_component_t warning, "
    "navigation_mode_group_t can_arm, navigation_mode_group_t can_run",
)
HEALTH_SUMMARY = _summary(
    "commander_health_summary",
    "Health report summary event",
    "health",
    "uint8_t chunk_idx, health_component_t is_present, health_component_t error, "
    "health_component_t warning",
)
