"""Failsafes, arming, take-off and landing in simulated time, against what PX4 was seen to do."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest

from airl_mav.control.demand import AttitudeDemand
from airl_mav.core.constants import US_PER_S
from airl_mav.profiles.px4_release import PX4ReleaseName
from airl_mav.profiles.vehicle import load_vehicle
from firmware_sim.autopilot.autopilot_state import Result, Severity, Wire
from firmware_sim.autopilot.commander import FlightPhase
from firmware_sim.autopilot.failsafes.framework import LOOK_US
from firmware_sim.autopilot.flight_modes import Mode
from firmware_sim.interfaces import ActuatorControls, SensorSample
from tests.support.flight_rig import Rig, flight, quad, velocity_setpoint

LOSS_S = (1.00, 1.13)
"""Last setpoint to "Failsafe activated": COM_OF_LOSS_T at least; PX4: 1.06 to 1.13 s."""

FALLBACK_M_S = 0.75
"""PX4 in Position mode without a pilot's sticks, measured."""

NORTHWARD = velocity_setpoint(2.0, 0.0, 0.0)
REST_DOWN_M = -0.055
"""Down position of the body's centre at rest: half its height [m]."""

NO_TAKEOVER_S = 2.0
SEED = 1


def count(rig: Rig, text: str) -> int:
    return sum(text in said for _, said in rig.texts)


def until_said(rig: Rig, text: str, limit_s: float) -> float:
    """Fly until a text is reported again; return the elapsed time [s]."""
    began_s, before = rig.time_s, count(rig, text)
    rig.until(lambda: count(rig, text) > before, limit_s)
    return rig.said(text) - began_s


def until_disarmed(rig: Rig, limit_s: float) -> float:
    return rig.until(lambda: rig.ap.flight.phase is FlightPhase.STANDBY, limit_s)


def highest_until_disarmed(rig: Rig, limit_s: float) -> float:
    """Fly until disarmed; return the maximum true height [m]."""
    heights = [rig.height]

    def disarmed() -> bool:
        heights.append(rig.height)
        return rig.ap.flight.phase is FlightPhase.STANDBY

    rig.until(disarmed, limit_s)
    return max(heights)


def under_way(rig: Rig, seconds: float = 4.0) -> int:
    """Take off, fly north offboard, fall silent; return the time of the last setpoint [µs]."""
    rig.take_off(5.0, settle_s=1.0)
    offered: list[int] = []
    accepted = rig.ap.on_setpoint
    assert accepted is not None

    def note(setpoint: Wire, time_us: int) -> None:
        offered.append(time_us)
        accepted(setpoint, time_us)

    rig.ap.on_setpoint = note
    rig.go_offboard(NORTHWARD)
    rig.run(seconds)
    assert rig.mode is Mode.OFFBOARD
    assert rig.truth.velocity[0] > 1.7
    rig.stream(None)
    return offered[-1]


def lose_offboard(rig: Rig) -> float:
    """Fly under way and fall silent until the failsafe acts; return its delay [s]."""
    last_us = under_way(rig)
    rig.until(lambda: count(rig, "Failsafe activated") > 0, 3.0)
    return (rig.texts[-1][0] - last_us) / 1e6


def horizontal(rig: Rig) -> float:
    """True distance from where the vehicle started [m]."""
    return float(np.hypot(*rig.truth.position[:2]))


# --- offboard loss


def test_loss_without_a_pilot_returns() -> None:
    """PX4 1.17: without a pilot, NAV_RCL_ACT replaces the Position mode of COM_OBL_RC_ACT 0."""
    with flight(SEED, parameters={"COM_OBL_RC_ACT": 0, "RTL_RETURN_ALT": 5.0}) as rig:
        assert LOSS_S[0] <= lose_offboard(rig) <= LOSS_S[1]
        assert rig.mode is Mode.RETURN
        until_disarmed(rig, 60.0)
        assert horizontal(rig) < 1.0


