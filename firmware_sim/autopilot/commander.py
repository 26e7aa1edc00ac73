"""Commander: an explicit transition table by phase and event. Pure: no clock, no I/O.

Arming rules, mode changes, rejections and their texts follow PX4 (measured on PX4 1.16 with MAVSDK
4.1). `failsafes/` holds the failsafe decisions, `AutoDisarm` the disarm timeouts, and `modes/` the
behaviour of each mode.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import Enum, IntEnum, auto
from typing import NamedTuple

from firmware_sim.autopilot.autopilot_state import (
    MODE_NAMES,
    Arming,
    CommanderStatus,
    Landed,
    Mode,
    OperatorText,
    Result,
    Severity,
)
from firmware_sim.autopilot.events import flight_events as events
from firmware_sim.autopilot.events.definition import ArmingReason, NavigationMode, words
from firmware_sim.autopilot.events.definition import MavlinkEvent as Told

MAIN_POSCTL, MAIN_AUTO, MAIN_ACRO, MAIN_OFFBOARD, MAIN_TERMINATION = 3, 4, 5, 6, 10

_N = NavigationMode

_NUMBERS: Mapping[Mode, tuple[int, int, int, NavigationMode]] = {
    Mode.HOLD: (MAIN_AUTO, 3, 4, _N.AUTO_LOITER),
    Mode.TAKEOFF: (MAIN_AUTO, 2, 17, _N.AUTO_TAKEOFF),
    Mode.LAND: (MAIN_AUTO, 6, 18, _N.AUTO_LAND),
    Mode.RETURN: (MAIN_AUTO, 5, 5, _N.AUTO_RTL),
    Mode.OFFBOARD: (MAIN_OFFBOARD, 0, 14, _N.OFFBOARD),
    Mode.POSITION: (MAIN_POSCTL, 0, 2, _N.POSCTL),
    Mode.MISSION: (MAIN_AUTO, 4, 3, _N.AUTO_MISSION),
    Mode.ORBIT: (MAIN_POSCTL, 1, 21, _N.ORBIT),
    Mode.FOLLOW: (MAIN_AUTO, 8, 19, _N.AUTO_FOLLOW_TARGET),
    Mode.MANUAL: (1, 0, 0, _N.MANUAL),
    Mode.ALTITUDE: (2, 0, 1, _N.ALTCTL),
    Mode.ACRO: (MAIN_ACRO, 0, 10, _N.ACRO),
    Mode.STABILIZED: (7, 0, 15, _N.STAB),
    Mode.DESCEND: (MAIN_AUTO, 6, 12, _N.UNKNOWN),  # PX4 reports it as Land
    Mode.TERMINATION: (MAIN_TERMINATION, 0, 13, _N.UNKNOWN),
    Mode.PRECISION_LAND: (MAIN_AUTO, 9, 20, _N.AUTO_PRECLAND),
}
"""Main mode, sub mode, navigation state (VehicleStatus.nav_state), number in messages."""

MAIN_SUB = {mode: (main, sub) for mode, (main, sub, _, _) in _NUMBERS.items()}
"""Main and sub mode."""

NAVIGATION_STATES = {mode: state for mode, (_, _, state, _) in _NUMBERS.items()}

_MORE_STATES = {
    Mode.POSITION: 1 << 6,  # its slow variant
    Mode.TAKEOFF: 1 << 22,  # a VTOL's, which no multicopter flies
}

STATE_BITS = {
    mode: 1 << state | _MORE_STATES.get(mode, 0) for mode, state in NAVIGATION_STATES.items()
}
"""Navigation states of each mode as bits, as in the mode masks of checks."""


def custom_mode(mode: Mode) -> int:
    """Return PX4's custom_mode: main mode << 16 | sub mode << 24."""
    main, sub = MAIN_SUB[mode]
    return main << 16 | sub << 24


def named(mode: Mode) -> NavigationMode:
    """Return the number of a mode in messages."""
    return _NUMBERS[mode][3]


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


def _info(text: str, event: Told) -> OperatorText:
    return OperatorText(Severity.INFO, text, event)


def _critical(text: str, event: Told) -> OperatorText:
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


def _unavailable(mode: Mode) -> TransitionCell:
    text = f"Switching to {MODE_NAMES[mode]} is currently not available"
    event = events.MODE_NOT_AVAILABLE.event(custom_mode(mode), named(mode))
    return TransitionCell(result=_TEMP, text=_critical(text, event))


def _asked(mode: Mode) -> tuple[TransitionCell, TransitionCell, TransitionCell, TransitionCell]:
    # PX4 also accepts the mode on the ground and disarmed; the vehicle stays.
    return (_ask(mode),) * 4


def _asked_in_vain(
    mode: Mode,
) -> tuple[TransitionCell, TransitionCell, TransitionCell, TransitionCell]:
    # Disarmed, PX4 accepts any mode and rejects arming if its requirements are unmet.
    return (_ask(mode), _ask(mode), _unavailable(mode), _unavailable(mode))


def _disarm(reason: ArmingReason) -> TransitionCell:
    text = _info(f"Disarmed by {words(reason)}", events.DISARMED_BY.event(reason))
    return TransitionCell(phase=_S, choice=Choice.RESTORE, text=text)


COMMANDED = {
    Mode.LAND: OperatorText.of(Severity.INFO, events.LANDING_HERE),
    Mode.PRECISION_LAND: _info("Precision landing", events.LANDING_PRECISELY.event()),
    Mode.RETURN: OperatorText.of(Severity.INFO, events.RETURNING),
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

# Modes that are not restored after disarming, see `after_disarm`.
_PASSING = {
    *(Mode.TAKEOFF, Mode.LAND, Mode.PRECISION_LAND, Mode.RETURN),
    *(Mode.ORBIT, Mode.FOLLOW, Mode.DESCEND),
}


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
            refused = _unavailable(event.mode)
            return EventOutcome(flight, refused.result, refused.text)
        if event is CommanderEvent.MODE_DONE:
            return EventOutcome(flight, Result.ACCEPTED, None)
    row = TABLE[event][flight.phase]
    phase = flight.phase if row.phase is None else row.phase
    moved = replace(flight, phase=phase)
    if row.choice is Choice.ASK:
        lasting = flight.after_disarm if row.mode in _PASSING else row.mode
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
