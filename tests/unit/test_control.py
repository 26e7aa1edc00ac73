"""The cascade, stage by stage, against numpy and scipy."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy import signal
from scipy.spatial.transform import Rotation

from airl_mav.control.cascade import Output, cascade_tick, filters
from airl_mav.control.demand import Demand, Gains
from airl_mav.control.loops import (
    attitude_setpoint,
    mix,
    rate_control,
    rate_setpoint,
    thrust_from_acceleration,
    velocity_control,
    velocity_setpoint,
)
from airl_mav.control.memory import (
    Biquad,
    butterworth,
    filtered,
    new_memory,
    reset_integrals,
    settled,
    weight,
)
from airl_mav.core.constants import DEG, GRAVITY_M_S2, TICK_S
from airl_mav.core.frames import quat_wxyz_to_xyzw, wrap_pi
from airl_mav.vehicle.rotation import Quat, Vec
from firmware_sim.autopilot.parameter_store import Parameters
from firmware_sim.engine.controller import Controller

GAINS = Gains.from_parameters(Parameters({"MPC_THR_HOVER": 0.52}).__getitem__)
FILTERS = filters(GAINS, TICK_S)
NAN = math.nan
NAN3 = (NAN, NAN, NAN)
ZERO = (0.0, 0.0, 0.0)

small = st.floats(-1.0, 1.0)
angles = st.floats(-math.pi, math.pi)
triples = st.tuples(*[st.floats(-50.0, 50.0)] * 3)
quaternions = (
    st.tuples(*[small] * 4)
    .filter(lambda q: math.hypot(*q) > 0.1)
    .map(lambda q: tuple(c / math.hypot(*q) for c in q))
)

S = math.sqrt(0.5)
ARMS = np.array([(0.13, 0.22), (-0.13, -0.22), (0.13, -0.22), (-0.13, 0.22)])
"""Forward and right of motors FR, RL, FL, RR: vehicles/quad."""


def px4_allocation(arms: np.ndarray) -> np.ndarray:
    """ControlAllocationPseudoInverse of PX4 1.16: roll, pitch, yaw, lift (columns) of each motor.

    Where each motor stands decides the signs (roll right = less right lift; nose up = more front
    lift), a counter-clockwise rotor yaws the body clockwise. Roll and pitch share one scale.
    """
    turns = np.array([1.0, 1.0, -1.0, -1.0])
    mixed = np.linalg.pinv(np.array([-arms[:, 1], arms[:, 0], turns, np.ones(4)]))
    strongest = np.sqrt((mixed[:, :2] ** 2).sum(axis=0) / 2.0).max()
    return mixed / [strongest, strongest, mixed[:, 2].max(), np.abs(mixed[:, 3]).mean()]


ALLOCATION = px4_allocation(ARMS)
EFFECT = np.linalg.inv(ALLOCATION)


def scipy_of(q: tuple[float, ...]) -> Rotation:
    return Rotation.from_quat(quat_wxyz_to_xyzw(np.array(q)))


# --- mixer


def test_the_weaker_axis_moves_a_motor_by_sin_45_deg() -> None:
    """Arms further out to the side than ahead: roll needs less of each motor than pitch."""
    expected = [S * 0.13 / 0.22, S, 1.0, 1.0]
    np.testing.assert_allclose(np.abs(ALLOCATION), np.tile(expected, (4, 1)), atol=1e-12)
    assert (GAINS.mix_roll, GAINS.mix_pitch) == pytest.approx(expected[:2])


@pytest.mark.parametrize(("forward", "right"), [(0.2, 0.2), (0.3, 0.1), (0.1, 0.11)])
def test_allocation_follows_the_arms(forward: float, right: float) -> None:
    parameters = Parameters()
    arms = ARMS / np.abs(ARMS) * [forward, right]
    for i, (x, y) in enumerate(arms.tolist()):
        parameters.set(f"CA_ROTOR{i}_PX", x)
        parameters.set(f"CA_ROTOR{i}_PY", y)
    gains = Gains.from_parameters(parameters.__getitem__)
    torque = (0.05, -0.1, 0.02)
    expected = px4_allocation(arms) @ [*torque, 0.5]
    np.testing.assert_allclose(mix(0.5, torque, gains)[0], expected, atol=1e-12)


def test_unknown_arms_are_equal_ones() -> None:
    parameters = Parameters()
    for i in range(4):
        parameters.set(f"CA_ROTOR{i}_PY", 0.0)
    gains = Gains.from_parameters(parameters.__getitem__)
    assert (gains.mix_roll, gains.mix_pitch) == (S, S)


@given(st.floats(0.2, 0.8), st.tuples(*[st.floats(-0.25, 0.25)] * 3))
def test_inside_the_limits_the_allocation_is_exact(thrust: float, torque: Vec) -> None:
    expected = ALLOCATION @ [*torque, thrust]
    # PX4 fits roll, pitch and thrust into the limits first, yaw after them.
    without_yaw = ALLOCATION @ [torque[0], torque[1], 0.0, thrust]
    for commands in (expected, without_yaw):
        assume(commands.min() >= 0.0 and commands.max() <= 1.0)
    motors, missing = mix(thrust, torque, GAINS)
    np.testing.assert_allclose(motors, expected, atol=1e-12)
    np.testing.assert_allclose(EFFECT @ motors, [*torque, thrust], atol=1e-12)
    assert missing == ZERO


@given(st.floats(-0.5, 1.5), st.tuples(*[st.floats(-3.0, 3.0)] * 3))
def test_outputs_are_commands(thrust: float, torque: Vec) -> None:
    motors, missing = mix(thrust, torque, GAINS)
    assert all(0.0 <= m <= 1.0 for m in motors)
    delivered = EFFECT @ motors
    np.testing.assert_allclose(np.array(missing) + delivered[:3], torque, atol=2e-6)


@given(st.floats(0.0, 1.0), st.tuples(*[st.floats(-2.0, 2.0)] * 3))
def test_thrust_is_lowered_never_raised(thrust: float, torque: Vec) -> None:
    motors, _ = mix(thrust, torque, GAINS)
    asked_without_limits = ALLOCATION @ [*torque, thrust]
    # Clipping the last bit of a motor at 0 may add lift beyond the request. The excess is at most
    # the removed negative command.
    clipped = np.clip(-asked_without_limits, 0.0, None).sum() / 4
    assert EFFECT[3] @ motors <= thrust + clipped + 1e-9


@given(
    st.floats(0.3, 0.42) | st.floats(0.78, 0.9),
    st.floats(-0.12, 0.12),
    st.floats(-0.12, 0.12),
    st.floats(-3.0, 3.0),
)
def test_yaw_never_costs_roll_or_pitch(
    thrust: float, roll: float, pitch: float, yaw: float
) -> None:
    """Around half thrust yaw may fill the range from both ends; PX4 then clips a little."""
    motors, _ = mix(thrust, (roll, pitch, yaw), GAINS)
    delivered = EFFECT @ motors
    np.testing.assert_allclose(delivered[:2], [roll, pitch], atol=1e-9)
    assert abs(delivered[2]) <= abs(yaw) + 1e-9
    assert delivered[2] * yaw >= -1e-9, "never the other way"


@given(st.floats(0.75, 1.0), st.floats(-0.3, 0.3), st.floats(-0.3, 0.3))
def test_roll_and_pitch_are_kept_at_full_thrust(thrust: float, roll: float, pitch: float) -> None:
    motors, missing = mix(thrust, (roll, pitch, 0.0), GAINS)
    delivered = EFFECT @ motors
    np.testing.assert_allclose(delivered[:2], [roll, pitch], atol=1e-9)
    room = 1.0 - ALLOCATION[:, :2].max(axis=0) @ [abs(roll), abs(pitch)]
    assert delivered[3] == pytest.approx(min(thrust, room), abs=1e-9)
    assert missing == ZERO


def test_some_yaw_is_left_at_full_thrust() -> None:
    motors, _ = mix(1.0, (0.0, 0.0, 0.5), GAINS)
    delivered = EFFECT @ motors
    assert delivered[2] == pytest.approx(0.15, abs=0.01)  # PX4's MINIMUM_YAW_MARGIN.
    assert delivered[3] == pytest.approx(0.85, abs=0.01)


def px4_mix(thrust: float, torque: Vec) -> np.ndarray:
    """ControlAllocationSequentialDesaturation::mixAirmodeDisabled of PX4 1.16, from its source.

    There thrust points down: its column is -1 and "increase only" means less lift.
    """
    effect = dict(zip(("roll", "pitch", "yaw"), ALLOCATION.T, strict=False))
    effect["thrust"] = -np.ones(4)

    def gain(sp: np.ndarray, vector: np.ndarray, top: float) -> float:
        k_min = k_max = 0.0
        for command, share in zip(sp, vector, strict=True):
            if abs(share) < 0.2:
                continue
            if command < 0.0:
                k = (0.0 - command) / share
                k_min, k_max = min(k_min, k), max(k_max, k)
            if command > top:
                k = (top - command) / share
                k_min, k_max = min(k_min, k), max(k_max, k)
        return k_min + k_max

    def desaturate(
        sp: np.ndarray, axis: str, *, top: float = 1.0, increase_only: bool = False
    ) -> np.ndarray:
        first = gain(sp, effect[axis], top)
        if increase_only and first < 0.0:
            return sp
        sp = sp + first * effect[axis]
        return sp + 0.5 * gain(sp, effect[axis], top) * effect[axis]

    sp = torque[0] * effect["roll"] + torque[1] * effect["pitch"] - thrust * effect["thrust"]
    sp = desaturate(sp, "thrust", increase_only=True)
    sp = desaturate(sp, "roll")
    sp = desaturate(sp, "pitch")
    sp = desaturate(sp + torque[2] * effect["yaw"], "yaw", top=1.15)
    sp = desaturate(sp, "thrust", increase_only=True)
    return np.clip(sp, 0.0, 1.0)


@given(st.floats(-0.2, 1.3), st.tuples(*[st.floats(-3.0, 3.0)] * 3))
def test_saturation_is_px4s(thrust: float, torque: Vec) -> None:
    np.testing.assert_allclose(mix(thrust, torque, GAINS)[0], px4_mix(thrust, torque), atol=1e-9)


# --- attitude setpoint


@given(triples, angles)
def test_thrust_axis_and_heading_are_as_asked(thrust: Vec, yaw: float) -> None:
    thrust = (thrust[0], thrust[1], -abs(thrust[2]))
    assume(np.linalg.norm(thrust) > 0.01)
    # Upwards thrust, no closer than 2 degrees to the horizon: there heading loses its meaning.
    assume(-thrust[2] > 0.03 * np.linalg.norm(thrust))
    turn = scipy_of(attitude_setpoint(thrust, math.cos(yaw), math.sin(yaw)))
    up = turn.apply([0.0, 0.0, -1.0])
    np.testing.assert_allclose(up, np.array(thrust) / np.linalg.norm(thrust), atol=1e-9)
    assert abs(wrap_pi(turn.as_euler("ZYX")[0] - yaw)) < 1e-7


@given(triples, angles)
def test_upside_down_keeps_the_thrust_axis_and_the_nose_ahead(thrust: Vec, yaw: float) -> None:
    thrust = (thrust[0], thrust[1], abs(thrust[2]))
    assume(thrust[2] > 0.03 * np.linalg.norm(thrust) > 1e-4)
    turn = scipy_of(attitude_setpoint(thrust, math.cos(yaw), math.sin(yaw)))
    up, nose = turn.apply([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
    np.testing.assert_allclose(up, np.array(thrust) / np.linalg.norm(thrust), atol=1e-9)
    assert nose[:2] @ [math.cos(yaw), math.sin(yaw)] > 0.0


@given(angles)
def test_no_thrust_is_level(yaw: float) -> None:
    turn = scipy_of(attitude_setpoint(ZERO, math.cos(yaw), math.sin(yaw)))
    np.testing.assert_allclose(turn.apply([0.0, 0.0, 1.0]), [0, 0, 1], atol=1e-12)
    # A cosine knows angles around zero to the root of its last digit.
    assert abs(wrap_pi(turn.as_euler("ZYX")[0] - yaw)) < 2e-8


# --- attitude control


@given(quaternions)
def test_no_error_no_rate(q: Quat) -> None:
    np.testing.assert_allclose(rate_setpoint(q, q, 0.0, GAINS), 0.0, atol=1e-6)
    minus = (-q[0], -q[1], -q[2], -q[3])
    np.testing.assert_allclose(rate_setpoint(q, minus, 0.0, GAINS), 0.0, atol=1e-6)


@pytest.mark.nightly
@given(quaternions, quaternions)
def test_rates_reduce_the_error(q: Quat, q_sp: Quat) -> None:
    goal, now = scipy_of(q_sp), scipy_of(q)
    error = (now.inv() * goal).magnitude()
    assume(0.01 < error < 3.0)
    rates = rate_setpoint(q, q_sp, 0.0, GAINS)
    # The rate is along a way to the goal that takes tilt first: following it must get there, and
    # once it is there in all axes it has nothing more to do.
    for _ in range(1000):
        if max(map(abs, rates)) < 1e-3:
            break
        now = now * Rotation.from_rotvec(np.array(rates) * 0.01)
        q_now = now.as_quat()
        rates = rate_setpoint((q_now[3], *q_now[:3]), q_sp, 0.0, GAINS)
    assert (now.inv() * goal).magnitude() < 0.01


@given(st.tuples(*[st.floats(-0.3, 0.3)] * 2), quaternions)
def test_small_tilt_errors_are_turned_back_proportionally(
    tilt: tuple[float, float], q: Quat
) -> None:
    error = Rotation.from_rotvec([*tilt, 0.0])
    goal = (scipy_of(q) * error).as_quat()
    rates = rate_setpoint(q, (goal[3], *goal[:3]), 0.0, GAINS)
    expected = 2 * GAINS.att_p_roll * error.as_quat()[:3]  # 2 sin(angle / 2) along the axis.
    np.testing.assert_allclose(rates, expected, atol=1e-6)


@given(st.floats(-0.5, 0.5))
def test_a_pure_heading_error_has_the_gain_of_mc_yaw_p(yaw: float) -> None:
    q_sp = (math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2))
    w = GAINS.yaw_weight
    expected = GAINS.att_p_yaw / w * 2 * math.sin(w * yaw / 2)
    rates = rate_setpoint((1.0, 0.0, 0.0, 0.0), q_sp, 0.0, GAINS)
    np.testing.assert_allclose(rates, [0.0, 0.0, expected], atol=1e-9)
    if 0.01 < abs(yaw) < 0.1:
        assert rates[2] == pytest.approx(GAINS.att_p_yaw * yaw, rel=1e-3)


@given(quaternions, st.floats(-2.0, 2.0))
def test_heading_rate_is_about_the_worlds_down_axis(q: Quat, rate: float) -> None:
    expected = scipy_of(q).inv().apply([0.0, 0.0, rate])
    np.testing.assert_allclose(rate_setpoint(q, q, rate, GAINS), expected, atol=1e-6)


@given(quaternions, quaternions, st.floats(-20.0, 20.0))
def test_rates_stay_inside_their_limits(q: Quat, q_sp: Quat, ff: float) -> None:
    rates = rate_setpoint(q, q_sp, ff, GAINS)
    assert all(math.isfinite(r) for r in rates)
    assert np.all(np.abs(rates) <= np.array([220.0, 220.0, 200.0]) * DEG + 1e-12)


def test_upside_down_turns_over() -> None:
    rates = rate_setpoint((0.0, 1.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), 0.0, GAINS)
    assert np.linalg.norm(rates[:2]) > 1.0


# --- velocity setpoint


@given(triples, triples, triples)
def test_velocity_limits(position: Vec, position_sp: Vec, velocity: Vec) -> None:
    vx, vy, vz = velocity_setpoint(position, position_sp, velocity, GAINS)
    assert math.hypot(vx, vy) <= 12.0 + 1e-9
    assert -3.0 <= vz <= 1.5


@given(triples, triples)
def test_inside_the_limits_it_is_p_plus_feed_forward(position: Vec, error: Vec) -> None:
    away = np.array(error) * 0.02
    velocity = np.array([1.0, -2.0, 0.3])
    sp = velocity_setpoint(position, tuple(np.array(position) + away), tuple(velocity), GAINS)
    np.testing.assert_allclose(sp, velocity + away * [0.95, 0.95, 1.0], atol=1e-9)


@given(triples, triples)
def test_position_comes_before_feed_forward(position: Vec, feed: Vec) -> None:
    goal = (position[0] + 8.0, position[1] - 4.0, NAN)
    assume(math.hypot(feed[0], feed[1]) > 0.1)
    v = np.array(velocity_setpoint(position, goal, feed, GAINS))[:2]
    correction = 0.95 * np.array([8.0, -4.0])
    share = (v - correction) @ np.array(feed[:2]) / np.dot(feed[:2], feed[:2])
    assert 0.0 <= share <= 1.0 + 1e-9
    np.testing.assert_allclose(v, correction + share * np.array(feed[:2]), atol=1e-6)
    if share < 1.0 - 1e-9:
        assert np.linalg.norm(v) == pytest.approx(12.0, abs=1e-6)


def test_nan_axes_take_no_part() -> None:
    sp = velocity_setpoint((1.0, 2.0, 3.0), (NAN, 4.0, NAN), (1.5, NAN, NAN), GAINS)
    np.testing.assert_allclose(sp, [1.5, 0.95 * 2.0, 0.0])
    # Without a horizontal setpoint the horizontal axes are not controlled.
    open_sp = velocity_setpoint((1.0, 2.0, 3.0), NAN3, (NAN, NAN, 0.5), GAINS)
    np.testing.assert_array_equal(open_sp, [NAN, NAN, 0.5])


def test_what_is_not_controlled_stays_level() -> None:
    """PX4's FlightTaskDescend: no horizontal acceleration at any velocity or integral."""
    sp, slope = (NAN, NAN, 0.75), (0.3, -0.2, 0.0)
    thrust, integral = velocity_control((3.0, -2.0, 0.75), slope, sp, (0.4, 0.1, 0.2), GAINS, 0.008)
    assert thrust[:2] == (0.0, 0.0)
    assert integral[:2] == (0.0, 0.0)
    assert integral[2] == pytest.approx(0.2)