def test_loss_position_levels_descends_and_lands() -> None:
    old = load_vehicle("quad", "1.16")
    with flight(SEED, vehicle=old, parameters={"COM_OBL_RC_ACT": 0}) as rig:
        assert LOSS_S[0] <= lose_offboard(rig) <= LOSS_S[1]
        assert rig.mode is Mode.POSITION
        status = rig.ap.state().status
        assert (status.mode, status.intended_mode, status.failsafe) == (
            Mode.POSITION,
            Mode.OFFBOARD,
            True,
        )
        rig.run(1.0)
        before = float(np.hypot(*rig.truth.velocity[:2]))
        rig.run(1.5)
        # Level: drag alone slows it, v' = -k v / m. Real PX4 on this vehicle: 1.0 -> 0.32 in 7 s.
        body, drag = quad().body, quad().drag
        expected = before * math.exp(-1.5 * drag.linear_n_s_m / body.mass_kg)
        assert np.hypot(*rig.truth.velocity[:2]) == pytest.approx(expected, rel=0.15)
        sinking: list[float] = []
        rig.run(2.0, lambda: sinking.append(float(rig.truth.velocity[2])))
        assert np.mean(sinking) == pytest.approx(FALLBACK_M_S, abs=0.08)
        until_said(rig, "Landing detected", 15.0)
        assert rig.truth.position[2] == pytest.approx(REST_DOWN_M, abs=0.01)
        assert until_disarmed(rig, 5.0) == pytest.approx(2.0, abs=0.1)
        assert count(rig, "Disarmed by landing") == 1


def test_loss_return_lands_near_home() -> None:
    with flight(SEED, parameters={"COM_OBL_RC_ACT": 3, "RTL_RETURN_ALT": 7.0}) as rig:
        assert LOSS_S[0] <= lose_offboard(rig) <= LOSS_S[1]
        assert rig.mode is Mode.RETURN
        assert horizontal(rig) > 6.0
        assert 6.5 < highest_until_disarmed(rig, 60.0) < 8.5
        assert horizontal(rig) < 1.0
        assert rig.truth.position[2] == pytest.approx(REST_DOWN_M, abs=0.01)
        assert count(rig, "Disarmed by landing") == 1


def test_loss_land_lands_here() -> None:
    with flight(SEED, parameters={"COM_OBL_RC_ACT": 4}) as rig:
        assert LOSS_S[0] <= lose_offboard(rig) <= LOSS_S[1]
        assert rig.mode is Mode.LAND
        lost_at = rig.truth.position
        until_disarmed(rig, 30.0)
        assert np.hypot(*(rig.truth.position - lost_at)[:2]) < 3.0  # 2 m/s, braked
        assert rig.truth.position[2] == pytest.approx(REST_DOWN_M, abs=0.01)
        assert count(rig, "Disarmed by landing") == 1


def test_loss_hold_holds() -> None:
    with flight(SEED, parameters={"COM_OBL_RC_ACT": 5}) as rig:
        assert LOSS_S[0] <= lose_offboard(rig) <= LOSS_S[1]
        assert rig.mode is Mode.HOLD
        rig.run(5.0)
        here = rig.truth.position
        far: list[float] = []
        rig.run(12.0, lambda: far.append(float(np.linalg.norm(rig.truth.position - here))))
        assert max(far) < 0.5
        assert rig.mode is Mode.HOLD
        assert rig.ap.flight.phase is FlightPhase.AIR


@pytest.mark.parametrize(
    ("action", "phase", "text"),
    [
        (6, FlightPhase.AIR, "Disarmed by lockdown"),
        (7, FlightPhase.STANDBY, "Disarmed by failsafe"),
    ],
    ids=["terminate", "disarm"],
)
def test_loss_terminate_and_disarm_fall(action: int, phase: FlightPhase, text: str) -> None:
    with flight(SEED, parameters={"COM_OBL_RC_ACT": action}) as rig:
        assert LOSS_S[0] <= lose_offboard(rig) <= LOSS_S[1]
        assert rig.ap.flight.phase is phase
        rig.tick()
        assert rig.height > 4.0
        assert rig.ap.state().motors == (0.0, 0.0, 0.0, 0.0)
        # Free fall from there: sqrt(2 h / g), a little longer for the rotors' last thrust.
        fall_s = math.sqrt(2.0 * rig.height / 9.81)
        took = rig.until(lambda: bool(rig.sim.plant.collisions), 3.0)
        assert fall_s < took < fall_s + 0.3
        # Setpoints that come back start no motor.
        rig.stream(NORTHWARD)
        rig.run(5.0)
        assert rig.ap.flight.phase is FlightPhase.STANDBY
        assert count(rig, text) == 1
        assert rig.ap.state().motors == (0.0, 0.0, 0.0, 0.0)


