"""Table of failsafes: condition, parameter, action. One row per failsafe, pure.

Source: PX4 1.16 to 1.18, commander/failsafe/failsafe.cpp (checkStateAndMode and its callees); the
differences between these releases are in `FailsafeRules`. Not applicable to this vehicle and
omitted: VTOL transitions, ESC arming failure, imbalanced propellers, parachutes, wind limits, and
failures of battery, mission and navigator.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple

from airl_mav.core.constants import US_PER_S
from airl_mav.profiles.px4_release import FailsafeRules, px4_release
from firmware_sim.autopilot.events.definition import FailsafeAction, FailsafeCause
from firmware_sim.autopilot.failsafes import failsafe_conditions
from firmware_sim.autopilot.flight_modes import Mode, Need

MODE_OF_ACTION = {
    FailsafeAction.FALLBACK_POSCTRL: Mode.POSITION,
    FailsafeAction.FALLBACK_ALTCTRL: Mode.ALTITUDE,
    FailsafeAction.FALLBACK_STABILIZED: Mode.STABILIZED,
    FailsafeAction.HOLD: Mode.HOLD,
    FailsafeAction.RTL: Mode.RETURN,
    FailsafeAction.LAND: Mode.LAND,
    FailsafeAction.DESCEND: Mode.DESCEND,
    FailsafeAction.TERMINATE: Mode.TERMINATION,
}
"""Mode of each action; other actions keep the intended mode. In ascending order: if a mode cannot
run, the next action replaces it."""

OFFBOARD_LOSS = {
    0: FailsafeAction.FALLBACK_POSCTRL,
    1: FailsafeAction.FALLBACK_ALTCTRL,
    2: FailsafeAction.FALLBACK_STABILIZED,
    3: FailsafeAction.RTL,
    4: FailsafeAction.LAND,
    5: FailsafeAction.HOLD,
    6: FailsafeAction.TERMINATE,
    7: FailsafeAction.DISARM,
}
"""Actions of COM_OBL_RC_ACT."""


def mode_of(action: FailsafeAction, intended: Mode) -> Mode:
    """Return the action's mode, or the intended mode if the action has none."""
    return MODE_OF_ACTION.get(action, intended)


def possible(action: FailsafeAction, conditions: failsafe_conditions.Conditions) -> FailsafeAction:
    """Return the action, or the next possible one in the chain, which ends at Terminate."""
    if action not in MODE_OF_ACTION:
        return action
    # Actions in ascending order: from the requested one to Terminate.
    chain = (a for a in MODE_OF_ACTION if a >= action)
    return next(
        (a for a in chain if failsafe_conditions.can_run(MODE_OF_ACTION[a], conditions)),
        FailsafeAction.TERMINATE,
    )


def mode_fallback(situation: Situation, intended: Mode) -> FailsafeAction:
    """Return the replacement of an intended mode that cannot run; NONE = it can."""
    conditions, settings = situation.conditions, situation.settings
    action, mode = FailsafeAction.NONE, intended
    # Replacements in sequence: offboard loss first, then modes that cannot run.
    if conditions.offboard_control_signal_lost and mode.spec.needs & Need.OFFBOARD_SIGNAL:
        action = OFFBOARD_LOSS.get(settings.com_obl_rc_act, OFFBOARD_LOSS[0])
        if action is FailsafeAction.DISARM:
            return action
        # From here on, the requirements of the action's mode apply.
        mode = MODE_OF_ACTION[action]
    if mode is Mode.POSITION and not failsafe_conditions.can_run(mode, conditions):
        action, mode = FailsafeAction.FALLBACK_ALTCTRL, Mode.ALTITUDE
    # The replacement itself may be impossible: continue to the next one.
    if mode is Mode.ALTITUDE and not failsafe_conditions.can_run(mode, conditions):
        action, mode = FailsafeAction.FALLBACK_STABILIZED, Mode.STABILIZED
    if (
        situation.rules.fallback_needs_pilot
        and conditions.manual_control_signal_lost
        and FailsafeAction.FALLBACK_POSCTRL <= action <= FailsafeAction.FALLBACK_STABILIZED
    ):
        action = _LINK_LOSS.get(settings.nav_rcl_act, NOTHING).action
    return action if failsafe_conditions.can_run(mode, conditions) else FailsafeAction.RTL