# --- velocity control


@given(triples)
def test_tilt_limit(acceleration: Vec) -> None:
    x, y, z = thrust_from_acceleration(acceleration, GAINS)
    tilt = math.atan2(math.hypot(x, y), -z)
    wanted = math.atan2(math.hypot(*acceleration[:2]), GRAVITY_M_S2)
    assert tilt == pytest.approx(min(wanted, 45 * DEG), abs=1e-6)
    if math.hypot(*acceleration[:2]) > 0.1:
        direction = math.atan2(y, x)
        assert abs(wrap_pi(direction - math.atan2(acceleration[1], acceleration[0]))) < 1e-6


@given(st.tuples(st.floats(-5, 5), st.floats(-5, 5), st.floats(-5, 5)))
def test_acceleration_becomes_the_thrust_that_makes_it(acceleration: Vec) -> None:
    thrust = np.array(thrust_from_acceleration(acceleration, GAINS))
    # A body with a hover thrust of 0.52 accelerates by g at 0.52.
    produced = thrust / 0.52 * GRAVITY_M_S2 + [0, 0, GRAVITY_M_S2]
    assert produced[2] == pytest.approx(acceleration[2], abs=1e-9)
    # The tilt assumes flight at constant height. The vertical part scales the horizontal part.
    scale = 1.0 - acceleration[2] / GRAVITY_M_S2
    np.testing.assert_allclose(produced[:2], np.array(acceleration[:2]) * scale, atol=1e-9)


