"""Events of a flight: arming, modes, failsafes, missions, links.

Names, arguments and levels: PX4 1.16, commander/Commander.cpp, commander/failsafe/framework.cpp,
commander/HealthAndArmingChecks/checks/rcAndDataLinkCheck.cpp, sensors/voted_sensors_update.cpp and
related files, navigator/*.cpp, mavlink/mavlink_mission.cpp.
"""

from __future__ import annotations

from functools import partial

from firmware_sim.autopilot.events.definition import Level, critical, define, error, warning, wrong

_APPENDED = "append_health_and_arming_messages"
"""Event kind for which ground stations append the failing checks to the message."""

ARMED_BY = define("commander_armed_by", "Armed by {1}", "arm_disarm_reason_t calling_reason")
DISARMED_BY = define(
    "commander_disarmed_by", "Disarmed by {1}", "arm_disarm_reason_t calling_reason"
)
ARM_DENIED = critical(
    "commander_arm_denied_resolve_failures", "Arming denied: Resolve system health failures first"
)
DISARM_DENIED = critical("commander_disarm_denied_not_landed", "Disarming denied: not landed")
TAKEOFF_DETECTED = define("commander_takeoff_detected", "Takeoff detected")
LANDING_DETECTED = define("commander_landing_detected", "Landing detected")
LANDING_HERE = define("commander_landing_current_pos", "Landing at current position")
LANDING_PRECISELY = define("commander_landing_prec_land", "Landing using precision landing")
RETURNING = define("commander_rtl", "Returning to launch")
MISSION_DENIED = critical(
    "commander_mission_start_denied_no_mission", "Mission start denied! No valid mission"
)
MODE_NOT_AVAILABLE = critical(
    "commander_modeswitch_not_avail",
    "Switching to mode '{2}' is currently not possible",
    "uint32_t mavlink_mode, navigation_mode_t mode",
    kind=_APPENDED,
)
PILOT_TOOK_OVER = define("commander_rc_override", "Pilot took over using sticks")
PILOT_LOST = define("commander_rc_lost", "Manual control lost")
PILOT_REGAINED = define(
    "commander_rc_regained", "Manual control regained after {1:.1} s", "float elapsed"
)
GCS_LOST = warning("commander_gcs_lost", "Connection to ground control station lost")
GCS_REGAINED = define("commander_dl_regained", "GCS connection regained")
GNSS_STOPPED = error("check_estimator_gnss_fusion_stopped", "GNSS data fusion stopped")
GNSS_STARTED = define("check_estimator_gnss_fusion_started", "GNSS data fusion started")

_LAND_AND_CHECK = "Land immediately and check the system."
IMU_FAILED = define(
    "sensor_failover",
    "{1} sensor #{2} failure: {3}",
    "sensor_type_t sensor_type, uint8_t failover_index, sensor_failover_reason_t failover_reason",
    level=Level.EMERGENCY,
    description=_LAND_AND_CHECK,
)
MAG_FAILED = define(
    "sensor_failover_mag",
    "Magnetometer sensor #{1} failure: {2}",
    "uint8_t failover_index, sensor_failover_reason_t failover_reason",
    level=Level.EMERGENCY,
    description=_LAND_AND_CHECK,
)
BARO_FAILED = define(
    "sensor_failover_baro",
    "Baro sensor #{1} failure: {2}",
    "uint8_t failover_index, sensor_failover_reason_t failover_reason",
    level=Level.EMERGENCY,
    description=_LAND_AND_CHECK,
)

TAKEOFF_DEFAULT = define(
    "navigator_takeoff_default_alt",
    "Using default takeoff altitude: {1:.2m}",
    "float min_takeoff_alt",
)
TAKEOFF_ALREADY_HIGHER = error(
    "navigator_takeoff_already_higher", "Already higher than takeoff altitude (not descending)"
)
RTL_RETURN_AT = define(
    "vrtl_return_at",
    "RTL: start return at {1m_v} ({2m_v} above destination)",
    "int32_t rtl_alt, int32_t rtl_alt_above_destination",
)
RTL_LAND = define("rtl_land_at_destination", "RTL: land at destination")
RTL_LOITERING = define("rtl_completed_loiter", "RTL: completed, loitering")