NOTHING = failsafe_conditions.Options(FailsafeAction.NONE)


class Situation(NamedTuple):
    """Current state of the vehicle: input of the failsafes."""

    time_us: int
    conditions: failsafe_conditions.Conditions
    settings: failsafe_conditions.FailsafeSettings
    intended: Mode
    """Mode requested by the user."""
    mission_finished: bool = False
    armed_us: int | None = None
    """Time of arming; None = disarmed."""
    manual_control_lost_at_arming: bool = False
    """Manual control was lost at arming and has not returned: it is optional."""
    battery_at_arming: failsafe_conditions.BatteryWarning = failsafe_conditions.BatteryWarning.NONE
    armed: bool = False
    rules: FailsafeRules = px4_release().failsafes


Trigger = Enum(
    "Trigger",
    "MANUAL_CONTROL GCS MISSION_WITHOUT_LINKS FLIGHT_TIME POSITION_ACCURACY GEOFENCE "
    "REMAINING_TIME BATTERY_LOW BATTERY_CRITICAL BATTERY_EMERGENCY ATTITUDE MOTOR MODE_FALLBACK",
)
"""Cause of a failsafe; one action is held per trigger."""


@dataclass(frozen=True, slots=True)
class Row:
    """Failsafe."""

    trigger: Trigger
    title: str
    when: str
    """Condition, for the manual."""
    occurs: Callable[[Situation], bool]
    answers: Mapping[int, failsafe_conditions.Options]
    """Responses by parameter value; a row without a parameter has key 0 only."""
    parameter: str | None = None
    otherwise: failsafe_conditions.Options = NOTHING
    """Response to an undefined parameter value."""
    related: tuple[str, ...] = ()
    """Other parameters of the condition."""
    value: Callable[[Situation], int] | None = None
    """Key into `answers` if it differs from the parameter's value."""
    checked: Callable[[Situation], bool] = lambda _: True
    """False in situations where the condition does not count."""

    def options(self, situation: Situation) -> failsafe_conditions.Options:
        """Return the response if the failsafe is triggered in a situation."""
        if self.value is not None:
            chosen = self.value(situation)
        elif self.parameter is not None:
            chosen = getattr(situation.settings, self.parameter.lower())
        else:
            chosen = 0
        return self.answers.get(chosen, self.otherwise)


_STICKS_OFF = 4
"""COM_RC_IN_MODE: stick input disabled."""
_EXCEPTIONS = {Mode.MISSION: 1, Mode.HOLD: 2, Mode.TAKEOFF: 2, Mode.OFFBOARD: 4}
"""Bit of each mode in COM_RCL_EXCEPT and COM_DLL_EXCEPT."""

_AUTO_MODES = (Mode.LAND, Mode.RETURN, Mode.DESCEND, Mode.FOLLOW, Mode.PRECISION_LAND, Mode.ORBIT)
"""Further modes of Hold's bit since PX4 1.18."""

_NONE, _WARN, _HOLD = (
    NOTHING,
    failsafe_conditions.Options(FailsafeAction.WARN),
    failsafe_conditions.Options(FailsafeAction.HOLD),
)
_RETURN = failsafe_conditions.Options(FailsafeAction.RTL, failsafe_conditions.Clear.ON_MODE_CHANGE)
_LAND = failsafe_conditions.Options(FailsafeAction.LAND, failsafe_conditions.Clear.ON_MODE_CHANGE)
_LASTING_HOLD = failsafe_conditions.Options(
    FailsafeAction.HOLD, failsafe_conditions.Clear.ON_MODE_CHANGE
)
_TERMINATE = failsafe_conditions.Options(
    FailsafeAction.TERMINATE, failsafe_conditions.Clear.NEVER, failsafe_conditions.Takeover.NEVER
)
_DISARM = failsafe_conditions.Options(
    FailsafeAction.DISARM, takeover=failsafe_conditions.Takeover.NEVER
)