@given(triples, triples, triples)
def test_thrust_stays_inside_its_limits(velocity: Vec, dot: Vec, sp: Vec) -> None:
    thrust, integral = velocity_control(velocity, dot, sp, ZERO, GAINS, TICK_S)
    norm = np.linalg.norm(thrust)
    # `thrust_min` is the minimum collective thrust. The tilt reduces its vertical part.
    assert 0.12 - 1e-9 <= norm <= 1.0 + 1e-9
    assert thrust[2] <= -0.12 * math.cos(45 * DEG) + 1e-9
    assert all(math.isfinite(i) for i in integral)


def test_full_climb_leaves_a_horizontal_margin() -> None:
    thrust, _ = velocity_control(ZERO, ZERO, (12.0, 0.0, -3.0), (0, 0, -9.0), GAINS, TICK_S)
    assert thrust[0] == pytest.approx(0.3, abs=1e-9)  # MPC_THR_XY_MARG.
    assert thrust[2] == pytest.approx(-math.sqrt(1 - 0.09), abs=1e-9)


def test_p_i_and_d_have_their_signs_and_gains() -> None:
    integral = (0.3, -0.2, -0.1)
    thrust, new = velocity_control(ZERO, (0.5, 0.0, 0.0), (1.0, 0, 0), integral, GAINS, TICK_S)
    ax = 1.8 * 1.0 + 0.3 - 0.2 * 0.5
    expected = thrust_from_acceleration((ax, -0.2, -0.1), GAINS)
    np.testing.assert_allclose(thrust, expected, atol=1e-12)
    assert new == (0.3 + 0.4 * 1.0 * TICK_S, -0.2, -0.1)


