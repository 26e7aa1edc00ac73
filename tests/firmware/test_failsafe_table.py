"""Failsafes as a pure table: every pair of conditions, against independent rules.

The rules are written here a second time, from PX4's documentation: a list of actions for each
single failure, the worst of which is flown, and the chain of fallback modes.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from typing import Any, NamedTuple

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from airl_mav.profiles.px4_release import PX4ReleaseName, px4_release
from firmware_sim.autopilot.events.definition import FailsafeAction
from firmware_sim.autopilot.failsafes.failsafe_conditions import (
    BatteryWarning,
    Conditions,
    FailsafeSettings,
    FenceBreach,
    can_run,
)
from firmware_sim.autopilot.failsafes.failsafe_table import (
    MODE_OF_ACTION,
    TABLE,
    Situation,
    Trigger,
    answers,
    possible,
)
from firmware_sim.autopilot.failsafes.framework import (
    NO_INTERVENTION,
    FailsafeResult,
    FailsafeState,
    Intervention,
    update,
)
from firmware_sim.autopilot.flight_modes import Mode

MS, S = 1_000, 1_000_000
FINE = Conditions(
    auto_mission_missing=False,
    offboard_control_signal_lost=False,
    manual_control_signal_lost=False,
    gcs_connection_lost=False,
)
"""A vehicle that lacks nothing."""

LONG_ARMED_US = 60 * S


class Machine:
    """Steps the failsafes and keeps their state."""

    def __init__(self, mode: Mode = Mode.HOLD, options: FailsafeSettings | None = None) -> None:
        self.state = FailsafeState()
        self.mode, self.armed, self.time_us = mode, True, 1 * S
        self.options = options or FailsafeSettings()
        self.conditions = FINE
        self.mission_finished = False
        self.rules = px4_release().failsafes
        self.texts: list[str] = []
        self.last = self.step(0)

    def step(
        self, elapsed_us: int = 10 * MS, asked: Intervention = NO_INTERVENTION, **changes: Any
    ) -> FailsafeResult:
        """Let time pass, change what is wrong, and update; return the outcome."""
        self.time_us += elapsed_us
        self.conditions = self.conditions._replace(**changes)
        now = Situation(
            self.time_us,
            self.conditions,
            self.options,
            self.mode,
            self.mission_finished,
            armed=self.armed,
            rules=self.rules,
        )
        self.last = update(self.state, now, asked)
        self.state, self.mode = self.last.state, self.last.intended
        if self.last.text is not None:
            self.texts.append(self.last.text.text)
        return self.last

    def action(self) -> FailsafeAction:
        return self.state.action


def flying(mode: Mode = Mode.HOLD, **options: float) -> Machine:
    """Return the failsafes of a vehicle that has been armed for a while."""
    machine = Machine(mode, FailsafeSettings(**options))  # type: ignore[arg-type]  # by name
    machine.step(LONG_ARMED_US)
    assert machine.action() is FailsafeAction.NONE
    return machine


# --- PX4's own scenarios (failsafe_test.cpp, failsafe.cpp)


def test_manual_control_lost_holds_then_returns() -> None:
    m = flying(Mode.POSITION, nav_rcl_act=2)
    assert m.step(manual_control_signal_lost=True).state.action is FailsafeAction.HOLD
    assert m.texts == ["Failsafe activated: entering Hold for 5 seconds"]
    assert m.last.delayed is FailsafeAction.RTL
    assert m.last.mode is Mode.HOLD
    m.step(4900 * MS)
    assert m.action() is FailsafeAction.HOLD
    m.step(200 * MS)
    assert m.action() is FailsafeAction.RTL
    assert m.texts[-1] == "Failsafe activated"
    # The signal is back: the return continues until the user chooses a mode.
    m.step(manual_control_signal_lost=False)
    assert m.action() is FailsafeAction.RTL
    m.mode = Mode.ALTITUDE
    assert m.step().mode is Mode.ALTITUDE
    assert m.action() is FailsafeAction.NONE


def test_the_worse_of_two_is_taken_and_the_other_after_it() -> None:
    m = flying(Mode.POSITION, nav_rcl_act=2, nav_dll_act=3)
    m.step(manual_control_signal_lost=True)
    m.step(6 * S)
    assert m.action() is FailsafeAction.RTL
    m.step(gcs_connection_lost=True)
    assert m.action() is FailsafeAction.LAND, "no second wait: it is in a failsafe already"
    m.mode = Mode.HOLD
    m.step(gcs_connection_lost=False)
    assert m.action() is FailsafeAction.WARN, "the user flies on; the pilot's link is still lost"


def test_the_user_takes_over_with_the_sticks_only_after_the_wait() -> None:
    m = flying(Mode.MISSION)
    m.step(flight_time_limit_exceeded=True)
    assert m.action() is FailsafeAction.HOLD
    m.step(3 * S, Intervention(sticks_moved=True))
    assert m.action() is FailsafeAction.HOLD
    m.step(3 * S)
    assert m.action() is FailsafeAction.RTL
    m.step(10 * MS, Intervention(sticks_moved=True))
    assert (m.action(), m.mode, m.state.taken_over) == (FailsafeAction.WARN, Mode.POSITION, True)
    m.step(flight_time_limit_exceeded=False)
    assert m.action() is FailsafeAction.NONE
    assert not m.state.taken_over


def test_a_mode_ends_the_wait_but_not_one_asked_before() -> None:
    m = flying(Mode.POSITION, nav_rcl_act=2)
    m.step(10 * MS, Intervention(mode_chosen=True), manual_control_signal_lost=True)
    assert m.action() is FailsafeAction.HOLD, "asked for at the moment of the loss: no takeover"
    m.step(1 * S, Intervention(mode_chosen=True))
    assert (m.action(), m.state.taken_over) == (FailsafeAction.WARN, True)
    m.step(60 * S)
    assert m.action() is FailsafeAction.WARN


def test_a_fence_is_escaped_by_mode_not_by_sticks_and_termination_by_nothing() -> None:
    m = flying(Mode.POSITION, gf_action=2)
    m.step(geofence=FenceBreach(distance=True))
    assert m.action() is FailsafeAction.HOLD
    m.step(10 * MS, Intervention(sticks_moved=True))
    assert m.action() is FailsafeAction.HOLD
    m.step(10 * MS, Intervention(mode_chosen=True))
    assert m.action() is FailsafeAction.WARN
    m = flying(Mode.POSITION, gf_action=4)
    m.step(geofence=FenceBreach(custom=True))
    assert m.action() is FailsafeAction.TERMINATE
    m.armed, m.mode = False, Mode.HOLD
    m.step(10 * S, Intervention(mode_chosen=True, sticks_moved=True), geofence=FenceBreach())
    assert m.action() is FailsafeAction.TERMINATE
    assert m.last.mode is Mode.TERMINATION


def test_already_returning_or_landing_it_only_warns() -> None:
    for mode in (Mode.RETURN, Mode.LAND, Mode.PRECISION_LAND):
        m = flying(mode, nav_rcl_act=2)
        m.step(manual_control_signal_lost=True)
        assert (m.action(), m.last.mode) == (FailsafeAction.WARN, mode)


@pytest.mark.parametrize(
    ("release", "between"), [("1.16", FailsafeAction.HOLD), ("1.17", FailsafeAction.NONE)]
)
def test_a_condition_that_flaps_acts_in_the_end(
    release: PX4ReleaseName, between: FailsafeAction
) -> None:
    """A wait that has begun runs on without its cause; the next is shorter than the first."""
    m = flying(Mode.MISSION)
    m.rules = px4_release(release).failsafes
    for _ in range(3):
        m.step(flight_time_limit_exceeded=True)
        m.step(1 * S)
        assert m.action() is FailsafeAction.HOLD
        m.step(flight_time_limit_exceeded=False)
        m.step(500 * MS)
        assert m.action() is between
    m.step(1 * S)
    assert m.action() is FailsafeAction.NONE
    m.step(flight_time_limit_exceeded=True)
    assert m.texts[-1] == "Failsafe activated: entering Hold for 3 seconds"
    m.step(3500 * MS)
    assert m.action() is FailsafeAction.RTL


def test_the_battery_acts_only_when_worse_than_at_arming() -> None:
    m = Machine(Mode.HOLD, FailsafeSettings(com_low_bat_act=3))
    m.armed = False
    m.step(battery_warning=BatteryWarning.CRITICAL)
    m.armed = True
    m.step()
    m.step(LONG_ARMED_US)
    assert m.action() is FailsafeAction.WARN
    m.step(battery_warning=BatteryWarning.EMERGENCY)
    m.step(6 * S)
    assert m.action() is FailsafeAction.LAND


def test_manual_control_that_was_missing_at_arming_is_optional() -> None:
    m = Machine(Mode.HOLD, FailsafeSettings(nav_rcl_act=2))
    m.armed = False
    m.step(manual_control_signal_lost=True)
    m.armed = True
    m.step(LONG_ARMED_US)
    assert m.action() is FailsafeAction.NONE
    m.step(manual_control_signal_lost=False)
    m.step(manual_control_signal_lost=True)
    assert m.action() is FailsafeAction.HOLD, "once it was there, its loss counts"


@pytest.mark.parametrize(
    ("after_s", "breaker", "expected"),
    [
        (3.9, 121212, FailsafeAction.DISARM),
        (3.9, 0, FailsafeAction.DISARM),
        (4.1, 121212, FailsafeAction.WARN),
        (4.1, 0, FailsafeAction.TERMINATE),
    ],
)
def test_attitude_failure(after_s: float, breaker: int, expected: FailsafeAction) -> None:
    m = Machine(Mode.TAKEOFF, FailsafeSettings(cbrk_flightterm=breaker))
    m.step(round(after_s * S), fd_critical_failure=True)
    assert m.action() is expected


def test_an_orbit_that_a_failsafe_ended_is_not_resumed() -> None:
    m = flying(Mode.ORBIT, com_fail_act_t=0.0)
    m.step(flight_time_limit_exceeded=True)
    assert m.action() is FailsafeAction.RTL
    m.step(flight_time_limit_exceeded=False)
    assert (m.action(), m.mode) == (FailsafeAction.NONE, Mode.HOLD)


def test_offboard_lost_and_regained() -> None:
    m = flying(Mode.OFFBOARD, com_obl_rc_act=3)
    m.step(offboard_control_signal_lost=True)
    assert (m.action(), m.last.mode, m.mode) == (FailsafeAction.RTL, Mode.RETURN, Mode.OFFBOARD)
    assert m.texts == ["Failsafe activated"], "no wait in Hold for a mode that cannot fly on"
    m.step(offboard_control_signal_lost=False)
    assert (m.action(), m.last.mode) == (FailsafeAction.NONE, Mode.OFFBOARD)


# --- every pair


def test_every_trigger_has_a_row_and_every_value_of_its_parameter_an_answer() -> None:
    assert {row.trigger for row in TABLE} == set(Trigger) - {Trigger.MODE_FALLBACK}
    for row in TABLE:
        assert row.answers
        if row.parameter is None:
            assert set(row.answers) == {0}
        else:
            assert row.parameter.lower() in FailsafeSettings._fields


_BAD: dict[str, Any] = {
    **{name: True for name, default in Conditions()._asdict().items() if isinstance(default, bool)},
    "battery_warning": BatteryWarning.CRITICAL,
    "geofence": FenceBreach(distance=True),
}
SINGLES = [(name,) for name in Conditions._fields]
PAIRS = [(a, b) for a, b in product(Conditions._fields, repeat=2) if a < b]


def with_every_action(value: int) -> FailsafeSettings:
    """Return settings in which every parameter that chooses an action has this value."""
    return FailsafeSettings(
        *(
            value if isinstance(default, int) and "act" in name else default
            for name, default in FailsafeSettings._field_defaults.items()
        )
    )


def assert_flown(mode: Mode, options: FailsafeSettings, names: tuple[str, ...]) -> None:
    """Apply conditions; the modes chosen at once and after the wait can be flown."""
    m = Machine(mode, options)
    for elapsed_us in (LONG_ARMED_US, 6 * S):
        m.step(elapsed_us, **{name: _BAD[name] for name in names})
        action, flown = m.action(), m.last.mode
        where = f"{names} in {mode.name} with {options}: {action.name}"
        if action in MODE_OF_ACTION:
            assert flown is MODE_OF_ACTION[action], where
            assert action is FailsafeAction.TERMINATE or can_run(flown, m.conditions), where
        else:
            assert flown is m.mode, where
            assert action is FailsafeAction.DISARM or can_run(flown, m.conditions), where


@pytest.mark.parametrize("mode", Mode)
def test_every_condition_in_every_mode_has_an_outcome_that_can_be_flown(mode: Mode) -> None:
    for value in range(-1, 8):
        for names in SINGLES:
            assert_flown(mode, with_every_action(value), names)


@pytest.mark.parametrize("mode", Mode)
def test_every_pair_of_conditions_has_an_outcome_that_can_be_flown(mode: Mode) -> None:
    for names in PAIRS:
        assert_flown(mode, FailsafeSettings(), names)


def test_the_chain_of_fallbacks() -> None:
    lost: dict[str, Any] = {}
    ends = []
    for name in (
        "global_position_invalid",
        "local_position_invalid",
        "local_position_invalid_relaxed",
        "local_altitude_invalid",
        "attitude_invalid",
    ):
        lost[name] = True
        conditions = FINE._replace(**lost)
        ends.append(
            (
                possible(FailsafeAction.FALLBACK_POSCTRL, conditions),
                possible(FailsafeAction.HOLD, conditions),
            )
        )
    assert ends == [
        (FailsafeAction.FALLBACK_POSCTRL, FailsafeAction.LAND),
        (FailsafeAction.FALLBACK_POSCTRL, FailsafeAction.LAND),
        (FailsafeAction.FALLBACK_ALTCTRL, FailsafeAction.DESCEND),
        (FailsafeAction.FALLBACK_STABILIZED, FailsafeAction.DESCEND),
        (FailsafeAction.TERMINATE, FailsafeAction.TERMINATE),
    ]


# --- the same rules, written a second time


class Known(NamedTuple):
    """Inputs of the independent rules."""

    c: Conditions
    p: FailsafeSettings
    mode: Mode


_LINK = [
    FailsafeAction.NONE,
    FailsafeAction.HOLD,
    FailsafeAction.RTL,
    FailsafeAction.LAND,
    None,
    FailsafeAction.TERMINATE,
    FailsafeAction.DISARM,
]
_LIMIT = [
    FailsafeAction.NONE,
    FailsafeAction.WARN,
    FailsafeAction.HOLD,
    FailsafeAction.RTL,
    FailsafeAction.TERMINATE,
    FailsafeAction.LAND,
]


def _pick(
    actions: list[FailsafeAction | None], value: int, otherwise: FailsafeAction
) -> FailsafeAction:
    found = actions[value] if 0 <= value < len(actions) else None
    return otherwise if found is None else found


def _excepted(k: Known, exceptions: int) -> bool:
    """COM_RCL_EXCEPT and COM_DLL_EXCEPT, bit 0 Mission, 1 Hold (and Takeoff), 2 Offboard."""
    bit = {Mode.MISSION: 1, Mode.HOLD: 2, Mode.TAKEOFF: 2, Mode.OFFBOARD: 4}.get(k.mode, 0)
    return bool(exceptions & bit)


def _low_battery(k: Known) -> FailsafeAction:
    if k.c.battery_warning is BatteryWarning.NONE:
        return FailsafeAction.NONE
    if k.c.battery_warning is BatteryWarning.LOW or k.p.com_low_bat_act not in (1, 2, 3):
        return FailsafeAction.WARN
    if k.p.com_low_bat_act == 2:
        return FailsafeAction.LAND
    empty = k.c.battery_warning is BatteryWarning.EMERGENCY
    return FailsafeAction.LAND if empty and k.p.com_low_bat_act == 3 else FailsafeAction.RTL


def _unflyable(k: Known) -> FailsafeAction:
    """Return the action for a mode that cannot continue."""
    mode, action = k.mode, FailsafeAction.NONE
    if mode is Mode.OFFBOARD and k.c.offboard_control_signal_lost:
        losses = [
            (FailsafeAction.FALLBACK_POSCTRL, Mode.POSITION),
            (FailsafeAction.FALLBACK_ALTCTRL, Mode.ALTITUDE),
            (FailsafeAction.FALLBACK_STABILIZED, Mode.STABILIZED),
            (FailsafeAction.RTL, Mode.RETURN),
            (FailsafeAction.LAND, Mode.LAND),
            (FailsafeAction.HOLD, Mode.HOLD),
            (FailsafeAction.TERMINATE, Mode.TERMINATION),
        ]
        if k.p.com_obl_rc_act == 7:
            return FailsafeAction.DISARM
        action, mode = losses[k.p.com_obl_rc_act]
    for at, then, into in (
        (Mode.POSITION, FailsafeAction.FALLBACK_ALTCTRL, Mode.ALTITUDE),
        (Mode.ALTITUDE, FailsafeAction.FALLBACK_STABILIZED, Mode.STABILIZED),
    ):
        if mode is at and not _flies(at, k.c):
            action, mode = then, into
    piloted = (Mode.POSITION, Mode.ALTITUDE, Mode.STABILIZED)
    if action is not FailsafeAction.NONE and mode in piloted and k.c.manual_control_signal_lost:
        # The fallback has no pilot: as if the pilot were lost.
        action = _pick(_LINK, k.p.nav_rcl_act, FailsafeAction.NONE)
    return action if _flies(mode, k.c) else FailsafeAction.RTL


def _flies(mode: Mode, c: Conditions) -> bool:
    """PX4's table of mode requirements, column by column."""
    level = not (c.angular_velocity_invalid or c.attitude_invalid)
    height, somewhere = not c.local_altitude_invalid, not c.local_position_invalid_relaxed
    guided = level and height and not c.local_position_invalid
    on_the_map = guided and not c.global_position_invalid
    return {
        Mode.HOLD: on_the_map,
        Mode.TAKEOFF: guided,
        Mode.OFFBOARD: level and not c.offboard_control_signal_lost,
        Mode.LAND: level and height and somewhere,
        Mode.RETURN: on_the_map and not c.home_position_invalid,
        Mode.POSITION: level and height and somewhere,
        Mode.ALTITUDE: level and height,
        Mode.STABILIZED: level,
        Mode.MISSION: on_the_map and not c.auto_mission_missing,
        Mode.ORBIT: guided,
        Mode.FOLLOW: guided,
        Mode.MANUAL: True,
        Mode.ACRO: not c.angular_velocity_invalid,
        Mode.DESCEND: level,
        Mode.TERMINATION: True,
        Mode.PRECISION_LAND: guided,
    }[mode]


