"""Policy commands: velocity, attitude or body rates, each distinguishable from the others."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.control.loops import attitude_setpoint
from airl_mav.core.clock import SimClock
from airl_mav.core.constants import GRAVITY_M_S2, CommandKind
from airl_mav.core.errors import FieldError
from airl_mav.core.frames import down_in_body
from airl_mav.latency.stamps import SETPOINTS, DecisionLog, commanded, setpoint_column
from airl_mav.policy.actions import (
    Action,
    ActionSpec,
    Attitude,
    BodyRates,
    command,
    command_kind,
    commands,
    continuous_numbers,
    flyable,
)
from airl_mav.policy.layouts import boxes, encode_layout
from airl_mav.policy.observation import InFlight, Kinematics, observe
from airl_mav.policy.observation_spec import ObservationSpec
from airl_mav.policy.registry import PolicyInfo, find_policy
from airl_mav.scenario.checks import check_commands, check_compensated, decide_piloting
from airl_mav.scenario.model import Scenario, WatchdogSettings
from companion.link_interface import STOP, BodyVelocity, Setpoint, VehicleStatus
from companion.watchdog import Watchdog
from firmware_sim.recording import SetpointLog
from tests.support.processes import ROOT

RATES = f"{ROOT / 'examples' / 'own_body_rates.py'}:ToGoal"
HALF = BodyRates(0.1, -0.2, 0.3, 0.5)
LEAN = Attitude(0.1, -0.2, 3.0, 0.5)


class Leaning:
    """Commands attitudes."""

    commands = "attitude"

    def act(self, _observation: Any) -> Attitude:
        return LEAN


# --- actions


def test_a_policy_says_what_it_commands_or_it_is_a_velocity() -> None:
    assert command_kind(object()) == "velocity"
    assert command_kind(Leaning) == command_kind(Leaning()) == "attitude"
    wrong = type("Torques", (), {"commands": "torque"})
    with pytest.raises(FieldError, match="commands = 'torque'; accepted: velocity, attitude, body"):
        command_kind(wrong)


def test_each_kind_of_action_passes_as_its_own_alone() -> None:
    assert flyable(HALF, "body_rates", 5.0) == HALF
    assert flyable(LEAN, "attitude", 5.0) == LEAN
    assert flyable(Action(9.0, 0.0, 0.0), "velocity", 5.0) == Action(5.0, 0.0, 0.0)
    for action, kind in ((HALF, "velocity"), (LEAN, "body_rates"), (Action(0, 0, 0), "attitude")):
        with pytest.raises(TypeError, match=f"it returned {type(action).__name__}; accepted: "):
            flyable(action, kind, 5.0)  # type: ignore[arg-type]


@given(st.floats(allow_nan=False, allow_infinity=False))
def test_a_thrust_is_a_share(thrust: float) -> None:
    flown = flyable(HALF._replace(thrust=thrust), "body_rates", 5.0)
    assert isinstance(flown, BodyRates)
    assert flown[:3] == HALF[:3]
    assert flown.thrust == min(1.0, max(0.0, thrust))


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("place", range(4))
def test_nothing_is_put_in_the_place_of_what_is_no_number(bad: float, place: int) -> None:
    """A velocity of nothing is a stand; a thrust of nothing is a fall."""
    numbers = list(HALF)
    numbers[place] = bad
    with pytest.raises(ValueError, match="what is no number"):
        flyable(BodyRates(*numbers), "body_rates", 5.0)
    with pytest.raises(ValueError, match="what is no number"):
        flyable(Attitude(*numbers), "attitude", 5.0)


# --- the action set


def test_the_set_of_body_rates_by_hand() -> None:
    spec = ActionSpec(set="body-rates", max_rate_deg_s=90.0)
    assert continuous_numbers(spec) == 4
    assert spec.commands == "body_rates"
    found = command(spec, np.array([1.0, -0.5, 0.0, 0.2]))
    assert isinstance(found, BodyRates)
    assert found == pytest.approx((math.pi / 2, -math.pi / 4, 0.0, 0.6))
    beyond = commands(spec, np.array([[9.0, -9.0, 0.0, -9.0], [0.0, 0.0, 0.0, 9.0]]))
    np.testing.assert_allclose(
        beyond, [[math.pi / 2, -math.pi / 2, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
    )


def test_a_card_from_before_there_were_body_rates_stays_as_it_was() -> None:
    assert ActionSpec().model_dump() == {"set": "arc-25", "max_speed_m_s": 5.0}
    assert ActionSpec(max_rate_deg_s=90.0).model_dump()["max_rate_deg_s"] == 90.0


# --- network inputs


def state_of(turns: Rotation, rates: np.ndarray | None) -> Kinematics:
    n = len(turns)
    return Kinematics(np.zeros((n, 3)), np.zeros((n, 3)), np.roll(turns.as_quat(), 1, 1), rates)


def told(names: tuple[str, ...], turns: Rotation, rates: np.ndarray | None) -> np.ndarray:
    spec = ObservationSpec.model_validate(
        {"height_px": 8, "width_px": 8, "horizontal_fov_deg": 90.0, "range_m": 20.0}
        | {"in_flight": names}
    )
    n = len(turns)
    setpoint = np.arange(4.0 * n).reshape(n, 4)
    known = InFlight(np.full(n, 0.1), np.full(n, 0.2), setpoint)
    image, goal = np.zeros((n, 8, 8), np.uint16), np.tile([10.0, 0.0], (n, 1))
    lens = Intrinsics.from_fov(8, 8, math.radians(90.0))
    seen = observe(image, lens, state_of(turns, rates), goal, known)
    found = encode_layout(spec, seen)["in_flight"]
    assert found.shape == (n, *boxes(spec)["in_flight"].shape)
    return found


def test_tilt_is_where_down_lies_in_the_body() -> None:
    turns = Rotation.random(50, random_state=1)
    down = turns.inv().apply([0.0, 0.0, 1.0])
    np.testing.assert_allclose(told(("tilt",), turns, None), down, atol=1e-6)
    roll, pitch = np.array([0.3]), np.array([-0.7])
    by_hand = Rotation.from_euler("ZYX", [[1.0, -0.7, 0.3]]).inv().apply([0.0, 0.0, 1.0])
    np.testing.assert_allclose(down_in_body(roll, pitch), by_hand, atol=1e-12)


def test_rates_and_the_whole_setpoint_are_told() -> None:
    turns, rates = Rotation.random(3, random_state=2), np.arange(9.0).reshape(3, 3)
    found = told(("rates", "setpoint", "command"), turns, rates)
    np.testing.assert_allclose(found[:, :3], rates)
    np.testing.assert_allclose(found[:, 3:7], np.arange(12.0).reshape(3, 4))
    np.testing.assert_allclose(found[:, 7:], found[:, [3, 4, 6]] / (5.0, 5.0, 1.0))
    with pytest.raises(ValueError, match="body rates, and nobody measures them"):
        told(("rates",), turns, None)


# --- the record


@pytest.mark.parametrize("kind", SETPOINTS)
def test_setpoints_have_a_column_of_their_kind(kind: CommandKind) -> None:
    log = DecisionLog(commands=kind)
    log.record(1, 2, 3, 4, 5, 6, HALF)
    columns = log.columns()
    name = setpoint_column(columns)
    assert name == SETPOINTS[kind]
    np.testing.assert_array_equal(columns[name], np.array([HALF], np.float32))
    assert commanded(columns) == kind
    assert [other for other in SETPOINTS.values() if other in columns] == [name]


def test_body_rates_overtake_the_velocity_before_them() -> None:
    """A velocity is in the motors two ticks later, body rates in the same one."""
    log = SetpointLog()
    log.accepted((1.0, 0.0, 0.0, 0.0), 1_000)
    log.take(2)
    log.flown(4_000, 1)
    log.accepted((0.1, 0.2, 0.3, 0.5), 5_000)
    log.take(0)
    log.flown(8_000, 2)
    found = log.arrays()
    np.testing.assert_array_equal(found["accepted_us"], [1_000, 5_000])
    np.testing.assert_array_equal(found["motor_us"], [12_000, 8_000])


def test_a_setpoint_that_no_motor_has_flown_is_not_in_the_record() -> None:
    log = SetpointLog()
    log.accepted((1.0, 0.0, 0.0, 0.0), 1_000)
    log.take(2)
    log.flown(4_000, 1)
    assert not log.arrays()["accepted_us"].size


# --- execution


def piloting(policy: PolicyInfo, **asked: Any) -> tuple[Any, Any]:
    return decide_piloting(Scenario.model_validate(asked), policy, 3.0)


def test_body_rates_are_decided_with_every_image_and_soon_replaced() -> None:
    policy = find_policy(RATES)
    assert policy.commands == "body_rates"
    pilot, watchdog = piloting(policy)
    assert (pilot.commands, pilot.decisions) == ("body_rates", "pipelined")
    assert watchdog.decision_timeout_s == 0.15
    held, watchdog = piloting(policy, decisions="sequential", hold_s=0.1)
    assert (held.hold_s, watchdog.decision_timeout_s) == (0.1, pytest.approx(0.25))
    _, watchdog = piloting(policy, watchdog={"decision_timeout_s": 1.0})
    assert watchdog.decision_timeout_s == 1.0
    pilot, watchdog = piloting(find_policy("greedy"))
    assert (pilot.commands, watchdog.decision_timeout_s) == ("velocity", 2.0)


def test_what_cannot_be_flown_by_body_rates_or_attitude_is_refused() -> None:
    rates = find_policy(RATES)
    leaning = find_policy(f"{__name__}:Leaning")
    assert leaning.commands == "attitude"
    with pytest.raises(
        FieldError, match="at level lockstep or sitl: the vectorized simulator flies"
    ):
        check_commands(leaning, "Leaning", level="gym")
    check_commands(rates, "ToGoal", level="gym")
    for policy in (rates, leaning):
        with pytest.raises(FieldError, match="ArduPilot takes a thrust for a climb rate"):
            check_commands(policy, policy.name, level="sitl", firmware="ardupilot")
        check_commands(policy, policy.name, level="sitl", firmware="px4")
        pilot, _ = piloting(policy, compensate=True)
        vehicle: Any = None
        with pytest.raises(FieldError, match="whose effect is not foreseen"):
            check_compensated(pilot, policy, vehicle)


# --- the watchdog


class Noting:
    """A link that notes what is sent."""

    connected = True

    def __init__(self) -> None:
        self.sent: list[Setpoint] = []

    def send_setpoint(self, setpoint: Setpoint) -> None:
        self.sent.append(setpoint)

    def kinematics(self) -> Kinematics:
        raise NotImplementedError

    def status(self) -> VehicleStatus:
        return VehicleStatus(armed=True, offboard=True, mode="offboard")

    def release(self) -> None:
        raise NotImplementedError

    def leave_offboard(self) -> None:
        self.sent.clear()


@pytest.mark.parametrize(
    ("setpoint", "before"),
    [
        (HALF, [BodyRates(0.0, 0.0, 0.0, HALF.thrust)]),
        (LEAN, [Attitude(0.0, 0.0, LEAN.yaw_rad, LEAN.thrust)]),
        (BodyVelocity(1.0, 0.0, 0.0, 0.0), []),
    ],
)
def test_an_overdue_turn_or_lean_is_ended_before_the_stop(
    setpoint: Setpoint, before: list[Setpoint]
) -> None:
    """PX4 flies the stop, which is a velocity, up to half a second later."""
    link, clock = Noting(), SimClock()
    watchdog = Watchdog(link, clock, WatchdogSettings(decision_timeout_s=0.2))
    assert watchdog.by_velocity
    assert watchdog.command(setpoint, 0)
    assert watchdog.by_velocity == (not before)
    clock.advance(200_000)
    watchdog.look()
    assert link.sent == [setpoint, *before, STOP]
    assert watchdog.by_velocity
    clock.advance(100_000)
    watchdog.look()
    assert len(link.sent) == 2 + len(before), "once"


@given(*(st.floats(-8.0, 8.0) for _ in range(3)), st.floats(-3.1, 3.1), st.floats(0.2, 0.7))
def test_an_attitude_accelerates_as_it_is_asked_to(
    forward: float, right: float, down: float, yaw: float, hover: float
) -> None:
    """Against scipy's rotations and the PX4 mathematics of the flight controllers."""
    asked = np.array([forward, right, down])
    made = Attitude.accelerating(*asked, yaw_rad=yaw, hover_thrust=hover)
    body = Rotation.from_euler("ZYX", [made.yaw_rad, made.pitch_rad, made.roll_rad])
    gravity = np.array([0.0, 0.0, GRAVITY_M_S2])
    flown = body.apply(-gravity * made.thrust / hover) + gravity
    heading = Rotation.from_euler("Z", yaw)
    np.testing.assert_allclose(heading.inv().apply(flown), asked, atol=1e-9)
    thrust = heading.apply(asked) - gravity
    px4 = attitude_setpoint(tuple(thrust), math.cos(yaw), math.sin(yaw))
    theirs = Rotation.from_quat(px4, scalar_first=True)
    assert (body.inv() * theirs).magnitude() < 1e-6