def test_same_seed_same_tick() -> None:
    endings = []
    for _ in range(2):
        with flight(7, parameters={"COM_OBL_RC_ACT": 4}) as rig:
            lose_offboard(rig)
            until_disarmed(rig, 30.0)
            endings.append((rig.texts, rig.truth.position.tolist(), rig.truth.quaternion.tolist()))
    assert endings[0] == endings[1]


@pytest.mark.parametrize(
    ("action", "mode"), [(0, Mode.RETURN), (3, Mode.RETURN), (4, Mode.LAND), (5, Mode.HOLD)]
)
def test_setpoints_that_come_back_take_over(action: int, mode: Mode) -> None:
    with flight(SEED, parameters={"COM_OBL_RC_ACT": action, "RTL_RETURN_ALT": 5.0}) as rig:
        lose_offboard(rig)
        rig.run(1.5)
        assert rig.mode is mode
        rig.stream(NORTHWARD)
        rig.run(0.01)
        assert rig.mode is Mode.OFFBOARD
        assert not rig.ap.flight.failsafe
        rig.run(4.0)
        assert rig.truth.velocity[0] == pytest.approx(2.0, abs=0.3)
        assert count(rig, "Failsafe activated") == 1


def test_setpoints_do_not_overrule_what_the_user_chose_since() -> None:
    with flight(SEED, parameters={"COM_OBL_RC_ACT": 4}) as rig:
        lose_offboard(rig)
        assert rig.ap.set_mode(Mode.HOLD) is Result.ACCEPTED
        rig.stream(NORTHWARD)
        rig.run(NO_TAKEOVER_S)
        assert rig.mode is Mode.HOLD


@pytest.mark.parametrize(
    ("rate_hz", "alive"), [(4.0, True), (2.5, True), (1.5, True), (0.8, False)]
)
def test_slow_setpoints(rate_hz: float, alive: bool) -> None:
    """PX4: 4, 2.5 and 1.5 Hz keep offboard alive, 0.8 Hz flaps each period."""
    n = 4
    with flight(SEED) as rig:
        rig.take_off(5.0, settle_s=1.0)
        rig.go_offboard(NORTHWARD)
        rig.stream(None)
        modes: list[Mode] = []
        for _ in range(n):
            rig.ap.offer_setpoint(NORTHWARD, rig.sim.time_us)
            rig.run(1.0 / rate_hz, lambda: modes.append(rig.mode))
        if alive:
            assert set(modes) == {Mode.OFFBOARD}
            assert count(rig, "Failsafe") == 0
        else:
            changes = [(a, b) for a, b in pairwise(modes) if a is not b]
            lost, back = (Mode.OFFBOARD, Mode.RETURN), (Mode.RETURN, Mode.OFFBOARD)
            assert changes == [lost, *[back, lost] * (n - 1)]
            assert count(rig, "Failsafe activated") == n


def test_loss_time_is_a_parameter() -> None:
    with flight(SEED, parameters={"COM_OF_LOSS_T": 2.5, "COM_OBL_RC_ACT": 5}) as rig:
        assert 2.5 <= lose_offboard(rig) <= 2.6


def test_offboard_needs_setpoints() -> None:
    """PX4: refused in the air, accepted on the ground, where arming is refused then."""
    with flight(SEED) as rig:
        rig.boot()
        assert rig.ap.set_mode(Mode.OFFBOARD) is Result.ACCEPTED
        assert rig.ap.arm(force=False) is Result.TEMPORARILY_REJECTED
        assert count(rig, "Arming denied: Resolve system health failures first") == 1
        rig.ap.set_mode(Mode.HOLD)
        rig.take_off(2.5, settle_s=0.0)
        assert rig.ap.set_mode(Mode.OFFBOARD) is Result.TEMPORARILY_REJECTED
        assert count(rig, "Switching to Offboard is currently not available") == 1
        assert rig.mode is Mode.HOLD


# --- arming


