"""The commander: an explicit table of (phase, event) -> what happens. Pure, no time, no I/O.

Who may arm, which mode follows which, what is refused and with which text: as PX4 does it
(measured on PX4 1.16 with MAVSDK 4.1). Timers and measurements that produce events live in
`failsafe.py`; what a mode flies lives in `guidance.py`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum, IntEnum, auto

from firmware_sim.autopilot.autopilot_state import Message, Mode, Result, Severity


class Phase(IntEnum):
    """Phase of a flight."""

    BOOT = 0
    """Estimator not converged."""
    STANDBY = 1
    """Ready, disarmed."""
    GROUND = 2
    """Armed, standing."""
    AIR = 3
    """Armed, flying."""


class Event(Enum):
    """Everything that can happen to a flight."""

    READY = auto()
    """The estimator has converged."""
    NOT_READY = auto()
    """The estimator is no longer converged."""
    ARM = auto()
    ARM_BLIND = auto()
    """Arm requested in offboard mode without a fresh setpoint."""
    DISARM = auto()
    KILL = auto()
    """Forced disarm."""
    HOLD = auto()
    TAKEOFF = auto()
    OFFBOARD = auto()
    """Offboard requested, setpoints are fresh."""
    OFFBOARD_BLIND = auto()
    """Offboard requested without a fresh setpoint."""
    LAND = auto()
    RETURN = auto()
    POSITION = auto()
    LIFTED = auto()
    """The landing detector sees flight."""
    LANDED = auto()
    """The landing detector sees ground."""
    TAKEOFF_DONE = auto()
    """Take-off altitude reached."""
    DISARM_TIMEOUT = auto()
    """Armed on the ground for COM_DISARM_PRFLT."""
    LANDED_TIMEOUT = auto()
    """Landed for COM_DISARM_LAND."""
    SETPOINT_LOST_POSITION = auto()
    """Offboard loss with COM_OBL_RC_ACT = 0 (or 1, 2: there is no pilot's input here)."""
    SETPOINT_LOST_RETURN = auto()
    """Offboard loss with COM_OBL_RC_ACT = 3."""
    SETPOINT_LOST_LAND = auto()
    """Offboard loss with COM_OBL_RC_ACT = 4."""
    SETPOINT_LOST_HOLD = auto()
    """Offboard loss with COM_OBL_RC_ACT = 5."""
    SETPOINT_LOST_DISARM = auto()
    """Offboard loss with COM_OBL_RC_ACT = 6 or 7."""
    SETPOINT_BACK = auto()
    """Setpoints have resumed while the offboard-loss failsafe flies."""
    BATTERY_RETURN = auto()
    """Critical battery, COM_LOW_BAT_ACT = 3."""
    BATTERY_LAND = auto()
    """Critical battery with COM_LOW_BAT_ACT = 2, or emergency with 3."""


@dataclass(frozen=True, slots=True)
class Flight:
    """The commander's whole state."""

    phase: Phase = Phase.BOOT
    mode: Mode = Mode.HOLD
    """What flies."""
    intended: Mode = Mode.HOLD
    """The mode that the user asked for last."""
    after_disarm: Mode = Mode.HOLD
    """The last requested mode but take-off, landing and return: disarming restores it."""
    failsafe: bool = False
    """Whether a failsafe chose the mode."""


class Choice(Enum):
    """How a row picks the next mode."""

    KEEP = auto()
    """No change."""
    ASK = auto()
    """The user wants `Row.mode`."""
    FORCE = auto()
    """A failsafe wants `Row.mode`; the intention stays."""
    INTENDED = auto()
    """Back to what the user asked for."""
    RESTORE = auto()
    """Disarmed: back to the last lasting mode."""


@dataclass(frozen=True, slots=True)
class Row:
    """One cell of the table."""

    phase: Phase | None = None
    """Next phase; None = the same."""
    choice: Choice = Choice.KEEP
    mode: Mode = Mode.HOLD
    result: Result = Result.ACCEPTED
    text: Message | None = None


def _info(text: str) -> Message:
    return Message(Severity.INFO, text)


def _critical(text: str) -> Message:
    return Message(Severity.CRITICAL, text)


_IGNORE = Row()
_TEMP = Result.TEMPORARILY_REJECTED
_NO_ARM = Row(result=_TEMP, text=_critical("Arming denied: Resolve system health failures first"))
_NO_OFFBOARD = Row(result=_TEMP, text=_critical("Switching to Offboard is currently not available"))
_NOT_LANDED = Row(result=_TEMP, text=_critical("Disarming denied: not landed"))
_B, _S, _G, _A = Phase.BOOT, Phase.STANDBY, Phase.GROUND, Phase.AIR


def _ask(mode: Mode, text: Message | None = None) -> Row:
    return Row(choice=Choice.ASK, mode=mode, text=text)


def _force(mode: Mode) -> Row:
    return Row(choice=Choice.FORCE, mode=mode, text=_critical("Failsafe activated"))


def _disarm(text: str) -> Row:
    return Row(phase=_S, choice=Choice.RESTORE, text=_info(text))


def _everywhere(row: Row) -> dict[Phase, Row]:
    return dict.fromkeys(Phase, row)


_LANDING = _ask(Mode.LAND, _info("Landing at current position"))
_CUT = Row(phase=_S, choice=Choice.RESTORE, text=_critical("Failsafe activated: disarmed"))
_LOW_RETURN = Row(
    choice=Choice.FORCE, mode=Mode.RETURN, text=_critical("Critical battery, returning now")
)
_LOW_LAND = Row(
    choice=Choice.FORCE, mode=Mode.LAND, text=_critical("Critical battery, landing now")
)

# Complete: a test checks every pair (event, phase).
TABLE: dict[Event, dict[Phase, Row]] = {
    Event.READY: {_B: Row(phase=_S), _S: _IGNORE, _G: _IGNORE, _A: _IGNORE},
    # In the air there is no way back to the ground state: the estimate is flown as it is.
    Event.NOT_READY: {_B: _IGNORE, _S: Row(phase=_B), _G: _IGNORE, _A: _IGNORE},
    Event.ARM: {
        _B: _NO_ARM,
        _S: Row(phase=_G, text=_info("Armed by external command")),
        _G: _IGNORE,
        _A: _IGNORE,
    },
    Event.ARM_BLIND: {_B: _NO_ARM, _S: _NO_ARM, _G: _IGNORE, _A: _IGNORE},
    Event.DISARM: {
        _B: _IGNORE,
        _S: _IGNORE,
        _G: _disarm("Disarmed by external command"),
        _A: _NOT_LANDED,
    },
    Event.KILL: {
        _B: _IGNORE,
        _S: _IGNORE,
        _G: _disarm("Disarmed by external command"),
        _A: _disarm("Disarmed by external command"),
    },
    Event.HOLD: _everywhere(_ask(Mode.HOLD)),
    # On the ground, disarmed: accepted, the vehicle stays (as PX4 does it).
    Event.TAKEOFF: _everywhere(_ask(Mode.TAKEOFF)),
    Event.OFFBOARD: _everywhere(_ask(Mode.OFFBOARD)),
    Event.OFFBOARD_BLIND: {
        _B: _ask(Mode.OFFBOARD),
        _S: _ask(Mode.OFFBOARD),
        _G: _NO_OFFBOARD,
        _A: _NO_OFFBOARD,
    },
    Event.LAND: {_B: _ask(Mode.LAND), _S: _ask(Mode.LAND), _G: _LANDING, _A: _LANDING},
    Event.RETURN: _everywhere(_ask(Mode.RETURN)),
    Event.POSITION: _everywhere(_ask(Mode.POSITION)),
    Event.LIFTED: {
        _B: _IGNORE,
        _S: _IGNORE,
        _G: Row(phase=_A, text=_info("Takeoff detected")),
        _A: _IGNORE,
    },
    Event.LANDED: {
        _B: _IGNORE,
        _S: _IGNORE,
        _G: _IGNORE,
        _A: Row(phase=_G, text=_info("Landing detected")),
    },
    Event.TAKEOFF_DONE: {_B: _IGNORE, _S: _IGNORE, _G: _IGNORE, _A: _ask(Mode.HOLD)},
    Event.DISARM_TIMEOUT: {
        _B: _IGNORE,
        _S: _IGNORE,
        _G: _disarm("Disarmed by auto preflight disarming"),
        _A: _IGNORE,
    },
    Event.LANDED_TIMEOUT: {
        _B: _IGNORE,
        _S: _IGNORE,
        _G: _disarm("Disarmed by landing"),
        _A: _IGNORE,
    },
    # On the ground the loss only drops out of offboard: nothing may take off by failsafe.
    Event.SETPOINT_LOST_POSITION: {
        _B: _IGNORE,
        _S: _IGNORE,
        _G: _force(Mode.POSITION),
        _A: _force(Mode.POSITION),
    },
    Event.SETPOINT_LOST_RETURN: {
        _B: _IGNORE,
        _S: _IGNORE,
        _G: _force(Mode.LAND),
        _A: _force(Mode.RETURN),
    },
    Event.SETPOINT_LOST_LAND: {
        _B: _IGNORE,
        _S: _IGNORE,
        _G: _force(Mode.LAND),
        _A: _force(Mode.LAND),
    },
    Event.SETPOINT_LOST_HOLD: {
        _B: _IGNORE,
        _S: _IGNORE,
        _G: _force(Mode.HOLD),
        _A: _force(Mode.HOLD),
    },
    Event.SETPOINT_LOST_DISARM: {_B: _IGNORE, _S: _IGNORE, _G: _CUT, _A: _CUT},
    Event.SETPOINT_BACK: {
        _B: _IGNORE,
        _S: _IGNORE,
        _G: Row(choice=Choice.INTENDED),
        _A: Row(choice=Choice.INTENDED),
    },
    Event.BATTERY_RETURN: {_B: _IGNORE, _S: _IGNORE, _G: _IGNORE, _A: _LOW_RETURN},
    Event.BATTERY_LAND: {_B: _IGNORE, _S: _IGNORE, _G: _IGNORE, _A: _LOW_LAND},
}


def _unless_ignored(event: Event, phase: Phase) -> Event | None:
    return None if TABLE[event][phase] is _IGNORE else event


READINESS = tuple(
    (_unless_ignored(Event.NOT_READY, phase), _unless_ignored(Event.READY, phase))
    for phase in Phase
)
"""[phase][whether the estimator is healthy]: the event to handle, None where the table ignores it.
Looked up at every tick."""

_PASSING = {Mode.TAKEOFF, Mode.LAND, Mode.RETURN}


@dataclass(frozen=True, slots=True)
class Step:
    """The outcome of one event."""

    flight: Flight
    result: Result
    text: Message | None


def transition(flight: Flight, event: Event) -> Step:
    """Return what an event does to a flight."""
    row = TABLE[event][flight.phase]
    phase = flight.phase if row.phase is None else row.phase
    moved = replace(flight, phase=phase)
    if row.choice is Choice.ASK:
        lasting = flight.after_disarm if row.mode in _PASSING else row.mode
        moved = replace(
            moved, mode=row.mode, intended=row.mode, after_disarm=lasting, failsafe=False
        )
    elif row.choice is Choice.FORCE:
        moved = replace(moved, mode=row.mode, failsafe=True)
    elif row.choice is Choice.INTENDED:
        moved = replace(moved, mode=flight.intended, failsafe=False)
    elif row.choice is Choice.RESTORE:
        mode = flight.after_disarm
        moved = replace(moved, mode=mode, intended=mode, failsafe=False)
    return Step(moved, row.result, row.text)