@pytest.mark.parametrize(("sign", "bound"), [(1.0, GRAVITY_M_S2), (-1.0, GRAVITY_M_S2)])
def test_vertical_integral_stops_at_the_thrust_limits(sign: float, bound: float) -> None:
    """Held down (or up) for a minute: an unlimited integral would take as long to unwind."""
    integral = ZERO
    thrust = ZERO
    for _ in range(60 * 250):
        thrust, integral = velocity_control(
            ZERO, ZERO, (0.0, 0.0, 1.5 * sign), integral, GAINS, TICK_S
        )
    low, high = -GAINS.thrust_max, -GAINS.thrust_min
    assert thrust[2] == pytest.approx(high if sign > 0 else low, abs=0.02)
    assert abs(integral[2]) <= bound
    # Back to zero error: at most the P part of the saturated error is left over.
    thrust, _ = velocity_control(ZERO, ZERO, ZERO, integral, GAINS, TICK_S)
    assert -0.95 < thrust[2] < -0.15


def test_horizontal_integral_is_pulled_back_in_saturation() -> None:
    """Pinned against a wall at a setpoint of 12 m/s: the integral settles."""
    integral = ZERO
    for _ in range(60 * 250):
        _, integral = velocity_control(ZERO, ZERO, (12.0, 0.0, 0.0), integral, GAINS, TICK_S)
    # Equilibrium of e - 2/P (a - a_max) = 0 with a = P e + i and a_max = g tan 45 deg.
    a = GRAVITY_M_S2 + 12.0 * 1.8 / 2
    assert integral[0] == pytest.approx(a - 1.8 * 12.0, abs=1e-6)
    assert integral[1] == 0.0