@pytest.mark.parametrize("wait_s", [pytest.param(2.0, marks=pytest.mark.nightly), 5.0])
def test_disarms_after_landing(wait_s: float) -> None:
    with flight(SEED, parameters={"COM_DISARM_LAND": wait_s}) as rig:
        rig.take_off(2.5, settle_s=0.0)
        rig.ap.set_mode(Mode.LAND)
        until_said(rig, "Landing detected", 20.0)
        landed = rig.ap.flight.phase
        assert landed is FlightPhase.GROUND
        assert until_said(rig, "Disarmed by landing", 10.0) == pytest.approx(wait_s, abs=0.02)
        assert rig.ap.flight.phase is FlightPhase.STANDBY
        assert rig.mode is Mode.HOLD


@pytest.mark.parametrize("wait_s", [pytest.param(10.0, marks=pytest.mark.nightly), 3.0])
def test_disarms_without_take_off(wait_s: float) -> None:
    with flight(SEED, parameters={"COM_DISARM_PRFLT": wait_s}) as rig:
        rig.arm()
        text = "Disarmed by auto preflight disarming"
        assert until_said(rig, text, 15.0) == pytest.approx(wait_s, abs=0.02)
        assert rig.ap.flight.phase is FlightPhase.STANDBY
        assert count(rig, text) == 1


def test_disarming_times_can_be_switched_off() -> None:
    with flight(SEED, parameters={"COM_DISARM_LAND": -1.0, "COM_DISARM_PRFLT": -1.0}) as rig:
        rig.arm()
        rig.run(12.0)  # Two seconds more than it would take.
        assert rig.ap.flight.phase is FlightPhase.GROUND
        rig.ap.takeoff(2.5)
        rig.until(lambda: rig.mode is Mode.HOLD, 20.0)
        rig.ap.set_mode(Mode.LAND)
        until_said(rig, "Landing detected", 20.0)
        rig.run(4.0)
        assert rig.ap.flight.phase is FlightPhase.GROUND


def test_disarm_in_the_air_is_refused() -> None:
    with flight(SEED) as rig:
        rig.take_off(2.5, settle_s=0.0)
        assert rig.ap.disarm(force=False) is Result.TEMPORARILY_REJECTED
        assert count(rig, "Disarming denied: not landed") == 1
        rig.run(2.0)
        assert rig.ap.flight.phase is FlightPhase.AIR
        assert rig.height > 2.0


def test_kill_in_the_air_cuts_the_motors() -> None:
    with flight(SEED) as rig:
        commands: list[ActuatorControls] = []
        step = rig.ap.step

        def noted(sample: SensorSample) -> ActuatorControls:
            commands.append(step(sample))
            return commands[-1]

        rig.step_through(noted)
        rig.take_off(2.5, settle_s=0.0)
        assert max(commands[-1].motors) > 0.3
        assert rig.ap.disarm(force=True) is Result.ACCEPTED
        rig.tick()
        assert commands[-1].motors == (0.0, 0.0, 0.0, 0.0)
        assert not commands[-1].armed
        assert rig.until(lambda: bool(rig.sim.plant.collisions), 2.0) < 1.2
        rig.run(1.0)
        assert rig.ap.flight.phase is FlightPhase.STANDBY


def test_a_landing_in_offboard_attitude_disarms() -> None:
    """As in PX4, COM_DISARM_LAND counts although the motors idle."""
    with flight(SEED) as rig:
        rig.take_off(2.0)

        def hold(thrust: float, seconds: float) -> None:
            for _ in range(round(seconds / 0.05)):
                level = AttitudeDemand((1.0, 0.0, 0.0, 0.0), 0.0, thrust)
                rig.ap.offer_attitude(level, rig.sim.time_us)
                rig.run(0.05)

        hold(0.5, 0.1)
        assert rig.ap.set_mode(Mode.OFFBOARD) is Result.ACCEPTED
        hold(0.0, 3.0)
        assert rig.ap.flight.phase is FlightPhase.GROUND
        hold(0.4, 3.0)  # too much thrust for a vehicle that has landed
        assert rig.ap.flight.phase is FlightPhase.GROUND
        hold(0.0, 2.2)
        assert int(rig.ap.flight.phase) < FlightPhase.GROUND
        assert rig.said("Disarmed by landing") > rig.said("Landing detected") + 5.0


# --- battery