def _caused(
    answers: Mapping[int, failsafe_conditions.Options], cause: FailsafeCause
) -> dict[int, failsafe_conditions.Options]:
    return {value: options._replace(cause=cause) for value, options in answers.items()}


_LANDING = (Mode.LAND, Mode.PRECISION_LAND)
_LINK_LOSS = {0: _NONE, 1: _LASTING_HOLD, 2: _RETURN, 3: _LAND, 5: _TERMINATE, 6: _DISARM}
"""Responses of NAV_RCL_ACT and NAV_DLL_ACT."""

_ESCAPABLE_HOLD = _LASTING_HOLD._replace(takeover=failsafe_conditions.Takeover.MODE_SWITCH)
_LIMITS = {0: _NONE, 1: _WARN, 2: _ESCAPABLE_HOLD, 3: _RETURN, 4: _TERMINATE, 5: _LAND}
"""Responses of GF_ACTION."""

_POSITION_LOW = {
    value: failsafe_conditions.Options(action, takeover=failsafe_conditions.Takeover.MODE_SWITCH)
    for value, action in enumerate(
        (
            FailsafeAction.NONE,
            FailsafeAction.WARN,
            FailsafeAction.HOLD,
            FailsafeAction.RTL,
            FailsafeAction.TERMINATE,
            FailsafeAction.LAND,
        )
    )
} | {4: _TERMINATE}

_ACTUATOR = {
    0: _WARN,
    1: _HOLD,
    2: _LAND,
    3: _RETURN,
    4: failsafe_conditions.Options(FailsafeAction.TERMINATE, failsafe_conditions.Clear.NEVER),
}


def _exempt(s: Situation, exceptions: int) -> bool:
    """Return whether the loss of a link is exempt in this mode, by bits of a parameter."""
    mode = s.intended
    if s.rules.exceptions_cover_auto_modes and mode in _AUTO_MODES:
        mode = Mode.HOLD
    return bool(exceptions & _EXCEPTIONS.get(mode, 0))


def ignores_manual_control(s: Situation) -> bool:
    """Return whether the loss of manual control is exempt in this mode (COM_RCL_EXCEPT)."""
    return s.manual_control_lost_at_arming or _exempt(s, s.settings.com_rcl_except)


def _uses_manual_control(s: Situation) -> bool:
    return s.settings.com_rc_in_mode != _STICKS_OFF and not ignores_manual_control(s)


def _uses_ground_station(s: Situation) -> bool:
    exempt = s.intended in _LANDING or _exempt(s, s.settings.com_dll_except)
    counts = s.armed or not s.rules.gcs_loss_needs_arming
    return s.settings.nav_dll_act != 0 and counts and not exempt


def _without_links(s: Situation) -> bool:
    """Return whether a mission is finished and no link failsafe applies."""
    # COM_RC_IN_MODE 4, or the exception for missions: a loss of the sticks does not act.
    unwatched = s.settings.com_rc_in_mode == _STICKS_OFF or _exempt(s, s.settings.com_rcl_except)
    finished = s.intended is Mode.MISSION and s.mission_finished
    return finished and unwatched and s.settings.nav_dll_act == 0


def _taking_off(s: Situation) -> bool:
    """Return whether COM_SPOOLUP_TIME + COM_LKDOWN_TKO after arming are not over."""
    limit_s = s.settings.com_lkdown_tko + s.settings.com_spoolup_time
    return s.armed_us is not None and s.time_us < s.armed_us + limit_s * US_PER_S


def _terminates(s: Situation) -> bool:
    return s.settings.cbrk_flightterm != failsafe_conditions.FLIGHT_TERMINATION_OFF


def _battery_action(s: Situation) -> int:
    """Return COM_LOW_BAT_ACT; 0 unless the battery warning is worse than at arming."""
    # A battery that was low at arming warns, but does not act.
    worse = s.conditions.battery_warning > s.battery_at_arming
    return s.settings.com_low_bat_act if worse else 0