# --- rate control


def test_rate_pid() -> None:
    torque, integral = rate_control(
        (0.1, 0.2, 0.3), (1.0, 2.0, 3.0), (0.2, 0.1, 0.8), (0.01, 0.02, 0.03), ZERO, GAINS, TICK_S
    )
    np.testing.assert_allclose(
        torque,
        [0.15 * 0.1 + 0.01 - 0.003, -0.15 * 0.1 + 0.02 - 0.006, 0.2 * 0.5 + 0.03],
        atol=1e-12,
    )
    fade = 1 - (0.1 / (400 * DEG)) ** 2
    assert integral[0] == pytest.approx(0.01 + fade * 0.2 * 0.1 * TICK_S, abs=1e-12)


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_rate_integral_stops_where_the_mixer_is_short(axis: int, sign: float) -> None:
    x, y, z = (sign if i == axis else 0.0 for i in range(3))
    want = (x, y, z)
    _, free = rate_control(ZERO, ZERO, want, ZERO, ZERO, GAINS, TICK_S)
    assert free[axis] * sign > 0
    _, short = rate_control(ZERO, ZERO, want, ZERO, want, GAINS, TICK_S)
    assert short[axis] == 0.0
    # Short the other way: this direction may be integrated.
    other = (-x, -y, -z)
    _, unwinding = rate_control(ZERO, ZERO, want, ZERO, other, GAINS, TICK_S)
    assert unwinding == free


