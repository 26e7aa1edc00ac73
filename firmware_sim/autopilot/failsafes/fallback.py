"""Fallback chains for modes and failsafe actions that cannot run.

Source: PX4 1.16, Failsafe::checkModeFallback and FailsafeBase::getSelectedAction.
"""

from __future__ import annotations

from firmware_sim.autopilot.autopilot_state import Mode
from firmware_sim.autopilot.failsafes.actions import Action
from firmware_sim.autopilot.failsafes.conditions import NEEDS, Conditions, Need, can_run
from firmware_sim.autopilot.failsafes.settings import Settings

MODE_OF_ACTION = {
    Action.FALLBACK_POSITION: Mode.POSITION,
    Action.FALLBACK_ALTITUDE: Mode.ALTITUDE,
    Action.FALLBACK_STABILIZED: Mode.STABILIZED,
    Action.HOLD: Mode.HOLD,
    Action.RETURN: Mode.RETURN,
    Action.LAND: Mode.LAND,
    Action.DESCEND: Mode.DESCEND,
    Action.TERMINATE: Mode.TERMINATION,
}
"""Mode of each action; other actions keep the intended mode. In ascending order: if a mode cannot
run, the next action replaces it."""

OFFBOARD_LOSS: dict[int, tuple[Action, Mode | None]] = {
    0: (Action.FALLBACK_POSITION, Mode.POSITION),
    1: (Action.FALLBACK_ALTITUDE, Mode.ALTITUDE),
    2: (Action.FALLBACK_STABILIZED, Mode.STABILIZED),
    3: (Action.RETURN, Mode.RETURN),
    4: (Action.LAND, Mode.LAND),
    5: (Action.HOLD, Mode.HOLD),
    6: (Action.TERMINATE, Mode.TERMINATION),
    7: (Action.DISARM, None),
}
"""COM_OBL_RC_ACT: action, and the mode whose requirements apply from there on."""


def mode_of(action: Action, intended: Mode) -> Mode:
    """Return the action's mode, or the intended mode if the action has none."""
    return MODE_OF_ACTION.get(action, intended)


def possible(action: Action, conditions: Conditions) -> Action:
    """Return the action, or the next possible one in the chain, which ends at Terminate."""
    if action not in MODE_OF_ACTION:
        return action
    chain = (a for a in MODE_OF_ACTION if a >= action)
    return next((a for a in chain if can_run(MODE_OF_ACTION[a], conditions)), Action.TERMINATE)


def mode_fallback(conditions: Conditions, settings: Settings, intended: Mode) -> Action:
    """Return the replacement of an intended mode that cannot run; NONE = it can."""
    action, mode = Action.NONE, intended
    if conditions.offboard_control_signal_lost and NEEDS[mode] & Need.OFFBOARD_SIGNAL:
        action, next_mode = OFFBOARD_LOSS.get(settings.com_obl_rc_act, OFFBOARD_LOSS[0])
        if next_mode is None:
            return action
        mode = next_mode
    if settings.com_posctl_navl == 0:
        if mode is Mode.POSITION and not can_run(mode, conditions):
            action, mode = Action.FALLBACK_ALTITUDE, Mode.ALTITUDE
        if mode is Mode.ALTITUDE and not can_run(mode, conditions):
            action, mode = Action.FALLBACK_STABILIZED, Mode.STABILIZED
    elif settings.com_posctl_navl == 1 and mode is Mode.POSITION and not can_run(mode, conditions):
        action, mode = Action.LAND, Mode.LAND
        if not can_run(mode, conditions):
            action, mode = Action.DESCEND, Mode.DESCEND
    return action if can_run(mode, conditions) else Action.RETURN
