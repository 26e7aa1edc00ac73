"""Operator texts at the start of a failsafe: PX4's text, and the event with its cause.

Source: PX4 1.16, commander/failsafe/framework.cpp.
"""

from __future__ import annotations

from airl_mav.core.constants import US_PER_S
from firmware_sim.autopilot.autopilot_state import Mode, OperatorText, Severity
from firmware_sim.autopilot.events import flight_events as events
from firmware_sim.autopilot.events.definition import MavlinkEvent
from firmware_sim.autopilot.events.enumerations import FailsafeCause
from firmware_sim.autopilot.failsafes.actions import FailsafeAction, FailsafeReason
from firmware_sim.autopilot.mode_numbers import custom_mode

_WARNINGS = {
    FailsafeReason.BATTERY_LOW: events.FAILSAFE_BATTERY_LOW,
    FailsafeReason.BATTERY_CRITICAL: events.FAILSAFE_BATTERY_CRITICAL,
    FailsafeReason.BATTERY_EMERGENCY: events.FAILSAFE_BATTERY_EMERGENCY,
    FailsafeReason.FLIGHT_TIME_LOW: events.FAILSAFE_TIME_LOW,
}
"""Warnings with a specific text."""

_DISENGAGING = (
    FailsafeAction.DESCEND,
    FailsafeAction.FALLBACK_ALTITUDE,
    FailsafeAction.FALLBACK_STABILIZED,
)

_CAUSES = dict(zip(FailsafeReason, FailsafeCause, strict=True))


def announcement(
    action: FailsafeAction,
    delayed: FailsafeAction,
    cause: FailsafeReason,
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
    waits = action is FailsafeAction.HOLD and delayed is not FailsafeAction.NONE
    seconds = (delay_us + US_PER_S // 2) // US_PER_S
    text = "Failsafe activated"
    if waits:
        text = f"{text}: entering Hold for {seconds} seconds"
        event = _wait(delayed, cause, custom_mode(intended), seconds)
    elif action is FailsafeAction.WARN:
        event = _warning(cause, custom_mode(intended))
    else:
        event = _beginning(action, cause, custom_mode(intended))
    return OperatorText(Severity.CRITICAL, text, event)


def _wait(delayed: FailsafeAction, cause: FailsafeReason, mode: int, seconds: int) -> MavlinkEvent:
    if cause is FailsafeReason.GENERIC:
        return events.FAILSAFE_HOLD_GENERIC.event(mode, delayed, seconds)
    return events.FAILSAFE_HOLD.event(mode, delayed, seconds, _CAUSES[cause])


def _warning(cause: FailsafeReason, mode: int) -> MavlinkEvent:
    if cause is FailsafeReason.GENERIC:
        return events.FAILSAFE_WARN_GENERIC.event(mode)
    named = _WARNINGS.get(cause)
    return named.event() if named else events.FAILSAFE_WARN.event(mode, _CAUSES[cause])


def _beginning(action: FailsafeAction, cause: FailsafeReason, mode: int) -> MavlinkEvent:
    if cause is not FailsafeReason.GENERIC:
        return events.FAILSAFE.event(mode, action, _CAUSES[cause])
    if action in _DISENGAGING:
        return events.FAILSAFE_DISENGAGED.event(mode, action)
    return events.FAILSAFE_GENERIC.event(mode, action)