@given(triples, triples)
def test_rate_integral_is_limited(rates: Vec, wanted: Vec) -> None:
    integral = ZERO
    for _ in range(200):
        _, integral = rate_control(rates, ZERO, wanted, integral, ZERO, GAINS, 0.5)
    assert np.all(np.abs(integral) <= 0.3)


def test_no_integration_in_fast_flips() -> None:
    fast = (401 * DEG, 0.0, 0.0)
    _, integral = rate_control(ZERO, ZERO, fast, ZERO, ZERO, GAINS, TICK_S)
    assert integral == ZERO


# --- the whole cascade


@cache
def hover() -> Demand:
    return Demand(NAN3, ZERO, 0.0, NAN)


LEVEL = (1.0, 0.0, 0.0, 0.0)


def test_at_rest_the_cascade_hovers() -> None:
    out = cascade_tick(ZERO, ZERO, LEVEL, ZERO, hover(), new_memory(), GAINS, FILTERS, TICK_S)
    np.testing.assert_allclose(out.motors, 0.52, atol=1e-12)
    assert (out.thrust, out.rates, out.velocity) == (0.52, ZERO, ZERO)


def test_what_was_before_does_not_kick_the_first_tick() -> None:
    """Filters start at the first sample: no derivative of a jump from zero."""
    v, w = (3.0, -1.0, 0.5), (0.3, 0.2, -0.4)
    demand = Demand(NAN3, v, 0.0, NAN)
    out = cascade_tick(ZERO, v, LEVEL, w, demand, new_memory(), GAINS, FILTERS, TICK_S)
    np.testing.assert_allclose(out.rates, 0.0, atol=1e-9)
    expected = [-0.15 * 0.3, -0.15 * 0.2]
    delivered = EFFECT @ out.motors
    np.testing.assert_allclose(delivered[:2], expected, atol=1e-9)