LOW, CRITICAL, EMERGENCY = "Low battery", "Critical battery", "Emergency battery level"
HELD = "Failsafe activated: entering Hold for 5 seconds"
HOLD_S = 5.0
"""COM_FAIL_ACT_T: hold time before a failsafe's action [s]."""


class Drain:
    """Overwrites the state of charge that the autopilot is shown."""

    def __init__(self, rig: Rig) -> None:
        self.remaining = 1.0
        self.per_s = 0.0
        self._step = rig.ap.step
        rig.step_through(self._tampered)

    def _tampered(self, sample: SensorSample) -> ActuatorControls:
        self.remaining = max(0.0, self.remaining - self.per_s * 0.004)
        battery = sample.battery._replace(remaining=self.remaining)
        return self._step(sample._replace(battery=battery))


@pytest.mark.parametrize(
    ("release", "severity", "warned"),
    [
        ("1.16", Severity.EMERGENCY, [(Severity.CRITICAL, "Failsafe activated")]),
        ("1.17", Severity.CRITICAL, []),
    ],
)
def test_battery_levels_are_said_once_each(
    release: PX4ReleaseName, severity: Severity, warned: list[tuple[Severity, str]]
) -> None:
    """From PX4 1.17 on, a warning is an event alone, and only an empty battery an emergency."""
    vehicle = load_vehicle("quad", release)
    with flight(SEED, vehicle=vehicle, parameters={"COM_LOW_BAT_ACT": 0}) as rig:
        drain = Drain(rig)
        rig.take_off(2.5, settle_s=0.0)
        rig.ap.take_messages()
        said: list[tuple[Severity, str, float]] = []

        def note() -> None:
            said.extend((m.severity, m.text, drain.remaining) for m in rig.ap.take_messages())

        drain.remaining, drain.per_s = 0.16, 0.008
        rig.run(16.0, note)
        assert [(each, text) for each, text, _ in said] == [
            *[(severity, LOW), *warned],
            *[(severity, CRITICAL), *warned],
            *[(Severity.EMERGENCY, EMERGENCY), *warned],
        ]
        levels = [level for level in (0.15, 0.07, 0.05) for _ in range(1 + len(warned))]
        assert [at for _, _, at in said] == pytest.approx(levels, abs=1e-3)
        assert rig.mode is Mode.HOLD  # 0 = only warn
        assert not rig.ap.flight.failsafe


def test_a_charge_that_wavers_is_said_once() -> None:
    with flight(SEED) as rig:
        drain = Drain(rig)
        rig.arm()
        for k in range(1000):
            drain.remaining = 0.15 + 0.001 * (-1) ** k
            rig.tick()
        assert count(rig, LOW) == 1


def test_critical_battery_holds_then_lands() -> None:
    with flight(SEED, parameters={"COM_LOW_BAT_ACT": 2}) as rig:
        drain = Drain(rig)
        rig.take_off(2.5, settle_s=1.0)
        drain.remaining = 0.10
        rig.run(1.0)
        assert (rig.mode, rig.ap.flight.failsafe) == (Mode.HOLD, False)
        drain.remaining = 0.065
        rig.until(lambda: rig.ap.flight.failsafe, 0.1)
        assert (rig.mode, count(rig, HELD)) == (Mode.HOLD, 1)
        assert rig.until(lambda: rig.mode is Mode.LAND, 6.0) == pytest.approx(HOLD_S, abs=0.05)
        until_disarmed(rig, 20.0)
        assert rig.truth.position[2] == pytest.approx(REST_DOWN_M, abs=0.01)


def test_a_critical_battery_forbids_arming_unless_it_is_allowed() -> None:
    """PX4: COM_ARM_BAT_MIN allows it, and then the failsafe of that charge does not act."""
    with flight(SEED, parameters={"COM_LOW_BAT_ACT": 2}) as rig:
        Drain(rig).remaining = 0.06
        rig.boot()
        rig.run(0.2)
        assert rig.ap.arm(force=False) is Result.TEMPORARILY_REJECTED
        assert count(rig, CRITICAL) >= 1
        assert rig.texts[-1][1] == "Arming denied: Resolve system health failures first"
        rig.ap.parameters.set("COM_ARM_BAT_MIN", 0.05)
        assert rig.ap.arm(force=False) is Result.ACCEPTED
        assert rig.ap.takeoff(2.0) is Result.ACCEPTED
        rig.until(lambda: rig.mode is Mode.HOLD, 20.0)
        rig.run(7.0)
        assert (rig.mode, rig.ap.flight.failsafe) == (Mode.HOLD, False)


