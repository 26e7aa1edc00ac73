"""Commander: an explicit transition table by phase and event. Pure: no clock, no I/O.

Arming rules, mode changes, rejections and their texts follow PX4 (measured on PX4 1.16 with MAVSDK
4.1). `failsafes/` holds the failsafe decisions, `AutoDisarm` the disarm timeouts, and `modes/` the
behaviour of each mode.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum, IntEnum, auto
from typing import NamedTuple

from firmware_sim.autopilot.autopilot_state import (
    Arming,
    CommanderStatus,
    Landed,
    OperatorText,
    Result,
    Severity,
)
from firmware_sim.autopilot.events import flight_events as events
from firmware_sim.autopilot.events.definition import ArmingReason, MavlinkEvent, words
from firmware_sim.autopilot.flight_modes import Mode


class FlightPhase(IntEnum):
    """Phase of a flight."""

    BOOT = 0
    """Estimator not converged."""
    STANDBY = 1
    """Ready, disarmed."""
    GROUND = 2
    """Armed, on the ground."""
    AIR = 3
    """Armed, flying."""


class Ask(NamedTuple):
    """User request for a mode."""

    mode: Mode
    available: bool = True
    """True if the mode's requirements are met; offboard: a fresh setpoint."""


class CommanderEvent(Enum):
    """Events other than mode requests."""

    READY = auto()
    """The estimator has converged."""
    NOT_READY = auto()
    """The estimator is no longer converged."""
    ARM = auto()
    ARM_UNREADY = auto()
    """Arm requested although a pre-arm check fails."""
    DISARM = auto()
    KILL = auto()
    """Forced disarm."""
    LIFTED = auto()
    """Lift-off detected by the landing detector."""
    LANDED = auto()
    """Landing detected by the landing detector."""
    MODE_DONE = auto()
    """The mode has reached its goal; take-off: its altitude."""
    DISARM_TIMEOUT = auto()
    """Armed on the ground for COM_DISARM_PRFLT."""
    LANDED_TIMEOUT = auto()
    """Landed for COM_DISARM_LAND."""
    LOCKDOWN_TIMEOUT = auto()
    """Terminated for COM_KILL_DISARM."""
    FAILSAFE_DISARM = auto()
    """A failsafe stops the motors."""


@dataclass(frozen=True, slots=True)
class CommanderState:
    """Complete state of the commander."""

    phase: FlightPhase = FlightPhase.BOOT
    mode: Mode = Mode.HOLD
    """Active mode."""
    intended: Mode = Mode.HOLD
    """Last mode requested by the user."""
    after_disarm: Mode = Mode.HOLD
    """Mode after disarming: the last requested mode except take-off, landing and return."""
    failsafe: bool = False
    """True if a failsafe selected the mode."""


class Choice(Enum):
    """Rule for the next mode in a table row."""

    KEEP = auto()
    """No change."""
    ASK = auto()
    """Switch to `TransitionCell.mode`, requested by the user."""
    RESTORE = auto()
    """Disarmed: return to the last lasting mode."""


@dataclass(frozen=True, slots=True)
class TransitionCell:
    """Cell of the transition table."""

    phase: FlightPhase | None = None
    """Next phase; None = unchanged."""
    choice: Choice = Choice.KEEP
    mode: Mode = Mode.HOLD
    result: Result = Result.ACCEPTED
    text: OperatorText | None = None


def _info(text: str, event: MavlinkEvent) -> OperatorText:
    return OperatorText(Severity.INFO, text, event)


def _critical(text: str, event: MavlinkEvent) -> OperatorText:
    return OperatorText(Severity.CRITICAL, text, event)


_BY_COMMAND = events.ARMED_BY.event(ArmingReason.COMMAND_EXTERNAL)
_IGNORE = TransitionCell()
_TEMP = Result.TEMPORARILY_REJECTED
_NO_ARM = TransitionCell(result=_TEMP, text=OperatorText.of(Severity.CRITICAL, events.ARM_DENIED))
_NOT_LANDED = TransitionCell(
    result=_TEMP, text=OperatorText.of(Severity.CRITICAL, events.DISARM_DENIED)
)
_B, _S, _G, _A = FlightPhase
_ARMED = TransitionCell(phase=_G, text=_info("Armed by external command", _BY_COMMAND))
_LIFTED = TransitionCell(phase=_A, text=OperatorText.of(Severity.INFO, events.TAKEOFF_DETECTED))
_LANDED = TransitionCell(phase=_G, text=OperatorText.of(Severity.INFO, events.LANDING_DETECTED))


def _ask(mode: Mode) -> TransitionCell:
    return TransitionCell(choice=Choice.ASK, mode=mode)


def unavailable(mode: Mode) -> OperatorText:
    """Return the text for the rejection of a mode."""
    text = f"Switching to {mode.spec.title} is currently not available"
    event = events.MODE_NOT_AVAILABLE.event(mode.spec.custom_mode, mode.spec.event)
    return _critical(text, event)


def _asked(mode: Mode) -> tuple[TransitionCell, TransitionCell, TransitionCell, TransitionCell]:
    # PX4 also accepts the mode on the ground and disarmed; the vehicle stays.
    return (_ask(mode),) * 4


def _asked_in_vain(
    mode: Mode,
) -> tuple[TransitionCell, TransitionCell, TransitionCell, TransitionCell]:
    # Disarmed, PX4 accepts any mode and rejects arming if its requirements are unmet.
    rejected = TransitionCell(result=_TEMP, text=unavailable(mode))
    return (_ask(mode), _ask(mode), rejected, rejected)


