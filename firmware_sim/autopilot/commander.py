"""Commander: an explicit transition table by phase and event. Pure: no clock, no I/O.

Arming rules, mode changes, rejections and their texts follow PX4 (measured on PX4 1.16 with MAVSDK
4.1). `failsafes/` holds the failsafe decisions, `AutoDisarm` the disarm timeouts, and `modes/` the
behaviour of each mode.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum, IntEnum, auto
from functools import partial
from typing import NamedTuple

from firmware_sim.autopilot import autopilot_state
from firmware_sim.autopilot.events import flight_events as events
from firmware_sim.autopilot.events.definition import ArmingReason, words
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


@dataclass(frozen=True, slots=True)
class TransitionCell:
    """Cell of the transition table."""

    phase: FlightPhase | None = None
    """Next phase; None = unchanged."""
    mode: Mode | None = None
    """Next mode, requested by the user; None = unchanged."""
    restores_mode: bool = False
    """True if the vehicle is disarmed and returns to the last lasting mode."""
    result: autopilot_state.Result = autopilot_state.Result.ACCEPTED
    text: autopilot_state.OperatorText | None = None


Row = dict[FlightPhase, TransitionCell]
"""Effects of an event by phase; without effect in other phases."""

_info = partial(autopilot_state.OperatorText.of, autopilot_state.Severity.INFO)
_critical = partial(autopilot_state.OperatorText.of, autopilot_state.Severity.CRITICAL)
_TEMP = autopilot_state.Result.TEMPORARILY_REJECTED
_B, _S, _G, _A = FlightPhase
_NO_ARM = TransitionCell(result=_TEMP, text=_critical(events.ARM_DENIED))


def unavailable(mode: Mode) -> autopilot_state.OperatorText:
    """Return the text for the rejection of a mode."""
    text = f"Switching to {mode.spec.title} is currently not available"
    return _critical(events.MODE_NOT_AVAILABLE, mode.spec.custom_mode, mode.spec.event, text=text)


def _available(mode: Mode) -> Row:
    # PX4 also accepts the mode on the ground and disarmed; the vehicle stays.
    return dict.fromkeys(FlightPhase, TransitionCell(mode=mode))


def _not_available(mode: Mode) -> Row:
    # Disarmed, PX4 accepts any mode and rejects arming if its requirements are unmet.
    rejected = TransitionCell(result=_TEMP, text=unavailable(mode))
    return _available(mode) | {_G: rejected, _A: rejected}


def _disarm(reason: ArmingReason) -> TransitionCell:
    text = _info(events.DISARMED_BY, reason, text=f"Disarmed by {words(reason)}")
    return TransitionCell(phase=_S, restores_mode=True, text=text)


COMMANDED = {
    mode: _info(mode.spec.command_event, text=mode.spec.command_text)
    for mode in Mode
    if mode.spec.command_event is not None
}
"""Texts for modes with a separate MAVLink command, armed or not; DO_SET_MODE has no text."""

_ARMED = _info(events.ARMED_BY, ArmingReason.COMMAND_EXTERNAL, text="Armed by external command")
_DISARMED, _LOCKED = _disarm(ArmingReason.COMMAND_EXTERNAL), _disarm(ArmingReason.LOCKDOWN)
_CUT, _DENIED = _disarm(ArmingReason.FAILSAFE), TransitionCell(result=autopilot_state.Result.DENIED)
_NOT_LANDED = TransitionCell(result=_TEMP, text=_critical(events.DISARM_DENIED))

TABLE: dict[Ask | CommanderEvent, Row] = {
    CommanderEvent.READY: {_B: TransitionCell(_S)},
    # No transition from air back to boot: the vehicle continues with the estimate as is.
    CommanderEvent.NOT_READY: {_S: TransitionCell(_B)},
    CommanderEvent.ARM: {_B: _NO_ARM, _S: TransitionCell(_G, text=_ARMED)},
    CommanderEvent.ARM_UNREADY: {_B: _NO_ARM, _S: _NO_ARM},
    CommanderEvent.DISARM: {_G: _DISARMED, _A: _NOT_LANDED},
    CommanderEvent.KILL: {_G: _DISARMED, _A: _DISARMED},
    CommanderEvent.LIFTED: {_G: TransitionCell(_A, text=_info(events.TAKEOFF_DETECTED))},
    CommanderEvent.LANDED: {_A: TransitionCell(_G, text=_info(events.LANDING_DETECTED))},
    CommanderEvent.MODE_DONE: {_A: TransitionCell(mode=Mode.HOLD)},
    CommanderEvent.DISARM_TIMEOUT: {_G: _disarm(ArmingReason.AUTO_DISARM_PREFLIGHT)},
    CommanderEvent.LANDED_TIMEOUT: {_G: _disarm(ArmingReason.AUTO_DISARM_LAND)},
    CommanderEvent.LOCKDOWN_TIMEOUT: {_G: _LOCKED, _A: _LOCKED},
    CommanderEvent.FAILSAFE_DISARM: {_G: _CUT, _A: _CUT},
    **{Ask(mode): _available(mode) for mode in Mode},
    **{Ask(mode, available=False): _not_available(mode) for mode in Mode},
    # There is nothing to terminate while disarmed.
    Ask(Mode.TERMINATION): _available(Mode.TERMINATION) | {_B: _DENIED, _S: _DENIED},
}
"""[event][phase]: effect of an event; tests cover every pair."""

READINESS = tuple(
    tuple(
        event if phase in TABLE[event] else None
        for event in (CommanderEvent.NOT_READY, CommanderEvent.READY)
    )
    for phase in FlightPhase
)
"""[phase][estimator healthy]: event to handle, None if the table ignores it. Looked up in every
tick."""


@dataclass(frozen=True, slots=True)
class EventOutcome:
    """Outcome of an event."""

    flight: CommanderState
    result: autopilot_state.Result
    text: autopilot_state.OperatorText | None


def transition(flight: CommanderState, event: Ask | CommanderEvent) -> EventOutcome:
    """Return the outcome of an event for a flight. Termination has no exit."""
    # Terminated vehicles accept no mode, and their mode does not end.
    if flight.mode is Mode.TERMINATION:
        if isinstance(event, Ask):
            return EventOutcome(flight, _TEMP, unavailable(event.mode))
        if event is CommanderEvent.MODE_DONE:
            return EventOutcome(flight, autopilot_state.Result.ACCEPTED, None)
    cell = TABLE[event].get(flight.phase, TransitionCell())
    after = replace(flight, phase=flight.phase if cell.phase is None else cell.phase)
    mode = flight.after_disarm if cell.restores_mode else cell.mode
    if mode is not None:
        lasting = mode if mode.spec.lasting else flight.after_disarm
        after = replace(after, mode=mode, intended=mode, after_disarm=lasting, failsafe=False)
    return EventOutcome(after, cell.result, cell.text)


def status_of(flight: CommanderState) -> autopilot_state.CommanderStatus:
    """Return the reported status of a state."""
    arming = (
        autopilot_state.Arming.BOOT,
        autopilot_state.Arming.STANDBY,
        autopilot_state.Arming.ARMED,
        autopilot_state.Arming.ARMED,
    )[flight.phase]
    if flight.phase is not FlightPhase.AIR:
        landed = autopilot_state.Landed.ON_GROUND
    # Take-off is a separate landed state in MAVLink's extended state.
    elif flight.mode is Mode.TAKEOFF:
        landed = autopilot_state.Landed.TAKEOFF
    elif flight.mode is Mode.LAND:
        landed = autopilot_state.Landed.LANDING
    else:
        landed = autopilot_state.Landed.IN_AIR
    return autopilot_state.CommanderStatus(
        arming, flight.mode, flight.intended, landed, flight.failsafe
    )
