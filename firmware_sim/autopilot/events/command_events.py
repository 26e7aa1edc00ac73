"""Events of commands and setpoints that are refused, and of calibrations.

Names, words, arguments and levels: PX4 1.16, commander/Commander.cpp, commander/rc_calibration.cpp,
mavlink/mavlink_receiver.cpp, navigator/navigator_main.cpp, flight_mode_manager/tasks/Orbit.
"""

from __future__ import annotations

from firmware_sim.autopilot.events.definition import Level, critical, define, error

# --- commands

ARM_PARAMETER = define(
    "commander_unsupported_arm_disarm_param",
    "Unsupported ARM_DISARM param: {1:.3}",
    "float param1",
    level=Level.ERROR,
)
ARM_WHILE_CALIBRATING = critical("commander_arm_denied_calibrating", "Arming denied: calibrating")
AUTO_MODE_UNSUPPORTED = define(
    "commander_unsupported_auto_mode", "Unsupported auto mode", level=Level.ERROR
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

LOCAL_FRAME = define(
    "mavlink_rcv_sp_target_unsup_coord",
    "SET_POSITION_TARGET_LOCAL_NED: coordinate frame {1} unsupported",
    "uint8_t coordinate_frame",
    level=Level.ERROR,
)
LOCAL_FORCE = define(
    "mavlink_rcv_sp_target_unsup_force",
    "SET_POSITION_TARGET_LOCAL_NED: FORCE is not supported",
    level=Level.ERROR,
)
LOCAL_INVALID = define(
    "mavlink_rcv_sp_target_invalid",
    "SET_POSITION_TARGET_LOCAL_NED: invalid, missing position, velocity or acceleration",
    level=Level.ERROR,
)
GLOBAL_FRAME = define(
    "mavlink_rcv_sp_target_gl_invalid_coord",
    "SET_POSITION_TARGET_GLOBAL_INT invalid coordinate frame {1}",
    "uint8_t coordinate_frame",
    level=Level.ERROR,
)
GLOBAL_FORCE = define(
    "mavlink_rcv_sp_target_gl_unsup_force",
    "SET_POSITION_TARGET_GLOBAL_INT: FORCE is not supported",
    level=Level.ERROR,
)
LANDING_TARGET_FRAME = define(
    "mavlink_rcv_lnd_target_unsup_coord",
    "Landing target: unsupported coordinate frame {1}",
    "uint8_t frame",
    level=Level.ERROR,
)

OBSTACLE_FRAME = define(
    "col_prev_unsup_frame",
    "Obstacle message received in unsupported frame {1}",
    "uint8_t frame",
    level=Level.ERROR,
)
ODOMETRY_ESTIMATOR = define(
    "mavlink_rcv_odom_unsup_estimator_type",
    "ODOMETRY: unsupported estimator_type {1}",
    "uint8_t estimator_type",
    level=Level.ERROR,
)

# --- calibrations

RC_CALIBRATION = define("commander_calib_rc_off", "Calibration: Disabling RC input")
RC_CALIBRATED = define("commander_calib_rc_on", "Calibration: Restoring RC input")
TRIMMED = define("commander_cal_trim_done", "RC trim calibration completed")
