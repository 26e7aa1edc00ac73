"""The commander's table against an expectation written from measurements of PX4, cell by cell."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_sim.autopilot.autopilot_state import MODE_NAMES, Mode, Result, Severity
from firmware_sim.autopilot.commander import (
    READINESS,
    TABLE,
    Ask,
    Event,
    Flight,
    Phase,
    transition,
)

BOOT, STANDBY, GROUND, AIR = Phase.BOOT, Phase.STANDBY, Phase.GROUND, Phase.AIR
OK, NO = Result.ACCEPTED, Result.TEMPORARILY_REJECTED

SAME = "same"
"""Expected mode: as before."""
RESTORED = "restored"
"""Expected mode: the lasting one that was asked for last."""
INTENDED = "intended"
"""Expected mode: what the user asked for last."""

# What the user hears. A refusal is told with CRITICAL severity (measured), events with INFO.
ARMED = (Severity.INFO, "Armed by external command")
DISARMED = (Severity.INFO, "Disarmed by external command")
NO_ARM = (Severity.CRITICAL, "Arming denied: Resolve system health failures first")
NOT_LANDED = (Severity.CRITICAL, "Disarming denied: not landed")
FAILSAFE = (Severity.CRITICAL, "Failsafe activated")
LANDING = (Severity.INFO, "Landing at current position")
CUT = (Severity.CRITICAL, "Failsafe activated: disarmed")

EVENTS: list[Ask | Event] = [*Event, *(Ask(*each) for each in product(Mode, (True, False)))]


# (event, phase) -> next phase, mode, failsafe after (None = as before), answer, text
Expected = tuple[Phase, "Mode | str", "bool | None", Result, "tuple[Severity, str] | None"]


def quiet(phase: Phase) -> Expected:
    return (phase, SAME, None, OK, None)


def asked(phase: Phase, mode: Mode, text: tuple[Severity, str] | None = None) -> Expected:
    return (phase, mode, False, OK, text)


def disarmed(text: tuple[Severity, str]) -> Expected:
    return (STANDBY, RESTORED, False, OK, text)


def forced(phase: Phase, mode: Mode, text: tuple[Severity, str] = FAILSAFE) -> Expected:
    return (phase, mode, True, OK, text)


def unavailable(mode: Mode) -> tuple[Severity, str]:
    return (Severity.CRITICAL, f"Switching to {MODE_NAMES[mode]} is currently not available")


EXPECTED: dict[tuple[Ask | Event, Phase], Expected] = {
    # Everything that is not listed below changes nothing and says nothing.
    **{(event, phase): quiet(phase) for event, phase in product(EVENTS, Phase)},
    # Armable once the estimator has converged, and no longer when it loses it; never in flight.
    (Event.READY, BOOT): (STANDBY, SAME, None, OK, None),
    (Event.NOT_READY, STANDBY): (BOOT, SAME, None, OK, None),
    # Arming. In offboard without a setpoint it is refused, with these words.
    (Event.ARM, BOOT): (BOOT, SAME, None, NO, NO_ARM),
    (Event.ARM, STANDBY): (GROUND, SAME, None, OK, ARMED),
    (Event.ARM_BLIND, BOOT): (BOOT, SAME, None, NO, NO_ARM),
    (Event.ARM_BLIND, STANDBY): (STANDBY, SAME, None, NO, NO_ARM),
    # Disarming in the air needs force.
    (Event.DISARM, GROUND): disarmed(DISARMED),
    (Event.DISARM, AIR): (AIR, SAME, None, NO, NOT_LANDED),
    (Event.KILL, GROUND): disarmed(DISARMED),
    (Event.KILL, AIR): disarmed(DISARMED),
    # Modes may be chosen at any time, a take-off on the ground too.
    **{(Ask(m), p): asked(p, m) for m, p in product(Mode, Phase)},
    (Ask(Mode.LAND), GROUND): asked(GROUND, Mode.LAND, LANDING),
    (Ask(Mode.LAND), AIR): asked(AIR, Mode.LAND, LANDING),
    # A mode that lacks what it needs (offboard: a setpoint): on the ground disarmed yes, else no.
    **{(Ask(m, available=False), p): asked(p, m) for m, p in product(Mode, (BOOT, STANDBY))},
    **{
        (Ask(m, available=False), p): (p, SAME, None, NO, unavailable(m))
        for m, p in product(Mode, (GROUND, AIR))
    },
    # The flight itself.
    (Event.LIFTED, GROUND): (AIR, SAME, None, OK, (Severity.INFO, "Takeoff detected")),
    (Event.LANDED, AIR): (GROUND, SAME, None, OK, (Severity.INFO, "Landing detected")),
    (Event.MODE_DONE, AIR): asked(AIR, Mode.HOLD),
    (Event.DISARM_TIMEOUT, GROUND): disarmed(
        (Severity.INFO, "Disarmed by auto preflight disarming")
    ),
    (Event.LANDED_TIMEOUT, GROUND): disarmed((Severity.INFO, "Disarmed by landing")),
    # Offboard loss, COM_OBL_RC_ACT. A vehicle on the ground must not start by itself.
    (Event.SETPOINT_LOST_POSITION, GROUND): forced(GROUND, Mode.POSITION),
    (Event.SETPOINT_LOST_POSITION, AIR): forced(AIR, Mode.POSITION),
    (Event.SETPOINT_LOST_RETURN, GROUND): forced(GROUND, Mode.LAND),
    (Event.SETPOINT_LOST_RETURN, AIR): forced(AIR, Mode.RETURN),
    (Event.SETPOINT_LOST_LAND, GROUND): forced(GROUND, Mode.LAND),
    (Event.SETPOINT_LOST_LAND, AIR): forced(AIR, Mode.LAND),
    (Event.SETPOINT_LOST_HOLD, GROUND): forced(GROUND, Mode.HOLD),
    (Event.SETPOINT_LOST_HOLD, AIR): forced(AIR, Mode.HOLD),
    (Event.SETPOINT_LOST_DISARM, GROUND): disarmed(CUT),
    (Event.SETPOINT_LOST_DISARM, AIR): disarmed(CUT),
    # The mode comes back by itself.
    (Event.SETPOINT_BACK, GROUND): (GROUND, INTENDED, False, OK, None),
    (Event.SETPOINT_BACK, AIR): (AIR, INTENDED, False, OK, None),
    (Event.BATTERY_RETURN, AIR): forced(
        AIR, Mode.RETURN, (Severity.CRITICAL, "Critical battery, returning now")
    ),
    (Event.BATTERY_LAND, AIR): forced(
        AIR, Mode.LAND, (Severity.CRITICAL, "Critical battery, landing now")
    ),
}

FLIGHTS = [
    Flight(phase, mode, intended, after, failsafe)
    for phase in Phase
    for mode, intended, failsafe in (
        (Mode.HOLD, Mode.HOLD, False),
        (Mode.OFFBOARD, Mode.OFFBOARD, False),
        (Mode.LAND, Mode.OFFBOARD, True),
    )
    for after in (Mode.HOLD, Mode.OFFBOARD)
]


def test_every_event_has_a_row_for_every_phase() -> None:
    assert set(TABLE) == set(EVENTS)
    assert all(len(rows) == len(Phase) for rows in TABLE.values())


@pytest.mark.parametrize("event", EVENTS, ids=str)
def test_every_cell(event: Ask | Event) -> None:
    for flight in FLIGHTS:
        phase, mode, failsafe, result, text = EXPECTED[event, flight.phase]
        step = transition(flight, event)
        where = f"{event} in {flight}"
        after = step.flight
        assert after.phase is phase, where
        choices = {SAME: flight.mode, RESTORED: flight.after_disarm, INTENDED: flight.intended}
        expected_mode = mode if isinstance(mode, Mode) else choices[mode]
        assert after.mode is expected_mode, where
        assert after.failsafe is (flight.failsafe if failsafe is None else failsafe), where
        assert step.result is result, where
        said = None if step.text is None else (step.text.severity, step.text.text)
        assert said == text, where


@pytest.mark.parametrize("event", EVENTS, ids=str)
def test_a_refusal_changes_nothing(event: Ask | Event) -> None:
    for flight in FLIGHTS:
        step = transition(flight, event)
        if step.result is not OK:
            assert step.flight == flight
            assert step.text is not None, "a refusal says why"


@pytest.mark.parametrize("flight", FLIGHTS, ids=str)
def test_a_failsafe_does_not_change_what_the_user_wants(flight: Flight) -> None:
    for event in Event:
        if event.name.startswith(("SETPOINT_LOST", "BATTERY")):
            after = transition(flight, event).flight
            if after.failsafe and not flight.failsafe:
                assert after.intended is flight.intended
                assert after.after_disarm is flight.after_disarm


@pytest.mark.parametrize("flight", FLIGHTS, ids=str)
@pytest.mark.parametrize("healthy", [False, True])
def test_readiness_is_told_wherever_it_counts(flight: Flight, healthy: bool) -> None:
    told = READINESS[flight.phase][healthy]
    every_tick = transition(flight, Event.READY if healthy else Event.NOT_READY)
    if told is None:
        assert (every_tick.flight, every_tick.text) == (flight, None)
    else:
        assert transition(flight, told) == every_tick
        assert every_tick.flight != flight, "an event that changes nothing need not be told"


# --- any order of events

PASSING = {Mode.TAKEOFF, Mode.LAND, Mode.RETURN}
FORCING = {e for e in Event if e.name.startswith(("SETPOINT_LOST", "BATTERY"))}


@given(st.lists(st.sampled_from(EVENTS), max_size=60))
def test_invariants(events: list[Ask | Event]) -> None:
    flight = Flight()
    lasting = Mode.HOLD
    for event in events:
        step = transition(flight, event)
        before, flight = flight, step.flight
        # Nothing is armed that was not ready and asked to arm.
        if before.phase < GROUND <= flight.phase:
            assert (event, before.phase) == (Event.ARM, STANDBY)
            assert flight.phase is GROUND
        # The air is entered from the ground and left by landing or by cutting the motors.
        if before.phase is not AIR and flight.phase is AIR:
            assert (event, before.phase) == (Event.LIFTED, GROUND)
        if before.phase is AIR and flight.phase is not AIR:
            cut = {Event.KILL, Event.SETPOINT_LOST_DISARM}
            assert event in (cut if flight.phase is STANDBY else {Event.LANDED})
        # A failsafe flies only armed, is raised only by a failsafe event, and lies only while
        # no mode was chosen.
        if flight.failsafe:
            assert flight.phase >= GROUND
            assert before.failsafe or event in FORCING
            assert not isinstance(event, Ask) or step.result is NO
        else:
            assert flight.mode is flight.intended
        # What disarming returns to: the last lasting mode that was asked for and granted.
        if isinstance(event, Ask):
            granted = event.available or before.phase < GROUND
            assert (step.result is OK) is granted
            if granted and event.mode not in PASSING:
                lasting = event.mode
        elif event is Event.MODE_DONE and before.phase is AIR:
            lasting = Mode.HOLD
        assert flight.after_disarm is lasting
        if before.phase >= GROUND > flight.phase:
            assert flight.mode is lasting
        # On the ground, or not armed, disarming always works; killing does everywhere.
        if flight.phase is not AIR:
            disarm = transition(flight, Event.DISARM)
            assert disarm.result is OK
            assert disarm.flight.phase < GROUND
        assert transition(flight, Event.KILL).flight.phase < GROUND


@given(st.lists(st.sampled_from(EVENTS), max_size=30))
def test_a_flight_that_loses_its_setpoints_gets_back_what_was_asked(
    events: list[Ask | Event],
) -> None:
    flight = Flight()
    for event in events:
        flight = transition(flight, event).flight
    flight = replace(flight, phase=AIR, mode=Mode.OFFBOARD, intended=Mode.OFFBOARD, failsafe=False)
    for lost in (Event.SETPOINT_LOST_POSITION, Event.SETPOINT_LOST_HOLD, Event.SETPOINT_LOST_LAND):
        gone = transition(flight, lost).flight
        assert gone.failsafe
        assert transition(gone, Event.SETPOINT_BACK).flight == flight
