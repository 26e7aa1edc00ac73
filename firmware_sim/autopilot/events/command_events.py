"""Events of rejected commands and setpoints, and of calibrations.

Source: PX4 1.16, commander/Commander.cpp, commander/rc_calibration.cpp,
mavlink/mavlink_receiver.cpp, navigator/navigator_main.cpp, flight_mode_manager/tasks/Orbit.
"""

from __future__ import annotations

from firmware_sim.autopilot.events.definition import Level, critical, define, error, wrong

# --- commands

ARM_PARAMETER = wrong(
    "commander_unsupported_arm_disarm_param", "Unsupported ARM_DISARM param: {1:.3}", "float param1"
)
ARM_WHILE_CALIBRATING = critical("commander_arm_denied_calibrating", "Arming denied: calibrating")
AUTO_MODE_UNSUPPORTED = wrong(
    "commander_unsupported_auto_mode",
    "Unsupported auto mode",
)
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
