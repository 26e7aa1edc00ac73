"""Failure conditions as one typed snapshot, and the modes that remain available.

Source: PX4 1.16, msg/FailsafeFlags.msg and commander/ModeUtil/mode_requirements.cpp.
"""

from __future__ import annotations

from enum import IntEnum, IntFlag, auto
from typing import NamedTuple

from firmware_sim.autopilot.autopilot_state import Mode


class BatteryWarning(IntEnum):
    """Battery warning level."""

    NONE = 0
    LOW = 1
    CRITICAL = 2
    EMERGENCY = 3


class FenceBreach(NamedTuple):
    """Violated limits of the geofence."""

    distance: bool = False
    """Farther from home than GF_MAX_HOR_DIST."""
    altitude: bool = False
    """Higher above home than GF_MAX_VER_DIST."""
    custom: bool = False
    """Outside the uploaded fence, or inside an exclusion zone."""


NO_BREACH = FenceBreach()


class Conditions(NamedTuple):
    """Current failures; defaults: a healthy vehicle in flight without pilot or mission.

    Names follow PX4's failsafe flags.
    """

    angular_velocity_invalid: bool = False
    attitude_invalid: bool = False
    local_altitude_invalid: bool = False
    local_position_invalid: bool = False
    """Invalid, or less accurate than COM_POS_FS_EPH."""
    local_position_invalid_relaxed: bool = False
    """Invalid at any accuracy."""
    local_velocity_invalid: bool = False
    global_position_invalid: bool = False
    local_position_accuracy_low: bool = False
    """Valid, but less accurate than COM_POS_LOW_EPH."""
    home_position_invalid: bool = False
    auto_mission_missing: bool = True
    offboard_control_signal_lost: bool = True
    manual_control_signal_lost: bool = True
    gcs_connection_lost: bool = True
    battery_warning: BatteryWarning = BatteryWarning.NONE
    battery_low_remaining_time: bool = False
    battery_unhealthy: bool = False
    geofence: FenceBreach = NO_BREACH
    mission_failure: bool = False
    navigator_failure: bool = False
    wind_limit_exceeded: bool = False
    flight_time_limit_exceeded: bool = False
    fd_critical_failure: bool = False
    """Attitude or altitude outside the flight envelope, from the failure detector."""
    fd_esc_arming_failure: bool = False
    fd_imbalanced_prop: bool = False
    fd_motor_failure: bool = False


class Need(IntFlag):
    """Requirements of flight modes."""

    ANGULAR_VELOCITY = auto()
    ATTITUDE = auto()
    ALTITUDE = auto()
    LOCAL_POSITION = auto()
    LOCAL_POSITION_RELAXED = auto()
    GLOBAL_POSITION = auto()
    HOME = auto()
    MISSION = auto()
    OFFBOARD_SIGNAL = auto()
    MANUAL_CONTROL = auto()
    """Pilot input. Its loss does not end a mode: a separate failsafe handles it."""
    CALM_AND_TIME = auto()
    """Wind and flight time within limits; separate failsafes handle violations."""
    NOT_ARMING = auto()
    """Arming is not possible in this mode."""


_LEVEL = Need.ANGULAR_VELOCITY | Need.ATTITUDE
_GUIDED = _LEVEL | Need.LOCAL_POSITION | Need.ALTITUDE
_PILOTED = _LEVEL | Need.LOCAL_POSITION_RELAXED | Need.ALTITUDE

NEEDS: dict[Mode, Need] = {
    Mode.HOLD: _GUIDED | Need.GLOBAL_POSITION | Need.CALM_AND_TIME,
    Mode.TAKEOFF: _GUIDED,
    Mode.OFFBOARD: _LEVEL | Need.OFFBOARD_SIGNAL,
    Mode.LAND: _PILOTED | Need.NOT_ARMING,
    Mode.RETURN: _GUIDED | Need.GLOBAL_POSITION | Need.HOME | Need.NOT_ARMING,
    Mode.POSITION: _PILOTED | Need.MANUAL_CONTROL,
    Mode.ALTITUDE: _LEVEL | Need.ALTITUDE | Need.MANUAL_CONTROL,
    Mode.STABILIZED: _LEVEL | Need.MANUAL_CONTROL,
    Mode.MISSION: _GUIDED | Need.GLOBAL_POSITION | Need.MISSION | Need.CALM_AND_TIME,
    Mode.ORBIT: _GUIDED | Need.NOT_ARMING | Need.CALM_AND_TIME,
    Mode.FOLLOW: _GUIDED | Need.NOT_ARMING | Need.CALM_AND_TIME,
    Mode.MANUAL: Need.MANUAL_CONTROL,
    Mode.ACRO: Need.ANGULAR_VELOCITY | Need.MANUAL_CONTROL,
    Mode.DESCEND: _LEVEL | Need.NOT_ARMING,
    Mode.TERMINATION: Need.NOT_ARMING,
    Mode.PRECISION_LAND: _GUIDED | Need.NOT_ARMING,
}
"""Requirements of each mode."""

# Plain integers: combining flag members is slow.
_FLYING = int(~(Need.MANUAL_CONTROL | Need.CALM_AND_TIME | Need.NOT_ARMING))
_NEEDS = {mode: int(needs) for mode, needs in NEEDS.items()}
_LACKED_BY: dict[str, int] = {
    "angular_velocity_invalid": Need.ANGULAR_VELOCITY.value,
    "attitude_invalid": Need.ATTITUDE.value,
    "local_altitude_invalid": Need.ALTITUDE.value,
    "local_position_invalid": Need.LOCAL_POSITION.value,
    "local_position_invalid_relaxed": Need.LOCAL_POSITION_RELAXED.value,
    "global_position_invalid": Need.GLOBAL_POSITION.value,
    "home_position_invalid": Need.HOME.value,
    "auto_mission_missing": Need.MISSION.value,
    "offboard_control_signal_lost": Need.OFFBOARD_SIGNAL.value,
    "manual_control_signal_lost": Need.MANUAL_CONTROL.value,
    "wind_limit_exceeded": Need.CALM_AND_TIME.value,
    "flight_time_limit_exceeded": Need.CALM_AND_TIME.value,
}
_PLACES = tuple((Conditions._fields.index(name), bit) for name, bit in _LACKED_BY.items())


def missing(conditions: Conditions) -> int:
    """Return the requirements that are currently unmet, as bits of `Need`."""
    lacks = 0
    for place, bit in _PLACES:
        if conditions[place]:
            lacks |= bit
    return lacks


def can_run(mode: Mode, conditions: Conditions) -> bool:
    """Return whether a failsafe may select a mode or keep it."""
    return not _NEEDS[mode] & missing(conditions) & _FLYING


def lacking(mode: Mode, conditions: Conditions) -> Need:
    """Return the unmet requirements of a mode in flight; nothing = available."""
    return Need(_NEEDS[mode] & missing(conditions))
