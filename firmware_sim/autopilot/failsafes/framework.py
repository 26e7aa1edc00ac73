"""Failsafe framework: selects and times the active action. A pure state machine.

A triggered failsafe is held until its row's end condition. The highest held action takes effect. An
action that permits takeover waits in Hold for COM_FAIL_ACT_T first. If the action's mode cannot
run, the next in the chain replaces it. Source: PX4 1.16, commander/failsafe/framework.cpp.
"""

from __future__ import annotations

from typing import NamedTuple

from airl_mav.core.constants import US_PER_S
from firmware_sim.autopilot.autopilot_state import OperatorText, Severity
from firmware_sim.autopilot.events import flight_events as events
from firmware_sim.autopilot.events.definition import FailsafeAction, FailsafeCause
from firmware_sim.autopilot.failsafes import failsafe_table
from firmware_sim.autopilot.failsafes.failsafe_conditions import (
    BatteryWarning,
    Clear,
    Conditions,
    FailsafeSettings,
    Options,
    Takeover,
    can_run,
)
from firmware_sim.autopilot.flight_modes import Mode

_GENERIC = FailsafeCause.GENERIC

_WARNINGS = {
    FailsafeCause.LOW_BATTERY_LEVEL: events.FAILSAFE_BATTERY_LOW,
    FailsafeCause.CRITICAL_BATTERY_LEVEL: events.FAILSAFE_BATTERY_CRITICAL,
    FailsafeCause.EMERGENCY_BATTERY_LEVEL: events.FAILSAFE_BATTERY_EMERGENCY,
    FailsafeCause.LOW_REMAINING_FLIGHT_TIME: events.FAILSAFE_TIME_LOW,
}
"""Warnings with a specific text."""

_DISENGAGING = (
    FailsafeAction.DESCEND,
    FailsafeAction.FALLBACK_ALTCTRL,
    FailsafeAction.FALLBACK_STABILIZED,
)