def _battery_row(
    trigger: Trigger,
    level: failsafe_conditions.BatteryWarning,
    title: str,
    cause: FailsafeCause,
    actions: tuple[FailsafeAction, ...],
) -> Row:
    threshold = ("", "BAT_LOW_THR", "BAT_CRIT_THR", "BAT_EMERGEN_THR")[level]
    return Row(
        trigger,
        title,
        "the charge is below its limit, and was not at arming",
        lambda _: True,
        {
            value: failsafe_conditions.Options(action, cause=cause)
            for value, action in enumerate(actions)
        },
        "COM_LOW_BAT_ACT",
        failsafe_conditions.Options(FailsafeAction.WARN, cause=cause),
        related=(threshold,),
        value=_battery_action,
        checked=lambda s: s.conditions.battery_warning is level,
    )


_W, _R, _L = FailsafeAction.WARN, FailsafeAction.RTL, FailsafeAction.LAND

TABLE: tuple[Row, ...] = (
    Row(
        Trigger.MANUAL_CONTROL,
        "Manual control lost",
        "no pilot's input for so long, unless there was none at arming",
        lambda s: s.conditions.manual_control_signal_lost,
        _caused(_LINK_LOSS, FailsafeCause.MANUAL_CONTROL_LOSS),
        "NAV_RCL_ACT",
        related=("COM_RC_LOSS_T", "COM_RC_IN_MODE", "COM_RCL_EXCEPT"),
        checked=_uses_manual_control,
    ),
    Row(
        Trigger.GCS,
        "Ground station lost",
        "no ground station's HEARTBEAT for so long; not in Land or Precision Landing",
        lambda s: s.conditions.gcs_connection_lost,
        _caused(_LINK_LOSS, FailsafeCause.GCS_CONNECTION_LOSS),
        "NAV_DLL_ACT",
        related=("COM_DL_LOSS_T", "COM_DLL_EXCEPT"),
        checked=_uses_ground_station,
    ),
    Row(
        Trigger.MISSION_WITHOUT_LINKS,
        "No link after the mission",
        "the mission is finished, the ground station lost and NAV_DLL_ACT 0, manual control unused",
        lambda s: s.conditions.gcs_connection_lost,
        {0: failsafe_conditions.Options(FailsafeAction.RTL)},
        related=("NAV_DLL_ACT", "COM_RC_IN_MODE", "COM_RCL_EXCEPT"),
        checked=_without_links,
    ),
    Row(
        Trigger.FLIGHT_TIME,
        "Flight time over",
        "so long since take-off",
        lambda s: s.conditions.flight_time_limit_exceeded,
        {0: failsafe_conditions.Options(FailsafeAction.RTL)},
        related=("COM_FLT_TIME_MAX",),
    ),
    Row(
        Trigger.POSITION_ACCURACY,
        "Position accuracy low",
        "the position is valid, but less accurate than asked for, in Mission and Hold",
        lambda s: s.conditions.local_position_accuracy_low,
        _POSITION_LOW,
        "COM_POS_LOW_ACT",
        failsafe_conditions.Options(
            FailsafeAction.WARN, takeover=failsafe_conditions.Takeover.MODE_SWITCH
        ),
        related=("COM_POS_LOW_EPH",),
        checked=lambda s: s.intended in (Mode.MISSION, Mode.HOLD),
    ),
    Row(
        Trigger.GEOFENCE,
        "Geofence breached",
        "too far from home, too high above it, or outside the uploaded fence",
        lambda s: any(s.conditions.geofence),
        _LIMITS,
        "GF_ACTION",
        failsafe_conditions.Options(FailsafeAction.WARN),
        related=("GF_MAX_HOR_DIST", "GF_MAX_VER_DIST"),
    ),
    Row(
        Trigger.REMAINING_TIME,
        "Remaining flight time low",
        "the battery lasts no longer than a return takes",
        lambda s: s.conditions.battery_low_remaining_time,
        _caused({0: _NONE, 1: _WARN, 3: _RETURN}, FailsafeCause.LOW_REMAINING_FLIGHT_TIME),
        "COM_FLTT_LOW_ACT",
        related=("BAT1_CAPACITY", "RTL_TIME_FACTOR", "RTL_TIME_MARGIN"),
    ),
    _battery_row(
        Trigger.BATTERY_LOW,
        failsafe_conditions.BatteryWarning.LOW,
        "Battery low",
        FailsafeCause.LOW_BATTERY_LEVEL,
        (_W, _W, _W, _W),
    ),
    _battery_row(
        Trigger.BATTERY_CRITICAL,
        failsafe_conditions.BatteryWarning.CRITICAL,
        "Battery critical",
        FailsafeCause.CRITICAL_BATTERY_LEVEL,
        (_W, _R, _L, _R),
    ),
    _battery_row(
        Trigger.BATTERY_EMERGENCY,
        failsafe_conditions.BatteryWarning.EMERGENCY,
        "Battery empty",
        FailsafeCause.EMERGENCY_BATTERY_LEVEL,
        (_W, _R, _L, _L),
    ),
    Row(
        Trigger.ATTITUDE,
        "Attitude failure at take-off",
        "roll or pitch out of limits, within COM_SPOOLUP_TIME + COM_LKDOWN_TKO of arming",
        lambda s: s.conditions.fd_critical_failure,
        {0: failsafe_conditions.Options(FailsafeAction.DISARM)},
        related=("FD_FAIL_R", "FD_FAIL_P", "FD_FAIL_R_TTRI", "FD_FAIL_P_TTRI", "COM_LKDOWN_TKO"),
        checked=_taking_off,
    ),
    Row(
        Trigger.ATTITUDE,
        "Attitude failure in flight, CBRK_FLIGHTTERM 0",
        "roll or pitch out of limits",
        lambda s: s.conditions.fd_critical_failure,
        {0: failsafe_conditions.Options(FailsafeAction.TERMINATE)},
        related=("FD_FAIL_R", "FD_FAIL_P", "FD_FAIL_R_TTRI", "FD_FAIL_P_TTRI", "CBRK_FLIGHTTERM"),
        checked=lambda s: not _taking_off(s) and _terminates(s),
    ),
    Row(
        Trigger.ATTITUDE,
        "Attitude failure in flight",
        "roll or pitch out of limits",
        lambda s: s.conditions.fd_critical_failure,
        {0: _WARN},
        related=("FD_FAIL_R", "FD_FAIL_P", "FD_FAIL_R_TTRI", "FD_FAIL_P_TTRI", "CBRK_FLIGHTTERM"),
        checked=lambda s: not _taking_off(s) and not _terminates(s),
    ),
    Row(
        Trigger.MOTOR,
        "Motor failure",
        "a motor draws too little current for what it is told",
        lambda s: s.conditions.fd_motor_failure,
        _ACTUATOR,
        "COM_ACT_FAIL_ACT",
        _WARN,
        related=("FD_ACT_EN", "FD_ACT_MOT_THR", "FD_ACT_MOT_C2T", "FD_ACT_MOT_TOUT"),
    ),
)
"""All failsafes except the last, added by `answers`: the fallback of a mode that cannot run."""


def answers(situation: Situation) -> dict[Trigger, failsafe_conditions.Options | None]:
    """Return the checked triggers with their responses; None = no failure.

    As in PX4, responses without an action belong to them: they begin the delay of later ones.
    """
    found = {
        row.trigger: row.options(situation) if row.occurs(situation) else None
        for row in TABLE
        if row.checked(situation)
    }
    # The fallback of a mode is not a table row: it depends on several parameters.
    fallback = mode_fallback(situation, situation.intended)
    always = failsafe_conditions.Options(fallback, takeover=failsafe_conditions.Takeover.ALWAYS)
    found[Trigger.MODE_FALLBACK] = None if fallback is FailsafeAction.NONE else always
    return found