def test_critical_battery_returns_then_lands_in_an_emergency() -> None:
    with flight(SEED, parameters={"COM_LOW_BAT_ACT": 3, "RTL_RETURN_ALT": 5.0}) as rig:
        drain = Drain(rig)
        under_way(rig)
        rig.ap.set_mode(Mode.HOLD)
        rig.run(3.0)
        assert horizontal(rig) > 6.0
        drain.remaining = 0.065
        rig.until(lambda: rig.mode is Mode.RETURN, 6.0)
        rig.until(lambda: horizontal(rig) < 4.0, 20.0)
        drain.remaining = 0.045
        rig.run(0.1)
        assert rig.mode is Mode.LAND  # at once: it is in a failsafe already
        until_disarmed(rig, 30.0)
        assert 0.5 < horizontal(rig) < 4.0


def test_critical_battery_returns_home() -> None:
    with flight(SEED, parameters={"COM_LOW_BAT_ACT": 3, "RTL_RETURN_ALT": 5.0}) as rig:
        drain = Drain(rig)
        under_way(rig)
        drain.remaining = 0.065
        rig.until(lambda: rig.mode is Mode.RETURN, 6.0)
        until_disarmed(rig, 60.0)
        assert horizontal(rig) < 1.0


@pytest.mark.parametrize("lost", [False, True], ids=["never lost", "lost before"])
def test_setpoints_do_not_overrule_the_battery(lost: bool) -> None:
    with flight(SEED, parameters={"COM_LOW_BAT_ACT": 2, "COM_OBL_RC_ACT": 5}) as rig:
        drain = Drain(rig)
        if lost:
            lose_offboard(rig)
            assert rig.mode is Mode.HOLD
        else:
            under_way(rig)
        drain.remaining = 0.065
        rig.run(0.1)
        rig.stream(NORTHWARD)
        rig.run(HOLD_S + NO_TAKEOVER_S)
        assert rig.mode is Mode.LAND


def test_the_user_flies_on_in_spite_of_the_battery() -> None:
    with flight(SEED, parameters={"COM_LOW_BAT_ACT": 2}) as rig:
        drain = Drain(rig)
        rig.take_off(5.0, settle_s=1.0)
        drain.remaining = 0.065
        rig.run(1.0)
        assert (rig.mode, rig.ap.flight.failsafe) == (Mode.HOLD, True)
        assert rig.ap.set_mode(Mode.HOLD) is Result.ACCEPTED
        assert not rig.ap.flight.failsafe
        rig.run(8.0)
        assert (rig.mode, rig.ap.flight.failsafe) == (Mode.HOLD, False)


# --- ground station


@pytest.mark.parametrize("limit_s", [pytest.param(10.0, marks=pytest.mark.nightly), 5.0])
def test_ground_station_lost_and_regained(limit_s: float) -> None:
    lost, back = "Connection to ground station lost", "GCS connection regained"
    with flight(SEED, parameters={"COM_DL_LOSS_T": limit_s}) as rig:
        rig.take_off(2.5, settle_s=0.0)
        rig.run(limit_s + 1.0)
        assert count(rig, lost) == 0  # none was ever there
        for _ in range(3):
            rig.ap.gcs_heartbeat(rig.sim.time_us)
            rig.run(1.0)
        assert limit_s <= until_said(rig, lost, 15.0) + 1.0 <= limit_s + LOOK_US / US_PER_S + 0.01
        rig.run(limit_s + 2.0)
        assert count(rig, lost) == 1
        assert count(rig, back) == 0
        rig.ap.gcs_heartbeat(rig.sim.time_us)
        rig.tick()
        assert count(rig, back) == 1
        rig.run(2.0)
        assert (count(rig, lost), count(rig, back)) == (1, 1)
        assert rig.mode is Mode.HOLD  # NAV_DLL_ACT = 0: nothing else happens


# --- take-off, landing, return