RULES: list[Callable[[Known], FailsafeAction]] = [
    lambda k: (
        _pick(_LINK, k.p.nav_rcl_act, FailsafeAction.NONE)
        if k.c.manual_control_signal_lost
        and k.p.com_rc_in_mode != 4
        and not _excepted(k, k.p.com_rcl_except)
        else FailsafeAction.NONE
    ),
    lambda k: (
        _pick(_LINK, k.p.nav_dll_act, FailsafeAction.NONE)
        if k.c.gcs_connection_lost
        and k.mode not in (Mode.LAND, Mode.PRECISION_LAND)
        and not _excepted(k, k.p.com_dll_except)
        else FailsafeAction.NONE
    ),
    lambda k: FailsafeAction.RTL if k.c.flight_time_limit_exceeded else FailsafeAction.NONE,
    lambda k: (
        _pick(list(_LIMIT), k.p.com_pos_low_act, FailsafeAction.WARN)
        if k.c.local_position_accuracy_low and k.mode in (Mode.HOLD, Mode.MISSION)
        else FailsafeAction.NONE
    ),
    lambda k: (
        _pick(list(_LIMIT), k.p.gf_action, FailsafeAction.WARN)
        if k.c.geofence != FenceBreach()
        else FailsafeAction.NONE
    ),
    lambda k: (
        {1: FailsafeAction.WARN, 3: FailsafeAction.RTL}.get(
            k.p.com_fltt_low_act, FailsafeAction.NONE
        )
        if k.c.battery_low_remaining_time
        else FailsafeAction.NONE
    ),
    _low_battery,
    lambda k: (
        (FailsafeAction.WARN if k.p.cbrk_flightterm == 121212 else FailsafeAction.TERMINATE)
        if k.c.fd_critical_failure
        else FailsafeAction.NONE
    ),
    lambda k: (
        {
            1: FailsafeAction.HOLD,
            2: FailsafeAction.LAND,
            3: FailsafeAction.RTL,
            4: FailsafeAction.TERMINATE,
        }.get(k.p.com_act_fail_act, FailsafeAction.WARN)
        if k.c.fd_motor_failure
        else FailsafeAction.NONE
    ),
    _unflyable,
]