@given(triples, triples, quaternions, triples, triples, triples, angles)
def test_any_state_gives_commands(
    position: Vec, velocity: Vec, q: Quat, omega: Vec, p_sp: Vec, v_sp: Vec, yaw: float
) -> None:
    memory = new_memory()
    for demand in (Demand(p_sp, NAN3, yaw, NAN), Demand(NAN3, v_sp, NAN, 1.0)):
        out = cascade_tick(position, velocity, q, omega, demand, memory, GAINS, FILTERS, TICK_S)
        assert all(0.0 <= m <= 1.0 for m in out.motors)
        assert np.all(np.isfinite(memory))


def test_loops_hand_over_as_px4s_do() -> None:
    """The position loop runs at every second tick; each loop flies what was published before."""
    memory, climb = new_memory(), Demand(NAN3, (0.0, 0.0, -1.0), 0.0, NAN)

    def fly(demand: Demand) -> Output:
        return cascade_tick(ZERO, ZERO, LEVEL, ZERO, demand, memory, GAINS, FILTERS, TICK_S)

    fly(hover())
    steps = [fly(hover()), *(fly(climb) for _ in range(8))]
    # The position loop ran at the very first tick, so it does at the second climbing one, too.
    assert [out.velocity[2] for out in steps[:3]] == [0.0, -1.0, -1.0]
    thrusts = [out.thrust for out in steps]
    assert thrusts[:3] == [0.52, 0.52, 0.52]
    expected = 0.52 * (1.0 + 4.0 / GRAVITY_M_S2)
    assert thrusts[3] == thrusts[4] == pytest.approx(expected)
    assert thrusts[5] == thrusts[6] > thrusts[4]
    np.testing.assert_allclose(steps[3].motors, thrusts[3], atol=1e-12)


def test_a_turn_reaches_the_motors_after_three_loops() -> None:
    memory, turn = new_memory(), Demand(NAN3, ZERO, 1.0, NAN)
    wanted, yaw_torques = [], []
    for demand in (hover(), hover(), turn, turn, turn, turn):
        out = cascade_tick(ZERO, ZERO, LEVEL, ZERO, demand, memory, GAINS, FILTERS, TICK_S)
        wanted.append(out.rates[2])
        yaw_torques.append((EFFECT @ out.motors)[2])
    assert wanted[:3] == [0.0, 0.0, 0.0]
    assert wanted[3] > 1.0
    np.testing.assert_allclose(yaw_torques[:4], 0.0, atol=1e-12)
    assert yaw_torques[4] > 0.01


def test_the_integral_grows_with_time() -> None:
    memory, error = new_memory(), Demand(NAN3, (0.01, 0.0, 0.0), 0.0, NAN)
    seconds = 2.0
    for _ in range(round(seconds / TICK_S)):
        out = cascade_tick(ZERO, ZERO, LEVEL, ZERO, error, memory, GAINS, FILTERS, TICK_S)
    lean = math.atan((GAINS.vel_p_xy + GAINS.vel_i_xy * seconds) * 0.01 / GRAVITY_M_S2)
    assert -scipy_of(out.attitude).as_euler("ZYX")[1] == pytest.approx(lean, rel=0.01)


# --- filters


def run(f: Biquad, samples: np.ndarray, first: float) -> list[float]:
    newer = older = settled(f, first)
    outputs = []
    for sample in samples.tolist():
        output, held = filtered(f, sample, newer, older)
        newer, older = held, newer
        outputs.append(output)
    return outputs


@pytest.mark.parametrize("cutoff_hz", [20.0, 40.0, 100.0])
def test_the_gyro_filter_is_a_butterworth(cutoff_hz: float) -> None:
    samples = np.random.default_rng(0).standard_normal(100) + 0.3
    b, a = signal.butter(2, cutoff_hz, fs=1.0 / TICK_S)
    expected, _ = signal.lfilter(b, a, samples, zi=0.3 * signal.lfilter_zi(b, a))
    found = run(butterworth(cutoff_hz, TICK_S), samples, 0.3)
    np.testing.assert_allclose(found, expected, atol=1e-12)