def test_take_off() -> None:
    with flight(SEED) as rig:
        rig.arm()
        assert rig.ap.takeoff(None) is Result.ACCEPTED
        assert count(rig, "Using default takeoff altitude: 2.5 m") == 1
        # PX4: off the ground 2.8 s after the command, after spool-up and ramp.
        lifted_s = rig.until(lambda: rig.height > 0.02, 10.0)
        assert 1.5 < lifted_s < 4.0
        rig.until(lambda: count(rig, "Takeoff detected") > 0, 2.0)
        rig.until(lambda: rig.mode is Mode.HOLD, 10.0)
        assert 1.4 < rig.height < 2.0  # PX4: 1.7, NAV_MC_ALT_RAD below
        rig.run(8.0)
        assert rig.height == pytest.approx(2.5, abs=0.3)


def test_take_off_to_ten_metres_takes_as_long_as_px4() -> None:
    with flight(SEED) as rig:
        rig.arm()
        rig.ap.takeoff(10.0)
        took_s = rig.until(lambda: rig.mode is Mode.HOLD, 30.0)
        assert took_s == pytest.approx(12.3, rel=0.2)
        rig.run(8.0)
        assert rig.height == pytest.approx(10.0, abs=0.3)


def test_take_off_while_disarmed_stays() -> None:
    with flight(SEED) as rig:
        rig.boot()
        assert rig.ap.takeoff(2.5) is Result.ACCEPTED
        rig.run(6.0)
        assert rig.height < 0.001
        assert rig.ap.flight.phase is FlightPhase.STANDBY


def test_landing_from_eight_metres() -> None:
    with flight(SEED) as rig:
        rig.take_off(8.0)
        above = rig.truth.position
        assert rig.ap.set_mode(Mode.LAND, commanded=True) is Result.ACCEPTED
        assert count(rig, "Landing at current position") == 1
        took_s = until_said(rig, "Landing detected", 30.0)
        assert 10.0 < took_s < 20.0  # PX4: 14.5 s
        touched = [c.speed_m_s for c in rig.sim.plant.collisions]
        assert len(touched) == 1
        assert touched[0] < 1.0
        assert np.hypot(*(rig.truth.position - above)[:2]) < 0.5
        assert until_disarmed(rig, 5.0) == pytest.approx(2.0, abs=0.1)


def test_return_climbs_flies_home_and_lands() -> None:
    with flight(SEED, parameters={"RTL_RETURN_ALT": 8.0}) as rig:
        under_way(rig, 8.0)
        assert horizontal(rig) > 12.0
        began = horizontal(rig)
        assert rig.ap.set_mode(Mode.RETURN) is Result.ACCEPTED
        rig.until(lambda: rig.height > 7.0, 10.0)
        assert horizontal(rig) > began - 3.0  # climbed before it flew home
        until_disarmed(rig, 60.0)
        assert horizontal(rig) < 1.0
        assert rig.truth.position[2] == pytest.approx(REST_DOWN_M, abs=0.01)


@pytest.mark.nightly
def test_return_near_home_does_not_climb() -> None:
    with flight(SEED, parameters={"RTL_RETURN_ALT": 60.0}) as rig:
        rig.take_off(4.0, settle_s=1.0)
        rig.ap.set_mode(Mode.RETURN)
        assert highest_until_disarmed(rig, 40.0) < 4.5
        assert horizontal(rig) < 1.0


@pytest.mark.parametrize(
    ("mode", "text"),
    [
        (Mode.LAND, "Landing at current position"),
        (Mode.PRECISION_LAND, "Precision landing"),
        (Mode.RETURN, "Returning to launch"),
    ],
)
def test_a_command_of_its_own_is_told_and_a_choice_of_modes_is_not(mode: Mode, text: str) -> None:
    """On a PX4 1.16: disarmed, in flight, and when it is flown already."""
    with flight(SEED) as rig:
        rig.boot()
        assert rig.ap.set_mode(mode, commanded=True) is Result.ACCEPTED
        assert count(rig, text) == 1
        assert count(rig, "RTL: start return at") == 0, "disarmed nothing is flown"
        rig.ap.set_mode(Mode.HOLD)
        rig.take_off(6.0)
        rig.ap.set_mode(mode)
        assert count(rig, text) == 1
        for said in (2, 3):
            rig.ap.set_mode(mode, commanded=True)
            assert count(rig, text) == said
