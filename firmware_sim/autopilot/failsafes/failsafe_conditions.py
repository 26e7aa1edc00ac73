"""Failure conditions and actions, failsafe parameters, and the modes that remain available.

Source: PX4 1.16, msg/FailsafeFlags.msg, commander/ModeUtil/mode_requirements.cpp and
commander/failsafe/framework.h.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from enum import Enum, IntEnum, auto
from typing import Any, NamedTuple

from firmware_sim.autopilot.events.definition import FailsafeAction, FailsafeCause
from firmware_sim.autopilot.flight_modes import Mode, Need

LONGEST_S = 1e6
"""Limit of every value, so that times in microseconds do not overflow [s]."""


class FailsafeSettings(NamedTuple):
    """Failsafe parameters: the field name in capitals; defaults are PX4's.

    PX4's simulated airframe sets COM_LOW_BAT_ACT to 3 and COM_RC_IN_MODE to 1.
    """

    com_act_fail_act: int = 0
    com_dll_except: int = 0
    com_fail_act_t: float = 5.0
    com_fltt_low_act: int = 0
    com_lkdown_tko: float = 3.0
    com_low_bat_act: int = 0
    com_obl_rc_act: int = 0
    com_pos_low_act: int = 3
    com_rc_in_mode: int = 3
    com_rcl_except: int = 0
    com_spoolup_time: float = 1.0
    cbrk_flightterm: int = 121212
    gf_action: int = 2
    nav_dll_act: int = 0
    nav_rcl_act: int = 2


def read_settings(defaults: Mapping[str, Any], value: Callable[[str], float]) -> Iterator[Any]:
    """Yield parameters by the names of settings, clipped to `LONGEST_S`."""
    for name, default in defaults.items():
        # The default's type keeps integer parameters integers.
        yield type(default)(min(max(value(name.upper()), -LONGEST_S), LONGEST_S))


FLIGHT_TERMINATION_OFF = 121212
"""Value of CBRK_FLIGHTTERM that disables flight termination by the failure detector."""


BatteryWarning = IntEnum("BatteryWarning", "NONE LOW CRITICAL EMERGENCY", start=0)
"""Battery warning level."""


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
    geofence: FenceBreach = NO_BREACH
    flight_time_limit_exceeded: bool = False
    fd_critical_failure: bool = False
    """Attitude or altitude outside the flight envelope, from the failure detector."""
    fd_motor_failure: bool = False


# Plain integers: combining flag members is slow.
_FLYING = int(~(Need.MANUAL_CONTROL | Need.CALM_AND_TIME | Need.NOT_ARMING))
_NEEDS = {mode: int(mode.spec.needs) for mode in Mode}
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


class Clear(Enum):
    """End of an action after its condition has cleared."""

    WITH_CONDITION = auto()
    """Immediately."""
    ON_MODE_CHANGE = auto()
    """Upon a mode selection by the user, or at disarming."""
    NEVER = auto()


class Takeover(IntEnum):
    """Rule for pilot takeover during an action. The strictest of several takes effect."""

    ALWAYS = 0
    MODE_SWITCH = 1
    """Takeover by mode selection, not by sticks."""
    AUTO = 2
    """Like ALWAYS after COM_FAIL_ACT_T in Hold; like MODE_SWITCH if that time is zero."""
    NEVER = 3


class Options(NamedTuple):
    """Response of a failsafe to its condition."""

    action: FailsafeAction
    clear: Clear = Clear.WITH_CONDITION
    takeover: Takeover = Takeover.AUTO
    cause: FailsafeCause = FailsafeCause.GENERIC
