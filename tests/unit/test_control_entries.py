"""Entry points of the control cascade: acceleration, attitude, body rates."""

from __future__ import annotations

import math

import numpy as np
import pytest

from airl_mav.control.demand import AttitudeDemand, Demand, Gains, RateDemand, TrajectoryDemand
from airl_mav.core.constants import GRAVITY_M_S2
from airl_mav.profiles.px4_release import px4_release
from firmware_sim.engine.controller import Controller

GAINS = Gains.from_parameters(px4_release().flown_values({}).__getitem__)
NAN3 = (math.nan, math.nan, math.nan)
ZERO = (0.0, 0.0, 0.0)
LEVEL = (1.0, 0.0, 0.0, 0.0)


def at_rest() -> np.ndarray:
    state = np.zeros(13)
    state[6] = 1.0
    return state


def controller() -> Controller:
    return Controller(GAINS)


def test_without_an_acceleration_a_trajectory_is_flown_as_position_and_velocity() -> None:
    one, other, state = controller(), controller(), at_rest()
    state[3:6] = 0.3, -0.2, 0.1
    for _ in range(9):
        plain = one.fly(state, Demand((1.0, 2.0, -3.0), (0.5, 0.0, 0.0), 0.4, math.nan))
        full = other.fly(
            state, TrajectoryDemand((1.0, 2.0, -3.0), (0.5, 0.0, 0.0), NAN3, 0.4, math.nan)
        )
        assert full == plain


def test_an_acceleration_alone_leans_and_pushes_by_itself() -> None:
    """tan(tilt) = a / g, and the thrust that carries the weight; no velocity is held."""
    fly, state = controller(), at_rest()
    state[3] = 7.0
    for _ in range(3):
        fly.fly(state, TrajectoryDemand(NAN3, NAN3, (1.0, 0.0, 0.0), 0.0, math.nan))
    wanted = fly.setpoints()
    tilt = 2.0 * math.asin(abs(float(wanted.attitude[2])))
    assert math.tan(tilt) == pytest.approx(1.0 / GRAVITY_M_S2)
    assert wanted.attitude[2] < 0.0, "nose down to the north"
    assert wanted.thrust * math.cos(tilt) == pytest.approx(GAINS.hover_thrust)
    assert np.isnan(wanted.velocity).all()


def test_an_acceleration_is_fed_forward_on_its_axis_only() -> None:
    """North by acceleration and velocity, east by velocity, the height by position."""
    leans = []
    for acceleration in (0.0, 1.0):
        fly = controller()
        demand = TrajectoryDemand(
            (math.nan, math.nan, 0.0), (0.0, 0.0, math.nan), (acceleration, 0.0, 0.0), 0.0, 0.0
        )
        for _ in range(3):
            fly.fly(at_rest(), demand)
        leans.append(fly.setpoints().attitude)
    assert leans[0] == pytest.approx(LEVEL)
    assert leans[1][2] < -0.04
    assert leans[1][1] == pytest.approx(0.0)


def test_an_attitude_and_a_thrust_are_passed_on() -> None:
    fly = controller()
    roll = (math.cos(0.1), math.sin(0.1), 0.0, 0.0)
    for _ in range(3):
        motors = fly.fly(at_rest(), AttitudeDemand(roll, 0.0, 0.6))
    wanted = fly.setpoints()
    assert tuple(wanted.attitude) == pytest.approx(roll)
    assert wanted.rates[0] == pytest.approx(GAINS.att_p_roll * 2.0 * math.sin(0.1), rel=0.01)
    assert wanted.thrust == 0.6
    assert sum(motors) / 4.0 == pytest.approx(0.6)
    assert motors[1] > motors[0]
    assert motors[2] > motors[3]


def test_rates_and_a_thrust_reach_the_motors_in_the_same_tick() -> None:
    fly = controller()
    motors = fly.fly(at_rest(), RateDemand((0.0, 0.5, 0.0), 0.4))
    assert sum(motors) / 4.0 == pytest.approx(0.4)
    assert motors[0] == motors[2] > motors[1] == motors[3], "the nose goes up"


def test_the_position_loop_takes_over_again() -> None:
    fly = controller()
    for _ in range(5):
        fly.fly(at_rest(), RateDemand(ZERO, 0.5))
    for _ in range(4):
        motors = fly.fly(at_rest(), Demand(NAN3, ZERO, 0.0, math.nan))
    assert motors == pytest.approx((GAINS.hover_thrust,) * 4, abs=1e-3)