_CHAIN = [
    (FailsafeAction.FALLBACK_POSCTRL, Mode.POSITION),
    (FailsafeAction.FALLBACK_ALTCTRL, Mode.ALTITUDE),
    (FailsafeAction.FALLBACK_STABILIZED, Mode.STABILIZED),
    (FailsafeAction.HOLD, Mode.HOLD),
    (FailsafeAction.RTL, Mode.RETURN),
    (FailsafeAction.LAND, Mode.LAND),
    (FailsafeAction.DESCEND, Mode.DESCEND),
]


def second_opinion(k: Known) -> FailsafeAction:
    """Return the final action: the worst that applies, after its necessary fallbacks."""
    worst = max(rule(k) for rule in RULES)
    if FailsafeAction.WARN < worst < FailsafeAction.DISARM:
        worst = next(
            (a for a, mode in _CHAIN if a >= worst and _flies(mode, k.c)), FailsafeAction.TERMINATE
        )
    if k.mode in (Mode.LAND, Mode.RETURN) and worst is FailsafeAction.RTL and _flies(k.mode, k.c):
        return FailsafeAction.WARN
    needless = worst in (FailsafeAction.RTL, FailsafeAction.LAND)
    if k.mode is Mode.PRECISION_LAND and needless and _flies(k.mode, k.c):
        return FailsafeAction.WARN
    return worst