@pytest.mark.parametrize("cutoff_hz", [0.0, 125.0, 1000.0])
def test_a_cutoff_that_cannot_be_filters_nothing(cutoff_hz: float) -> None:
    samples = np.random.default_rng(0).standard_normal(10)
    assert run(butterworth(cutoff_hz, TICK_S), samples, 0.0) == samples.tolist()


def test_a_weight_is_an_alpha_filters() -> None:
    assert weight(0.0, TICK_S) == 1.0
    # One time constant of 8 ms, sampled once in it: half of the way.
    assert weight(1.0 / (2.0 * math.pi * 0.008), 0.008) == pytest.approx(0.5)


def test_heading_is_kept_without_a_heading() -> None:
    """Without a yaw or yaw rate setpoint, heading error and rates are zero."""
    yaw = 1.1
    q = (math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2))
    demand = Demand(NAN3, ZERO, NAN, NAN)
    out = cascade_tick(ZERO, ZERO, q, ZERO, demand, new_memory(), GAINS, FILTERS, TICK_S)
    np.testing.assert_allclose(out.rates, 0.0, atol=1e-9)


def test_a_row_of_a_batch_is_one_vehicle() -> None:
    one, many = new_memory(), new_memory(3)
    demand = Demand(NAN3, (1.0, 2.0, -0.5), 0.4, NAN)
    for _ in range(5):
        a = cascade_tick(ZERO, ZERO, LEVEL, (0.1, 0.0, 0.0), demand, one, GAINS, FILTERS, TICK_S)
        b = cascade_tick(
            ZERO, ZERO, LEVEL, (0.1, 0.0, 0.0), demand, many[1], GAINS, FILTERS, TICK_S
        )
    assert a == b
    np.testing.assert_array_equal(many[1], one)
    assert not many[[0, 2]].any()
    reset_integrals(many[1])
    assert np.count_nonzero(many[1]) < np.count_nonzero(one)


@given(triples, triples, quaternions, triples, triples, triples, angles)
def test_the_controller_is_the_cascade_tick(
    position: Vec, velocity: Vec, q: Quat, omega: Vec, p_sp: Vec, v_sp: Vec, yaw: float
) -> None:
    controller, memory = Controller(GAINS), new_memory()
    state = np.array([*position, *velocity, *q, *omega, 7.0, 8.0])
    for demand in (Demand(p_sp, NAN3, yaw, NAN), Demand(NAN3, v_sp, NAN, 1.0)):
        out = cascade_tick(position, velocity, q, omega, demand, memory, GAINS, FILTERS, TICK_S)
        assert controller.fly(state, demand) == out.motors
        told = controller.setpoints()
        assert tuple(told.attitude) == out.attitude
        assert tuple(told.rates) == out.rates
        assert tuple(told.velocity) == out.velocity
        assert told.thrust == controller.thrust == out.thrust


def test_a_controller_at_rest_winds_nothing_up() -> None:
    controller, memory = Controller(GAINS), new_memory()
    state = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    demand = Demand(NAN3, (1.0, 2.0, 0.5), 0.4, NAN)
    for _ in range(50):
        wound = controller.fly(state, demand)
        cascade_tick(ZERO, ZERO, LEVEL, ZERO, demand, memory, GAINS, FILTERS, TICK_S)
    controller.rest()
    reset_integrals(memory)
    assert controller.thrust == 0.0
    told = controller.setpoints()
    assert (told.attitude.tolist(), told.rates.tolist()) == ([1.0, 0.0, 0.0, 0.0], [0.0] * 3)
    after = controller.fly(state, demand)
    assert (
        after
        == cascade_tick(ZERO, ZERO, LEVEL, ZERO, demand, memory, GAINS, FILTERS, TICK_S).motors
    )
    assert after != wound


def test_a_controller_takes_other_gains() -> None:
    one, two = Controller(GAINS), Controller(GAINS)
    state = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    two.set_gains(GAINS._replace(hover_thrust=0.4))
    assert one.fly(state, hover()) == pytest.approx((0.52,) * 4)
    assert two.fly(state, hover()) == pytest.approx((0.4,) * 4)


def test_gains_follow_the_parameters() -> None:
    parameters = Parameters()
    parameters.set("MC_ROLLRATE_K", 2.0)
    parameters.set("MPC_TILTMAX_AIR", 30.0)
    gains = Gains.from_parameters(parameters.__getitem__)
    assert gains.rate_p_roll == 2 * Parameters()["MC_ROLLRATE_P"]
    assert gains.tilt_max == pytest.approx(math.pi / 6)