def _disarm(reason: ArmingReason) -> TransitionCell:
    text = _info(f"Disarmed by {words(reason)}", events.DISARMED_BY.event(reason))
    return TransitionCell(phase=_S, choice=Choice.RESTORE, text=text)


COMMANDED = {
    mode: OperatorText.of(Severity.INFO, mode.spec.command_event, text=mode.spec.command_text)
    for mode in Mode
    if mode.spec.command_event is not None
}
"""Texts for modes with a separate MAVLink command, armed or not; DO_SET_MODE has no text."""

_DISARMED = _disarm(ArmingReason.COMMAND_EXTERNAL)
_UNUSED = _disarm(ArmingReason.AUTO_DISARM_PREFLIGHT)
_LOCKED, _CUT = _disarm(ArmingReason.LOCKDOWN), _disarm(ArmingReason.FAILSAFE)
_DENIED = TransitionCell(result=Result.DENIED)

TABLE: dict[
    Ask | CommanderEvent, tuple[TransitionCell, TransitionCell, TransitionCell, TransitionCell]
] = {
    CommanderEvent.READY: (TransitionCell(phase=_S), _IGNORE, _IGNORE, _IGNORE),
    # No transition from air back to boot: the vehicle continues with the estimate as is.
    CommanderEvent.NOT_READY: (_IGNORE, TransitionCell(phase=_B), _IGNORE, _IGNORE),
    CommanderEvent.ARM: (_NO_ARM, _ARMED, _IGNORE, _IGNORE),
    CommanderEvent.ARM_UNREADY: (_NO_ARM, _NO_ARM, _IGNORE, _IGNORE),
    CommanderEvent.DISARM: (_IGNORE, _IGNORE, _DISARMED, _NOT_LANDED),
    CommanderEvent.KILL: (_IGNORE, _IGNORE, _DISARMED, _DISARMED),
    CommanderEvent.LIFTED: (_IGNORE, _IGNORE, _LIFTED, _IGNORE),
    CommanderEvent.LANDED: (_IGNORE, _IGNORE, _IGNORE, _LANDED),
    CommanderEvent.MODE_DONE: (_IGNORE, _IGNORE, _IGNORE, _ask(Mode.HOLD)),
    CommanderEvent.DISARM_TIMEOUT: (_IGNORE, _IGNORE, _UNUSED, _IGNORE),
    CommanderEvent.LANDED_TIMEOUT: (
        _IGNORE,
        _IGNORE,
        _disarm(ArmingReason.AUTO_DISARM_LAND),
        _IGNORE,
    ),
    CommanderEvent.LOCKDOWN_TIMEOUT: (_IGNORE, _IGNORE, _LOCKED, _LOCKED),
    CommanderEvent.FAILSAFE_DISARM: (_IGNORE, _IGNORE, _CUT, _CUT),
    **{Ask(mode): _asked(mode) for mode in Mode},
    **{Ask(mode, available=False): _asked_in_vain(mode) for mode in Mode},
    # There is nothing to terminate while disarmed.
    Ask(Mode.TERMINATION): (_DENIED, _DENIED, _ask(Mode.TERMINATION), _ask(Mode.TERMINATION)),
}
"""[event][phase]: effect of an event in BOOT, STANDBY, GROUND and AIR; tests cover every pair."""


def _unless_ignored(event: CommanderEvent, phase: FlightPhase) -> CommanderEvent | None:
    # `is`: only the shared cell of an event without effect counts.
    return None if TABLE[event][phase] is _IGNORE else event


READINESS = tuple(
    (_unless_ignored(CommanderEvent.NOT_READY, phase), _unless_ignored(CommanderEvent.READY, phase))
    for phase in FlightPhase
)
"""[phase][estimator healthy]: event to handle, None if the table ignores it. Looked up in every
tick."""


@dataclass(frozen=True, slots=True)
class EventOutcome:
    """Outcome of an event."""

    flight: CommanderState
    result: Result
    text: OperatorText | None


def transition(flight: CommanderState, event: Ask | CommanderEvent) -> EventOutcome:
    """Return the outcome of an event for a flight. Termination has no exit."""
    # Terminated vehicles accept no mode, and their mode does not end.
    if flight.mode is Mode.TERMINATION:
        if isinstance(event, Ask):
            return EventOutcome(flight, _TEMP, unavailable(event.mode))
        if event is CommanderEvent.MODE_DONE:
            return EventOutcome(flight, Result.ACCEPTED, None)
    row = TABLE[event][flight.phase]
    phase = flight.phase if row.phase is None else row.phase
    moved = replace(flight, phase=phase)
    if row.choice is Choice.ASK:
        lasting = row.mode if row.mode.spec.lasting else flight.after_disarm
        moved = replace(
            moved, mode=row.mode, intended=row.mode, after_disarm=lasting, failsafe=False
        )
    elif row.choice is Choice.RESTORE:
        mode = flight.after_disarm
        moved = replace(moved, mode=mode, intended=mode, failsafe=False)
    return EventOutcome(moved, row.result, row.text)


def status_of(flight: CommanderState) -> CommanderStatus:
    """Return the reported status of a state."""
    arming = (Arming.BOOT, Arming.STANDBY, Arming.ARMED, Arming.ARMED)[flight.phase]
    if flight.phase is not FlightPhase.AIR:
        landed = Landed.ON_GROUND
    # Take-off is a separate landed state in MAVLink's extended state.
    elif flight.mode is Mode.TAKEOFF:
        landed = Landed.TAKEOFF
    elif flight.mode is Mode.LAND:
        landed = Landed.LANDING
    else:
        landed = Landed.IN_AIR
    return CommanderStatus(arming, flight.mode, flight.intended, landed, flight.failsafe)
