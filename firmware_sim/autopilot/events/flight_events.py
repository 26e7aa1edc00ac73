"""Events of a flight: arming, modes, failsafes, missions, links.

Names, arguments and levels: PX4 1.16, commander/Commander.cpp, commander/failsafe/framework.cpp,
commander/HealthAndArmingChecks/checks/rcAndDataLinkCheck.cpp, sensors/voted_sensors_update.cpp and
its kin, navigator/*.cpp.
"""

from __future__ import annotations

from firmware_sim.autopilot.events.definition import Definition, Level, arguments

_CRITICAL, _WARNING = Level.CRITICAL, Level.WARNING
_APPENDED = "append_health_and_arming_messages"
"""Ground stations add the failing checks to the message."""

ARMED_BY = Definition(
    "commander_armed_by", "Armed by {1}", arguments("arm_disarm_reason_t calling_reason")
)
DISARMED_BY = Definition(
    "commander_disarmed_by", "Disarmed by {1}", arguments("arm_disarm_reason_t calling_reason")
)
ARM_DENIED = Definition(
    "commander_arm_denied_resolve_failures",
    "Arming denied: Resolve system health failures first",
    level=_CRITICAL,
    internal=Level.INFO,
)
DISARM_DENIED = Definition(
    "commander_disarm_denied_not_landed",
    "Disarming denied: not landed",
    level=_CRITICAL,
    internal=Level.INFO,
)
TAKEOFF_DETECTED = Definition("commander_takeoff_detected", "Takeoff detected")
LANDING_DETECTED = Definition("commander_landing_detected", "Landing detected")
LANDING_HERE = Definition("commander_landing_current_pos", "Landing at current position")
LANDING_PRECISELY = Definition("commander_landing_prec_land", "Landing using precision landing")
RETURNING = Definition("commander_rtl", "Returning to launch")
MISSION_DENIED = Definition(
    "commander_mission_start_denied_no_mission",
    "Mission start denied! No valid mission",
    level=_CRITICAL,
    internal=Level.INFO,
)
MODE_NOT_AVAILABLE = Definition(
    "commander_modeswitch_not_avail",
    "Switching to mode '{2}' is currently not possible",
    arguments("uint32_t mavlink_mode", "navigation_mode_t mode"),
    _CRITICAL,
    Level.INFO,
    kind=_APPENDED,
)
PILOT_TOOK_OVER = Definition("commander_rc_override", "Pilot took over using sticks")
PILOT_LOST = Definition("commander_rc_lost", "Manual control lost")
PILOT_REGAINED = Definition(
    "commander_rc_regained", "Manual control regained after {1:.1} s", arguments("float elapsed")
)
GCS_LOST = Definition(
    "commander_gcs_lost",
    "Connection to ground control station lost",
    level=_WARNING,
    internal=Level.INFO,
)
GCS_REGAINED = Definition("commander_dl_regained", "GCS connection regained")
GNSS_STOPPED = Definition(
    "check_estimator_gnss_fusion_stopped",
    "GNSS data fusion stopped",
    level=Level.ERROR,
    internal=Level.INFO,
)
GNSS_STARTED = Definition("check_estimator_gnss_fusion_started", "GNSS data fusion started")

_LAND_AND_CHECK = "Land immediately and check the system."
IMU_FAILED = Definition(
    "sensor_failover",
    "{1} sensor #{2} failure: {3}",
    arguments(
        "sensor_type_t sensor_type",
        "uint8_t failover_index",
        "sensor_failover_reason_t failover_reason",
    ),
    Level.EMERGENCY,
    description=_LAND_AND_CHECK,
)
MAG_FAILED = Definition(
    "sensor_failover_mag",
    "Magnetometer sensor #{1} failure: {2}",
    arguments("uint8_t failover_index", "sensor_failover_reason_t failover_reason"),
    Level.EMERGENCY,
    description=_LAND_AND_CHECK,
)
BARO_FAILED = Definition(
    "sensor_failover_baro",
    "Baro sensor #{1} failure: {2}",
    arguments("uint8_t failover_index", "sensor_failover_reason_t failover_reason"),
    Level.EMERGENCY,
    description=_LAND_AND_CHECK,
)