def announcement(
    action: FailsafeAction,
    delayed: FailsafeAction,
    cause: FailsafeCause,
    intended: Mode,
    delay_us: int,
) -> OperatorText:
    """Return the message for an action that starts.

    Args:
        action: Active action.
        delayed: Action after the delay in Hold; NONE = no delay.
        cause: Cause named in the text.
        intended: Mode requested by the user.
        delay_us: Remaining delay [µs].
    """
    text, mode, generic = "Failsafe activated", intended.spec.custom_mode, cause is _GENERIC
    # The text counts the delay only while Hold precedes another action.
    if action is FailsafeAction.HOLD and delayed is not FailsafeAction.NONE:
        # Rounded to whole seconds.
        seconds = (delay_us + US_PER_S // 2) // US_PER_S
        text = f"{text}: entering Hold for {seconds} seconds"
        if generic:
            event = events.FAILSAFE_HOLD_GENERIC.event(mode, delayed, seconds)
        else:
            event = events.FAILSAFE_HOLD.event(mode, delayed, seconds, cause)
    elif action is FailsafeAction.WARN and cause in _WARNINGS:
        event = _WARNINGS[cause].event()
    elif action is FailsafeAction.WARN and generic:
        event = events.FAILSAFE_WARN_GENERIC.event(mode)
    elif action is FailsafeAction.WARN:
        event = events.FAILSAFE_WARN.event(mode, cause)
    elif not generic:
        event = events.FAILSAFE.event(mode, action, cause)
    elif action in _DISENGAGING:
        event = events.FAILSAFE_DISENGAGED.event(mode, action)
    else:
        event = events.FAILSAFE_GENERIC.event(mode, action)
    return OperatorText(Severity.CRITICAL, text, event)


class Intervention(NamedTuple):
    """User actions since the last update."""

    mode_chosen: bool = False
    """A mode was requested, including the current intended mode."""
    sticks_moved: bool = False
    """The pilot takes over by moving the sticks."""


NO_INTERVENTION = Intervention()


class Held(NamedTuple):
    """Active action."""

    trigger: failsafe_table.Trigger
    options: Options
    failing: bool
    """True while the condition persists."""


class FailsafeState(NamedTuple):
    """State of the failsafe framework."""

    held: tuple[Held, ...] = ()
    action: FailsafeAction = FailsafeAction.NONE
    """Active action."""
    taken_over: bool = False
    """The user continues to fly despite the failsafe."""
    time_us: int | None = None
    """Time of the last update [µs]."""
    armed: bool = False
    intended: Mode | None = None
    start_delay_us: int | None = None
    """Duration of the next delay in Hold [µs]; None = COM_FAIL_ACT_T."""
    delay_us: int = 0
    """Remaining time of the current delay in Hold [µs]."""
    armed_us: int | None = None
    manual_control_lost_at_arming: bool = False
    battery_at_arming: BatteryWarning = BatteryWarning.NONE

    @property
    def active(self) -> bool:
        """True if a failsafe determines the mode."""
        return self.action > FailsafeAction.WARN


class FailsafeResult(NamedTuple):
    """Result of an update."""

    state: FailsafeState
    mode: Mode
    """Active mode."""
    intended: Mode
    """Mode intended by the user; the sticks may have changed it."""
    text: OperatorText | None
    """New message for the operator; None = no change."""
    delayed: FailsafeAction = FailsafeAction.NONE
    """Action after the delay in Hold."""
    cause: FailsafeCause = _GENERIC


class _Choice(NamedTuple):
    """Selected action with its attributes."""

    action: FailsafeAction
    intended: Mode
    delayed: FailsafeAction = FailsafeAction.NONE
    cause: FailsafeCause = _GENERIC
    taken_over: bool = False


def update(
    state: FailsafeState,
    now: failsafe_table.Situation,
    intervention: Intervention = NO_INTERVENTION,
) -> FailsafeResult:
    """Return the active mode and action.

    Args:
        state: State after the last update; a new one after boot.
        now: Current situation. Its time must not decrease; the state has the data of arming.
        intervention: User actions since the last update.
    """
    elapsed_us = 0 if state.time_us is None else now.time_us - state.time_us
    # A changed intended mode is a selection, too.
    chosen = intervention.mode_chosen or (
        state.intended is not None and state.intended is not now.intended
    )
    state = _begin(state, now, elapsed_us)
    # Arming and disarming end actions that last until a mode change.
    if state.armed is not now.armed:
        state = state._replace(held=_released(state.held), taken_over=False)
    if chosen or state.taken_over:
        state = state._replace(held=_released(state.held))
    state, warned = _hold(state, now)
    # No delay without Hold: a stronger action, a takeover, or Hold is impossible.
    stronger = state.action > FailsafeAction.HOLD
    if stronger or state.taken_over or not can_run(Mode.HOLD, now.conditions):
        state = state._replace(delay_us=0)
    choice = _select(state, now, intervention._replace(mode_chosen=chosen))
    text = None
    # Announce stronger actions, and new warnings of an unchanged action.
    if choice.action > state.action or (choice.action is not FailsafeAction.NONE and warned):
        text = announcement(
            choice.action, choice.delayed, choice.cause, now.intended, state.delay_us
        )
    intended = choice.intended
    if state.active and failsafe_table.mode_of(choice.action, intended) is Mode.ORBIT:
        intended = Mode.HOLD  # Orbit does not resume after an interruption.
    state = state._replace(
        action=choice.action,
        taken_over=choice.taken_over,
        time_us=now.time_us,
        armed=now.armed,
        intended=intended,
        start_delay_us=_start_delay(state, now.settings, elapsed_us, choice.delayed),
    )
    mode = failsafe_table.mode_of(choice.action, intended)
    return FailsafeResult(state, mode, intended, text, choice.delayed, choice.cause)


def _begin(state: FailsafeState, now: failsafe_table.Situation, elapsed_us: int) -> FailsafeState:
    """Advance the delays, and store the failures present at arming."""
    state = state._replace(delay_us=max(0, state.delay_us - elapsed_us))
    lost = now.conditions.manual_control_signal_lost
    if now.armed and not state.armed:
        state = state._replace(
            armed_us=now.time_us,
            manual_control_lost_at_arming=lost,
            battery_at_arming=now.conditions.battery_warning,
        )
    elif not now.armed:
        # Nothing is added while disarmed.
        state = state._replace(armed_us=None, manual_control_lost_at_arming=lost)
    # Manual control that returns is required from then on.
    return state if lost else state._replace(manual_control_lost_at_arming=False)


def _released(held: tuple[Held, ...]) -> tuple[Held, ...]:
    """Return the held actions after a mode selection by the user."""
    return tuple(h for h in held if h.failing or h.options.clear is not Clear.ON_MODE_CHANGE)


def _hold(state: FailsafeState, now: failsafe_table.Situation) -> tuple[FailsafeState, bool]:
    """Add new failures, drop cleared ones; return also whether a warning is new."""
    now = now._replace(
        armed_us=state.armed_us,
        manual_control_lost_at_arming=state.manual_control_lost_at_arming,
        battery_at_arming=state.battery_at_arming,
    )
    # One action per trigger; rows of one trigger exclude each other.
    failing = dict(failsafe_table.answers(now))
    held: list[Held] = []
    for item in state.held:
        answer = failing.pop(item.trigger, None)
        if answer is not None:
            # The action may change; end condition and takeover rule stay.
            held.append(Held(item.trigger, item.options._replace(action=answer.action), True))
        elif item.options.clear is not Clear.WITH_CONDITION:
            held.append(item._replace(failing=False))
    warned = False
    # COM_FAIL_ACT_T up to 0.1 s means no delay, as in PX4.
    waits = now.settings.com_fail_act_t > 0.1
    delay_us = state.delay_us
    for trigger, options in failing.items():
        if options.takeover is Takeover.AUTO:
            if waits and options.action is not FailsafeAction.WARN and delay_us == 0:
                delay_us = _next_delay(state, now.settings)
            takeover = Takeover.ALWAYS if waits else Takeover.MODE_SWITCH
            options = options._replace(takeover=takeover)
        held.append(Held(trigger, options, True))
        warned = warned or options.action is FailsafeAction.WARN
        # A new failsafe ends the takeover: the user must confirm it again.
        if options.action >= FailsafeAction.HOLD:
            state = state._replace(taken_over=False)
    return state._replace(held=tuple(held), delay_us=delay_us), warned


def _next_delay(state: FailsafeState, settings: FailsafeSettings) -> int:
    full_us = round(settings.com_fail_act_t * US_PER_S)
    return full_us if state.start_delay_us is None else min(full_us, state.start_delay_us)


def _start_delay(
    state: FailsafeState, settings: FailsafeSettings, elapsed_us: int, delayed: FailsafeAction
) -> int | None:
    """Return the duration of the next delay: an intermittent condition shortens it."""
    remaining = _next_delay(state, settings)
    if delayed is not FailsafeAction.NONE:
        return max(0, remaining - elapsed_us)
    # Used delay does not return at once: it recovers at a quarter of real time.
    remaining += elapsed_us // 4
    return None if remaining >= settings.com_fail_act_t * US_PER_S else remaining


def _select(
    state: FailsafeState, now: failsafe_table.Situation, intervention: Intervention
) -> _Choice:
    # Termination is final.
    if state.action is FailsafeAction.TERMINATE:
        return _Choice(FailsafeAction.TERMINATE, now.intended)
    if not now.armed:
        return _Choice(FailsafeAction.NONE, now.intended)
    # Highest action and strictest takeover rule of all held failsafes.
    worst = Options(FailsafeAction.NONE, takeover=Takeover.ALWAYS)
    strictest = Takeover.ALWAYS
    for item in state.held:
        strictest = max(strictest, item.options.takeover)
        if item.options.action > worst.action:
            worst = item.options
    action, cause, intended = worst.action, worst.cause, now.intended
    delayed = FailsafeAction.NONE
    # During the delay the vehicle waits in Hold, and any mode selection takes over.
    if (
        state.delay_us > 0
        and not state.taken_over
        and strictest <= Takeover.MODE_SWITCH
        and action not in (FailsafeAction.DISARM, FailsafeAction.TERMINATE, FailsafeAction.HOLD)
    ):
        delayed, action, strictest = action, FailsafeAction.HOLD, Takeover.MODE_SWITCH
    # A mode switch in the update that starts the action does not end the action.
    by_mode = intervention.mode_chosen and state.action is action
    takes_over = state.taken_over or by_mode
    if strictest is Takeover.ALWAYS:
        takes_over = takes_over or intervention.sticks_moved
    taken_over = False
    if (
        FailsafeAction.HOLD <= action <= FailsafeAction.DESCEND
        and strictest < Takeover.AUTO
        and takes_over
    ):
        # Sticks take over into Position; a mode selection keeps the selected mode.
        if not state.taken_over and intervention.sticks_moved:
            intended = Mode.POSITION
        action, taken_over, delayed = FailsafeAction.WARN, True, FailsafeAction.NONE
        # The user's mode may be impossible: then its fallback acts.
        action = max(action, failsafe_table.mode_fallback(now.conditions, now.settings, intended))
    possible_now = failsafe_table.possible(action, now.conditions)
    if possible_now is not action:
        action, cause = possible_now, _GENERIC
    if _already_on_the_way(intended, action, delayed, now.conditions):
        action, delayed = FailsafeAction.WARN, FailsafeAction.NONE
    return _Choice(action, intended, delayed, cause, taken_over)


def _already_on_the_way(
    intended: Mode, action: FailsafeAction, delayed: FailsafeAction, conditions: Conditions
) -> bool:
    """Return whether Return is redundant as the vehicle already lands or returns.

    A precision landing also continues instead of an ordinary landing.
    """
    needless = {FailsafeAction.RTL}
    if intended is Mode.PRECISION_LAND:
        needless.add(FailsafeAction.LAND)
    return (
        intended in (Mode.LAND, Mode.RETURN, Mode.PRECISION_LAND)
        and (action in needless or delayed in needless)
        and can_run(intended, conditions)
    )