CONDITIONS = st.builds(
    Conditions,
    **{
        name: st.sampled_from([False, False, False, True])
        for name, default in Conditions()._asdict().items()
        if isinstance(default, bool)
    },
    battery_warning=st.sampled_from(BatteryWarning),
    geofence=st.sampled_from([FenceBreach(), FenceBreach(), FenceBreach(distance=True)]),
)
OPTIONS = st.builds(
    FailsafeSettings,
    com_act_fail_act=st.integers(0, 4),
    com_fltt_low_act=st.integers(0, 3),
    com_low_bat_act=st.integers(0, 3),
    com_obl_rc_act=st.integers(0, 7),
    com_pos_low_act=st.integers(0, 5),
    com_dll_except=st.integers(0, 7),
    com_rc_in_mode=st.integers(0, 4),
    com_rcl_except=st.integers(0, 7),
    cbrk_flightterm=st.sampled_from([0, 121212]),
    gf_action=st.integers(0, 5),
    nav_dll_act=st.sampled_from([0, 1, 2, 3, 5, 6]),
    nav_rcl_act=st.sampled_from([1, 2, 3, 5, 6]),
    com_fail_act_t=st.just(5.0),
    com_lkdown_tko=st.just(3.0),
    com_spoolup_time=st.just(1.0),
)


