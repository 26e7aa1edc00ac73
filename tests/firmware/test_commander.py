"""The commander's table against an expectation written from measurements of PX4, cell by cell."""

from __future__ import annotations

from itertools import product

import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_sim.autopilot.autopilot_state import Result, Severity
from firmware_sim.autopilot.commander import (
    READINESS,
    TABLE,
    Ask,
    CommanderEvent,
    CommanderState,
    FlightPhase,
    transition,
)
from firmware_sim.autopilot.flight_modes import Mode

BOOT, STANDBY, GROUND, AIR = (
    FlightPhase.BOOT,
    FlightPhase.STANDBY,
    FlightPhase.GROUND,
    FlightPhase.AIR,
)
OK, NO = Result.ACCEPTED, Result.TEMPORARILY_REJECTED

SAME = "same"
"""Expected mode: as before."""
RESTORED = "restored"
"""Expected mode: the lasting mode of the latest request."""

# Texts to the user. Refusals have CRITICAL severity (measured), events INFO.
ARMED = (Severity.INFO, "Armed by external command")
DISARMED = (Severity.INFO, "Disarmed by external command")
NO_ARM = (Severity.CRITICAL, "Arming denied: Resolve system health failures first")
NOT_LANDED = (Severity.CRITICAL, "Disarming denied: not landed")
CUT = (Severity.INFO, "Disarmed by failsafe")
LOCKED = (Severity.INFO, "Disarmed by lockdown")

EVENTS: list[Ask | CommanderEvent] = [
    *CommanderEvent,
    *(Ask(*each) for each in product(Mode, (True, False))),
]


# (event, phase) -> next phase, mode, failsafe after (None = as before), answer, text
Expected = tuple[FlightPhase, "Mode | str", "bool | None", Result, "tuple[Severity, str] | None"]


def quiet(phase: FlightPhase) -> Expected:
    return (phase, SAME, None, OK, None)


def asked(phase: FlightPhase, mode: Mode, text: tuple[Severity, str] | None = None) -> Expected:
    return (phase, mode, False, OK, text)


def disarmed(text: tuple[Severity, str]) -> Expected:
    return (STANDBY, RESTORED, False, OK, text)


def unavailable(mode: Mode) -> tuple[Severity, str]:
    return (Severity.CRITICAL, f"Switching to {mode.spec.title} is currently not available")


EXPECTED: dict[tuple[Ask | CommanderEvent, FlightPhase], Expected] = {
    # Everything that is not listed below changes nothing and says nothing.
    **{(event, phase): quiet(phase) for event, phase in product(EVENTS, FlightPhase)},
    # Armable once the estimator has converged, and no longer when it loses it; never in flight.
    (CommanderEvent.READY, BOOT): (STANDBY, SAME, None, OK, None),
    (CommanderEvent.NOT_READY, STANDBY): (BOOT, SAME, None, OK, None),
    # Arming. Where a check fails it is refused, with these words.
    (CommanderEvent.ARM, BOOT): (BOOT, SAME, None, NO, NO_ARM),
    (CommanderEvent.ARM, STANDBY): (GROUND, SAME, None, OK, ARMED),
    (CommanderEvent.ARM_UNREADY, BOOT): (BOOT, SAME, None, NO, NO_ARM),
    (CommanderEvent.ARM_UNREADY, STANDBY): (STANDBY, SAME, None, NO, NO_ARM),
    # Disarming in the air needs force.
    (CommanderEvent.DISARM, GROUND): disarmed(DISARMED),
    (CommanderEvent.DISARM, AIR): (AIR, SAME, None, NO, NOT_LANDED),
    (CommanderEvent.KILL, GROUND): disarmed(DISARMED),
    (CommanderEvent.KILL, AIR): disarmed(DISARMED),
    # Modes may be chosen at any time, a take-off on the ground too.
    **{(Ask(m), p): asked(p, m) for m, p in product(Mode, FlightPhase)},
    # A mode that lacks what it needs (offboard: a setpoint): on the ground disarmed yes, else no.
    **{(Ask(m, available=False), p): asked(p, m) for m, p in product(Mode, (BOOT, STANDBY))},
    **{
        (Ask(m, available=False), p): (p, SAME, None, NO, unavailable(m))
        for m, p in product(Mode, (GROUND, AIR))
    },
    # The flight itself.
    (CommanderEvent.LIFTED, GROUND): (AIR, SAME, None, OK, (Severity.INFO, "Takeoff detected")),
    (CommanderEvent.LANDED, AIR): (GROUND, SAME, None, OK, (Severity.INFO, "Landing detected")),
    (CommanderEvent.MODE_DONE, AIR): asked(AIR, Mode.HOLD),
    (CommanderEvent.DISARM_TIMEOUT, GROUND): disarmed(
        (Severity.INFO, "Disarmed by auto preflight disarming")
    ),
    (CommanderEvent.LANDED_TIMEOUT, GROUND): disarmed((Severity.INFO, "Disarmed by landing")),
    # Motors that failsafes stop.
    (CommanderEvent.LOCKDOWN_TIMEOUT, GROUND): disarmed(LOCKED),
    (CommanderEvent.LOCKDOWN_TIMEOUT, AIR): disarmed(LOCKED),
    (CommanderEvent.FAILSAFE_DISARM, GROUND): disarmed(CUT),
    (CommanderEvent.FAILSAFE_DISARM, AIR): disarmed(CUT),
    # Disarmed there is nothing to terminate.
    (Ask(Mode.TERMINATION), BOOT): (BOOT, SAME, None, Result.DENIED, None),
    (Ask(Mode.TERMINATION), STANDBY): (STANDBY, SAME, None, Result.DENIED, None),
}