TAKEOFF_DEFAULT = Definition(
    "navigator_takeoff_default_alt",
    "Using default takeoff altitude: {1:.2m}",
    arguments("float min_takeoff_alt"),
)
TAKEOFF_ALREADY_HIGHER = Definition(
    "navigator_takeoff_already_higher",
    "Already higher than takeoff altitude (not descending)",
    level=Level.ERROR,
    internal=Level.INFO,
)
MISSION_EXECUTE = Definition("mission_execute", "Executing Mission")
MISSION_FINISHED = Definition("mission_finished", "Mission finished, landed")
MISSION_FINISHED_LOITER = Definition("mission_finished_loiter", "Mission finished, loitering")
MISSION_REFUSED = Definition(
    "mission_not_valid_refuse",
    "No valid mission available, refusing takeoff",
    level=Level.ERROR,
    internal=Level.DISABLED,
)
MISSION_LOITER = Definition(
    "mission_not_valid_loiter",
    "No valid mission available, loitering",
    level=Level.ERROR,
    internal=Level.DISABLED,
)
MISSION_CLIMB = Definition(
    "mission_climb_before_start",
    "Climb to {1:.1m_v} above home",
    arguments("float mission_init_climb_alt"),
)
RTL_RETURN_AT = Definition(
    "vrtl_return_at",
    "RTL: start return at {1m_v} ({2m_v} above destination)",
    arguments("int32_t rtl_alt", "int32_t rtl_alt_above_destination"),
)
RTL_MISSION_LAND = Definition(
    "rtl_mission_land_climb", "RTL Mission Land: climb to {1m_v}", arguments("int32_t rtl_alt")
)
RTL_LAND = Definition("rtl_land_at_destination", "RTL: land at destination")
RTL_LOITERING = Definition("rtl_completed_loiter", "RTL: completed, loitering")

# What a failsafe says depends on whether it waits first, and whether its cause has words.
_FAILSAFE = (_CRITICAL, Level.WARNING)
FAILSAFE_HOLD_GENERIC = Definition(
    "commander_failsafe_enter_generic_hold",
    "Failsafe activated: switching to {2} in {3} seconds",
    arguments("uint32_t mavlink_mode", "failsafe_action_t action", "uint16_t delay_s"),
    *_FAILSAFE,
    kind=_APPENDED,
)
FAILSAFE_HOLD = Definition(
    "commander_failsafe_enter_hold",
    "{4}: switching to {2} in {3} seconds",
    arguments(
        "uint32_t mavlink_mode",
        "failsafe_action_t action",
        "uint16_t delay_s",
        "failsafe_cause_t cause",
    ),
    *_FAILSAFE,
)
FAILSAFE_WARN_GENERIC = Definition(
    "commander_failsafe_enter_generic_warn",
    "Failsafe warning:",
    arguments("uint32_t mavlink_mode"),
    _WARNING,
    description="No action is triggered.",
    kind=_APPENDED,
)
FAILSAFE_DISENGAGED = Definition(
    "commander_failsafe_enter_autopilot_disengaged",
    "Failsafe activated: Autopilot disengaged, switching to {2}",
    arguments("uint32_t mavlink_mode", "failsafe_action_t action"),
    *_FAILSAFE,
    description="The vehicle no longer holds its position.",
    kind=_APPENDED,
)
FAILSAFE_GENERIC = Definition(
    "commander_failsafe_enter_generic",
    "Failsafe activated: switching to {2}",
    arguments("uint32_t mavlink_mode", "failsafe_action_t action"),
    *_FAILSAFE,
    kind=_APPENDED,
)
FAILSAFE_BATTERY_LOW = Definition(
    "commander_failsafe_enter_low_bat",
    "Low battery level, return advised",
    level=_WARNING,
    internal=Level.INFO,
)
FAILSAFE_BATTERY_CRITICAL = Definition(
    "commander_failsafe_enter_crit_bat_warn",
    "Critical battery level, land now",
    level=_CRITICAL,
    internal=Level.INFO,
)
FAILSAFE_BATTERY_EMERGENCY = Definition(
    "commander_failsafe_enter_crit_low_bat_warn",
    "Emergency battery level, land immediately",
    level=Level.EMERGENCY,
    internal=Level.INFO,
)
FAILSAFE_TIME_LOW = Definition(
    "commander_failsafe_enter_low_flight_time_warn",
    "Low remaining flight time, return advised",
    level=_WARNING,
    internal=Level.INFO,
)
FAILSAFE_WARN = Definition(
    "commander_failsafe_enter_warn",
    "Failsafe warning: {2}",
    arguments("uint32_t mavlink_mode", "failsafe_cause_t cause"),
    _WARNING,
    description="No action is triggered.",
)
FAILSAFE = Definition(
    "commander_failsafe_enter",
    "{3}: switching to {2}",
    arguments("uint32_t mavlink_mode", "failsafe_action_t action", "failsafe_cause_t cause"),
    *_FAILSAFE,
)