@settings(max_examples=600)
@given(CONDITIONS, OPTIONS, st.sampled_from(Mode))
def test_what_flies_in_the_end_is_what_the_rules_say(
    conditions: Conditions, options: FailsafeSettings, mode: Mode
) -> None:
    machine = Machine(mode, options)
    machine.step(LONG_ARMED_US)
    machine.conditions = conditions
    machine.step()
    machine.step(6 * S)  # after the wait in Hold
    assert machine.action() is second_opinion(Known(conditions, options, mode))


@given(CONDITIONS, OPTIONS, st.sampled_from(Mode), st.integers(1, 5_900))
def test_the_wait_only_ever_holds(
    conditions: Conditions, options: FailsafeSettings, mode: Mode, later_ms: int
) -> None:
    """Until COM_FAIL_ACT_T is over, the vehicle holds, or does at once what ends it."""
    machine = Machine(mode, options)
    machine.step(LONG_ARMED_US)
    machine.conditions = conditions
    machine.step()
    machine.step(later_ms * MS)
    final = second_opinion(Known(conditions, options, mode))
    # As in PX4: landing or returning continues until a return turns out impossible.
    on_the_way = (
        {FailsafeAction.WARN} if mode in (Mode.LAND, Mode.RETURN, Mode.PRECISION_LAND) else set()
    )
    assert machine.action() in {final, FailsafeAction.HOLD, *on_the_way}
    if machine.action() is not final:
        assert later_ms < 5_000
        assert _flies(Mode.HOLD, conditions)
        assert final not in (FailsafeAction.DISARM, FailsafeAction.TERMINATE)


@given(CONDITIONS, OPTIONS, st.sampled_from(Mode))
def test_disarmed_nothing_acts_and_nothing_is_said(
    conditions: Conditions, options: FailsafeSettings, mode: Mode
) -> None:
    machine = Machine(mode, options)
    machine.armed = False
    machine.conditions = conditions
    machine.step()
    assert machine.action() is FailsafeAction.NONE
    assert machine.texts == []


@given(OPTIONS, st.sampled_from(Mode))
def test_nothing_fails_on_a_vehicle_that_lacks_nothing(
    options: FailsafeSettings, mode: Mode
) -> None:
    assert not any(answers(Situation(0, FINE, options, mode)).values())


def test_one_row_of_a_trigger_is_checked_at_a_time() -> None:
    for armed_us, breaker in product((None, 1), (0, 121212)):
        now = Situation(2, FINE, FailsafeSettings(cbrk_flightterm=breaker), Mode.HOLD)
        checked = [row.trigger for row in TABLE if row.checked(now._replace(armed_us=armed_us))]
        assert len(set(checked)) == len(checked)