FLIGHTS = [
    CommanderState(phase, mode, intended, after, failsafe)
    for phase in FlightPhase
    for mode, intended, failsafe in (
        (Mode.HOLD, Mode.HOLD, False),
        (Mode.OFFBOARD, Mode.OFFBOARD, False),
        (Mode.LAND, Mode.OFFBOARD, True),
    )
    for after in (Mode.HOLD, Mode.OFFBOARD)
]


def test_every_event_has_a_row() -> None:
    assert set(TABLE) == set(EVENTS)


@pytest.mark.parametrize("event", EVENTS, ids=str)
def test_every_cell(event: Ask | CommanderEvent) -> None:
    for flight in FLIGHTS:
        phase, mode, failsafe, result, text = EXPECTED[event, flight.phase]
        step = transition(flight, event)
        where = f"{event} in {flight}"
        after = step.flight
        assert after.phase is phase, where
        choices = {SAME: flight.mode, RESTORED: flight.after_disarm}
        expected_mode = mode if isinstance(mode, Mode) else choices[mode]
        assert after.mode is expected_mode, where
        assert after.failsafe is (flight.failsafe if failsafe is None else failsafe), where
        assert step.result is result, where
        said = None if step.text is None else (step.text.severity, step.text.text)
        assert said == text, where


@pytest.mark.parametrize("event", EVENTS, ids=str)
def test_a_refusal_changes_nothing(event: Ask | CommanderEvent) -> None:
    for flight in FLIGHTS:
        step = transition(flight, event)
        if step.result is not OK:
            assert step.flight == flight
            if step.result is NO:
                assert step.text is not None, "a refusal says why"


@pytest.mark.parametrize("phase", FlightPhase)
def test_nobody_leaves_a_termination(phase: FlightPhase) -> None:
    flight = CommanderState(phase, Mode.TERMINATION, Mode.TERMINATION, Mode.TERMINATION)
    for event in EVENTS:
        step = transition(flight, event)
        assert step.flight.mode is Mode.TERMINATION
        if isinstance(event, Ask):
            assert step.result is NO
            assert step.text is not None


@pytest.mark.parametrize("flight", FLIGHTS, ids=str)
@pytest.mark.parametrize("healthy", [False, True])
def test_readiness_is_told_wherever_it_counts(flight: CommanderState, healthy: bool) -> None:
    told = READINESS[flight.phase][healthy]
    every_tick = transition(flight, CommanderEvent.READY if healthy else CommanderEvent.NOT_READY)
    if told is None:
        assert (every_tick.flight, every_tick.text) == (flight, None)
    else:
        assert transition(flight, told) == every_tick
        assert every_tick.flight != flight, "an event that changes nothing need not be told"


# --- any order of events

PASSING = {
    *(Mode.TAKEOFF, Mode.LAND, Mode.PRECISION_LAND, Mode.RETURN),
    *(Mode.ORBIT, Mode.FOLLOW, Mode.DESCEND),
}


@given(st.lists(st.sampled_from(EVENTS), max_size=60))
def test_invariants(events: list[Ask | CommanderEvent]) -> None:
    flight = CommanderState()
    lasting = Mode.HOLD
    for event in events:
        step = transition(flight, event)
        before, flight = flight, step.flight
        # Only ready vehicles arm, and only on request.
        if before.phase < GROUND <= flight.phase:
            assert (event, before.phase) == (CommanderEvent.ARM, STANDBY)
            assert flight.phase is GROUND
        # The air is entered from the ground and left by landing or by cutting the motors.
        if before.phase is not AIR and flight.phase is AIR:
            assert (event, before.phase) == (CommanderEvent.LIFTED, GROUND)
        if before.phase is AIR and flight.phase is not AIR:
            cut = {
                CommanderEvent.KILL,
                CommanderEvent.FAILSAFE_DISARM,
                CommanderEvent.LOCKDOWN_TIMEOUT,
            }
            assert event in (cut if flight.phase is STANDBY else {CommanderEvent.LANDED})
        # The table itself raises no failsafe.
        assert not flight.failsafe
        assert flight.mode is flight.intended
        # Disarming returns to the last lasting mode that was requested and granted.
        if isinstance(event, Ask):
            granted = event.available or before.phase < GROUND
            granted = granted and before.mode is not Mode.TERMINATION
            if event == Ask(Mode.TERMINATION):
                granted = granted and before.phase >= GROUND
            assert (step.result is OK) is granted
            if granted and event.mode not in PASSING:
                lasting = event.mode
        elif event is CommanderEvent.MODE_DONE and before.phase is AIR:
            lasting = lasting if before.mode is Mode.TERMINATION else Mode.HOLD
        assert flight.after_disarm is lasting
        if before.phase >= GROUND > flight.phase:
            assert flight.mode is lasting
        # On the ground, or not armed, disarming always works; killing does everywhere.
        if flight.phase is not AIR:
            disarm = transition(flight, CommanderEvent.DISARM)
            assert disarm.result is OK
            assert disarm.flight.phase < GROUND
        assert transition(flight, CommanderEvent.KILL).flight.phase < GROUND