# The failsafe event depends on a delay in Hold and on a specific cause.
_alarm = partial(define, level=Level.CRITICAL, internal=Level.WARNING)
FAILSAFE_HOLD_GENERIC = _alarm(
    "commander_failsafe_enter_generic_hold",
    "Failsafe activated: switching to {2} in {3} seconds",
    "uint32_t mavlink_mode, failsafe_action_t action, uint16_t delay_s",
    kind=_APPENDED,
)
FAILSAFE_HOLD = _alarm(
    "commander_failsafe_enter_hold",
    "{4}: switching to {2} in {3} seconds",
    "uint32_t mavlink_mode, failsafe_action_t action, uint16_t delay_s, failsafe_cause_t cause",
)
FAILSAFE_WARN_GENERIC = define(
    "commander_failsafe_enter_generic_warn",
    "Failsafe warning:",
    "uint32_t mavlink_mode",
    level=Level.WARNING,
    description="No action is triggered.",
    kind=_APPENDED,
)
FAILSAFE_DISENGAGED = _alarm(
    "commander_failsafe_enter_autopilot_disengaged",
    "Failsafe activated: Autopilot disengaged, switching to {2}",
    "uint32_t mavlink_mode, failsafe_action_t action",
    description="The vehicle no longer holds its position.",
    kind=_APPENDED,
)
FAILSAFE_GENERIC = _alarm(
    "commander_failsafe_enter_generic",
    "Failsafe activated: switching to {2}",
    "uint32_t mavlink_mode, failsafe_action_t action",
    kind=_APPENDED,
)
FAILSAFE_BATTERY_LOW = warning(
    "commander_failsafe_enter_low_bat", "Low battery level, return advised"
)
FAILSAFE_BATTERY_CRITICAL = critical(
    "commander_failsafe_enter_crit_bat_warn", "Critical battery level, land now"
)
FAILSAFE_BATTERY_EMERGENCY = define(
    "commander_failsafe_enter_crit_low_bat_warn",
    "Emergency battery level, land immediately",
    level=Level.EMERGENCY,
    internal=Level.INFO,
)
FAILSAFE_TIME_LOW = warning(
    "commander_failsafe_enter_low_flight_time_warn", "Low remaining flight time, return advised"
)
FAILSAFE_WARN = define(
    "commander_failsafe_enter_warn",
    "Failsafe warning: {2}",
    "uint32_t mavlink_mode, failsafe_cause_t cause",
    level=Level.WARNING,
    description="No action is triggered.",
)
FAILSAFE = _alarm(
    "commander_failsafe_enter",
    "{3}: switching to {2}",
    "uint32_t mavlink_mode, failsafe_action_t action, failsafe_cause_t cause",
)
FENCE_WITHOUT_HOME = _alarm(
    "navigator_geofence_invalid_against_home", "Geofence invalid, doesn't contain Home position"
)
FENCE_WITHOUT_VEHICLE = _alarm(
    "navigator_geofence_invalid_against_cur_pos",
    "Geofence invalid, doesn't contain current vehicle position",
)

ARM_PARAMETER = wrong(
    "commander_unsupported_arm_disarm_param", "Unsupported ARM_DISARM param: {1:.3}", "float param1"
)
ARM_WHILE_CALIBRATING = critical("commander_arm_denied_calibrating", "Arming denied: calibrating")
AUTO_MODE_UNSUPPORTED = wrong("commander_unsupported_auto_mode", "Unsupported auto mode")
NO_HIGH_LATENCY = critical(
    "commander_ctrl_high_latency_failed", "Control high latency failed! Telemetry unavailable"
)
REPOSITION_OUTSIDE = error(
    "navigator_reposition_outside_geofence", "Reposition is outside geofence"
)
ALTITUDE_OUTSIDE = error(
    "navigator_change_altitude_outside_geofence", "Altitude change is outside geofence"
)
ORBIT_TOO_WIDE = define("orbit_radius_exceeded", "Orbit radius limit exceeded", level=Level.ALERT)

# --- setpoints and targets

LOCAL_FRAME = wrong(
    "mavlink_rcv_sp_target_unsup_coord",
    "SET_POSITION_TARGET_LOCAL_NED: coordinate frame {1} unsupported",
    "uint8_t coordinate_frame",
)
LOCAL_FORCE = wrong(
    "mavlink_rcv_sp_target_unsup_force", "SET_POSITION_TARGET_LOCAL_NED: FORCE is not supported"
)
LOCAL_INVALID = wrong(
    "mavlink_rcv_sp_target_invalid",
    "SET_POSITION_TARGET_LOCAL_NED: invalid, missing position, velocity or acceleration",
)
GLOBAL_FRAME = wrong(
    "mavlink_rcv_sp_target_gl_invalid_coord",
    "SET_POSITION_TARGET_GLOBAL_INT invalid coordinate frame {1}",
    "uint8_t coordinate_frame",
)
GLOBAL_FORCE = wrong(
    "mavlink_rcv_sp_target_gl_unsup_force", "SET_POSITION_TARGET_GLOBAL_INT: FORCE is not supported"
)
LANDING_TARGET_FRAME = wrong(
    "mavlink_rcv_lnd_target_unsup_coord",
    "Landing target: unsupported coordinate frame {1}",
    "uint8_t frame",
)

OBSTACLE_FRAME = wrong(
    "col_prev_unsup_frame", "Obstacle message received in unsupported frame {1}", "uint8_t frame"
)
ODOMETRY_ESTIMATOR = wrong(
    "mavlink_rcv_odom_unsup_estimator_type",
    "ODOMETRY: unsupported estimator_type {1}",
    "uint8_t estimator_type",
)

# --- calibrations

RC_CALIBRATION = define("commander_calib_rc_off", "Calibration: Disabling RC input")
RC_CALIBRATED = define("commander_calib_rc_on", "Calibration: Restoring RC input")
TRIMMED = define("commander_cal_trim_done", "RC trim calibration completed")
