"""The attitude reference model of PX4 1.18 against closed forms and scipy's rotations."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from airl_mav.control.cascade import attitude_tick, filters
from airl_mav.control.demand import AttitudeDemand, Gains
from airl_mav.control.loops import reference_model
from airl_mav.control.memory import ATTITUDE_SP, new_memory
from firmware_sim.autopilot.parameter_store import Parameters

LEVEL = (1.0, 0.0, 0.0, 0.0)
ZERO = (0.0, 0.0, 0.0)
W_N, DT = 50.0, 0.008


def quaternion(*rotation_vector: float) -> tuple[float, float, float, float]:
    x, y, z, w = Rotation.from_rotvec(rotation_vector).as_quat()
    return w, x, y, z


def turned(q: tuple[float, ...]) -> np.ndarray:
    w, x, y, z = q
    return Rotation.from_quat([x, y, z, w]).as_rotvec()


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("dt", [0.004, 0.008, 0.05])
def test_a_step_is_followed_critically_damped(axis: int, dt: float) -> None:
    size = 0.02
    sp = quaternion(*(size * (k == axis) for k in range(3)))
    ref, rate = LEVEL, ZERO
    for tick in range(1, 30):
        ref, rate = reference_model(ref, rate, sp, 0.0, W_N, dt)
        t = W_N * tick * dt
        assert turned(ref)[axis] == pytest.approx(size * (1.0 - (1.0 + t) * math.exp(-t)), rel=1e-4)
        assert rate[axis] == pytest.approx(size * W_N * t * math.exp(-t), rel=1e-3, abs=1e-6)


def test_a_ramp_is_followed_with_two_periods_of_lag() -> None:
    speed, ref, rate = 0.5, LEVEL, ZERO
    for tick in range(1, 200):
        ref, rate = reference_model(ref, rate, quaternion(speed * tick * DT, 0, 0), 0.0, W_N, DT)
    # 2 / w_n, less half a period: a setpoint counts for the period before it.
    lag_s = 199 * DT - turned(ref)[0] / speed
    assert lag_s == pytest.approx(2.0 / W_N - DT / 2.0, abs=1e-4)
    assert rate[0] == pytest.approx(speed, rel=0.02)


def test_a_large_turn_agrees_with_an_integration_by_scipy() -> None:
    """One axis: the error of the law is 2 sin(half the angle)."""
    goal, dt, w = 2.0, 0.001, 20.0
    ref, rate = LEVEL, ZERO
    for _ in range(150):
        ref, rate = reference_model(ref, rate, quaternion(0, goal, 0), 0.0, w, dt)

    def law(_: float, y: np.ndarray) -> list[float]:
        error = 2.0 * math.sin((goal - y[0]) / 2.0)
        return [y[1], w * w * error - 2.0 * w * y[1]]

    expected = solve_ivp(law, (0.0, 0.15), [0.0, 0.0], rtol=1e-9).y[:, -1]
    assert turned(ref)[1] == pytest.approx(expected[0], rel=2e-3)
    assert rate[1] == pytest.approx(expected[1], rel=2e-3)


def test_a_yaw_rate_turns_the_tilted_reference_about_the_vertical() -> None:
    """The correction has no vertical part, and the reference keeps its tilt."""
    tilt, yaw_rate = Rotation.from_rotvec([0.0, 0.3, 0.0]), 0.5

    def setpoint(tick: int) -> tuple[float, float, float, float]:
        x, y, z, w = (Rotation.from_rotvec([0, 0, yaw_rate * tick * DT]) * tilt).as_quat()
        return w, x, y, z

    ref, rate = setpoint(0), ZERO
    for tick in range(1, 101):
        ref, rate = reference_model(ref, rate, setpoint(tick), yaw_rate, W_N, DT)
    # The model adds the turn of the next period.
    assert np.abs(np.dot(ref, setpoint(101))) == pytest.approx(1.0, abs=1e-9)
    assert np.linalg.norm(rate) < 1e-6


@pytest.mark.parametrize(("w_n", "after_one"), [(0.0, 1.0), (50.0, 1.0 - 1.2 * math.exp(-0.2))])
def test_the_cascade_uses_it_only_with_a_frequency(w_n: float, after_one: float) -> None:
    values = Parameters({}).__getitem__
    gains = Gains.from_parameters(values)._replace(ref_w_n=w_n)
    memory, weights = new_memory(), filters(gains, 0.004)
    for angle in (0.0, 0.02):
        demand = AttitudeDemand(quaternion(angle, 0, 0), 0.0, 0.5)
        attitude_tick(ZERO, LEVEL, ZERO, demand, memory, gains, weights, 0.004)
    reached = turned(tuple(memory[ATTITUDE_SP : ATTITUDE_SP + 4]))[0]
    assert reached == pytest.approx(0.02 * after_one, rel=1e-3)
