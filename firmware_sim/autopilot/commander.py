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
_B, _S, _G, _A = Phase
_ARMED = Row(phase=_G, text=_info("Armed by external command"))
_LIFTED = Row(phase=_A, text=_info("Takeoff detected"))
_LANDED = Row(phase=_G, text=_info("Landing detected"))
_BACK = Row(choice=Choice.INTENDED)


def _ask(mode: Mode, text: Message | None = None) -> Row:
    return Row(choice=Choice.ASK, mode=mode, text=text)


def _force(mode: Mode, text: str = "Failsafe activated") -> Row:
    return Row(choice=Choice.FORCE, mode=mode, text=_critical(text))


def _disarm(text: str) -> Row:
    return Row(phase=_S, choice=Choice.RESTORE, text=_info(text))


_LANDING = _ask(Mode.LAND, _info("Landing at current position"))
_CUT = Row(phase=_S, choice=Choice.RESTORE, text=_critical("Failsafe activated: disarmed"))
_LOW_RETURN = _force(Mode.RETURN, "Critical battery, returning now")
_LOW_LAND = _force(Mode.LAND, "Critical battery, landing now")
_DISARMED = _disarm("Disarmed by external command")
_UNUSED = _disarm("Disarmed by auto preflight disarming")

TABLE: dict[Event, tuple[Row, Row, Row, Row]] = {
    Event.READY: (Row(phase=_S), _IGNORE, _IGNORE, _IGNORE),
    # In the air there is no way back to the ground state: the estimate is flown as it is.
    Event.NOT_READY: (_IGNORE, Row(phase=_B), _IGNORE, _IGNORE),
    Event.ARM: (_NO_ARM, _ARMED, _IGNORE, _IGNORE),
    Event.ARM_BLIND: (_NO_ARM, _NO_ARM, _IGNORE, _IGNORE),
    Event.DISARM: (_IGNORE, _IGNORE, _DISARMED, _NOT_LANDED),
    Event.KILL: (_IGNORE, _IGNORE, _DISARMED, _DISARMED),
    Event.HOLD: (_ask(Mode.HOLD),) * 4,
    # On the ground, disarmed: accepted, the vehicle stays (as PX4 does it).
    Event.TAKEOFF: (_ask(Mode.TAKEOFF),) * 4,
    Event.OFFBOARD: (_ask(Mode.OFFBOARD),) * 4,
    Event.OFFBOARD_BLIND: (_ask(Mode.OFFBOARD), _ask(Mode.OFFBOARD), _NO_OFFBOARD, _NO_OFFBOARD),
    Event.LAND: (_ask(Mode.LAND), _ask(Mode.LAND), _LANDING, _LANDING),
    Event.RETURN: (_ask(Mode.RETURN),) * 4,
    Event.POSITION: (_ask(Mode.POSITION),) * 4,
    Event.LIFTED: (_IGNORE, _IGNORE, _LIFTED, _IGNORE),
    Event.LANDED: (_IGNORE, _IGNORE, _IGNORE, _LANDED),
    Event.TAKEOFF_DONE: (_IGNORE, _IGNORE, _IGNORE, _ask(Mode.HOLD)),
    Event.DISARM_TIMEOUT: (_IGNORE, _IGNORE, _UNUSED, _IGNORE),
    Event.LANDED_TIMEOUT: (_IGNORE, _IGNORE, _disarm("Disarmed by landing"), _IGNORE),
    # On the ground the loss only drops out of offboard: nothing may take off by failsafe.
    Event.SETPOINT_LOST_POSITION: (_IGNORE, _IGNORE, _force(Mode.POSITION), _force(Mode.POSITION)),
    Event.SETPOINT_LOST_RETURN: (_IGNORE, _IGNORE, _force(Mode.LAND), _force(Mode.RETURN)),
    Event.SETPOINT_LOST_LAND: (_IGNORE, _IGNORE, _force(Mode.LAND), _force(Mode.LAND)),
    Event.SETPOINT_LOST_HOLD: (_IGNORE, _IGNORE, _force(Mode.HOLD), _force(Mode.HOLD)),
    Event.SETPOINT_LOST_DISARM: (_IGNORE, _IGNORE, _CUT, _CUT),
    Event.SETPOINT_BACK: (_IGNORE, _IGNORE, _BACK, _BACK),
    Event.BATTERY_RETURN: (_IGNORE, _IGNORE, _IGNORE, _LOW_RETURN),
    Event.BATTERY_LAND: (_IGNORE, _IGNORE, _IGNORE, _LOW_LAND),
}
"""[event][phase]: what an event does in BOOT, STANDBY, GROUND and AIR; a test checks every pair."""


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
