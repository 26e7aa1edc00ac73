"""The ticks of the cascade against a second implementation of their schedule and filters.

airl_mav/control/loops.py has the control laws, which other tests check; here they are given.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest

from airl_mav.control import loops
from airl_mav.control.cascade import (
    Output,
    attitude_tick,
    cascade_tick,
    filters,
    rate_tick,
    trajectory_tick,
)
from airl_mav.control.demand import (
    AttitudeDemand,
    Demand,
    Gains,
    RateDemand,
    TrajectoryDemand,
)
from airl_mav.control.memory import butterworth, new_memory, weight
from firmware_sim.autopilot.parameter_store import Parameters

GAINS = Gains.from_parameters(Parameters({"MPC_THR_HOVER": 0.52}).__getitem__)
DT = 0.004
FILTERS = filters(GAINS, DT)
NAN = math.nan
NAN3 = (NAN, NAN, NAN)
ZERO = (0.0, 0.0, 0.0)
LEVEL = np.array([1.0, 0.0, 0.0, 0.0])


def triple(values: Any) -> tuple[float, float, float]:
    a, b, c = (float(value) for value in values)
    return a, b, c


@dataclass
class Reference:
    """Cascade as in PX4: the position loop at every second tick, one tick of delay per loop."""

    ticks_left: int = 0
    started: bool = False
    slow: np.ndarray = field(default_factory=lambda: np.zeros(3))
    """Velocity after its low-pass."""
    slope: np.ndarray = field(default_factory=lambda: np.zeros(3))
    velocity_integral: Any = ZERO
    velocity_sp: Any = ZERO
    attitude: Any = ((0.0, 0.0, 0.0, 0.0), 0.0, 0.0)
    """Published by the position loop: attitude, yaw rate, collective."""
    rates: Any = (ZERO, 0.0)
    """Published by the attitude loop: rates, collective."""
    gyro: list[list[float]] = field(default_factory=list)
    """Input and output of each axis's low-pass at the last two ticks."""
    rate: np.ndarray = field(default_factory=lambda: np.zeros(3))
    rate_slope: np.ndarray = field(default_factory=lambda: np.zeros(3))
    rate_integral: Any = ZERO
    missing: Any = ZERO
    yaw_torque: float = 0.0

    def begin(self, velocity: Any, omega: Any) -> bool:
        first = not self.started
        if first:
            self.started, self.ticks_left = True, 0
            self.slow, self.rate = np.array(velocity), np.array(omega)
            self.gyro = [[w, w, w, w] for w in omega]
        return first

    def differentiate(self, velocity: Any) -> None:
        step = weight(GAINS.vel_d_cutoff_hz, 2 * DT) * (np.array(velocity) - self.slow)
        self.slow, self.slope = self.slow + step, step / (2 * DT)

    def position(self, position: Any, velocity: Any, q: Any, demand: Any) -> None:
        self.differentiate(velocity)
        sp = loops.velocity_setpoint(position, demand.position, demand.velocity, GAINS)
        slope, period = triple(self.slope), 2 * DT
        if isinstance(demand, TrajectoryDemand):
            if math.isnan(demand.position[2]) and math.isnan(demand.velocity[2]):
                sp = (sp[0], sp[1], NAN)
            thrust, integral = loops.acceleration_control(
                velocity, slope, sp, demand.acceleration, self.velocity_integral, GAINS, period
            )
        else:
            thrust, integral = loops.velocity_control(
                velocity, slope, sp, self.velocity_integral, GAINS, period
            )
        self.velocity_sp, self.velocity_integral = sp, integral
        yaw = (math.cos(demand.yaw), math.sin(demand.yaw))
        if math.isnan(demand.yaw):
            yaw = loops.heading_of(q)
        yaw_rate = 0.0 if math.isnan(demand.yaw_rate) else demand.yaw_rate
        collective = float(np.linalg.norm(thrust))
        self.attitude = loops.attitude_setpoint(thrust, *yaw), yaw_rate, collective

    def fly_rates(self, omega: Any, rates: Any, collective: float) -> Any:
        b = butterworth(GAINS.gyro_cutoff_hz, DT)
        for i, (x1, x2, y1, y2) in enumerate(self.gyro):
            # Direct form I: the same filter by its difference equation.
            y = b.b0 * omega[i] + b.b1 * x1 + b.b2 * x2 - b.a1 * y1 - b.a2 * y2
            share = weight(GAINS.dgyro_cutoff_hz, DT)
            self.rate_slope[i] += share * ((y - y1) / DT - self.rate_slope[i])
            self.gyro[i], self.rate[i] = [omega[i], x1, y, y1], y
        now, slope = triple(self.rate), triple(self.rate_slope)
        torque, self.rate_integral = loops.rate_control(
            now, slope, rates, self.rate_integral, self.missing, GAINS, DT
        )
        share = weight(GAINS.yaw_torque_cutoff_hz, DT)
        self.yaw_torque += share * (torque[2] - self.yaw_torque)
        motors, self.missing = loops.mix(collective, (torque[0], torque[1], self.yaw_torque), GAINS)
        return motors

    def fly_attitude(self, q: Any, omega: Any, published: Any, first: bool) -> Output:
        wanted = loops.rate_setpoint(q, published[0], published[1], GAINS)
        flown = (wanted, published[2]) if first else self.rates
        self.rates = wanted, published[2]
        motors = self.fly_rates(omega, *flown)
        return Output(motors, flown[1], self.attitude[0], wanted, self.velocity_sp)

    def tick(self, position: Any, velocity: Any, q: Any, omega: Any, demand: Any) -> Output:
        first, published = self.begin(velocity, omega), self.attitude
        due = self.ticks_left == 0
        self.ticks_left = 1 if due else self.ticks_left - 1
        if isinstance(demand, Demand | TrajectoryDemand):
            if due:
                self.position(position, velocity, q, demand)
            return self.fly_attitude(q, omega, self.attitude if first else published, first)
        if due:
            self.differentiate(velocity)
        self.velocity_sp = NAN3
        if isinstance(demand, AttitudeDemand):
            self.attitude = demand.attitude, demand.yaw_rate, demand.thrust
            return self.fly_attitude(q, omega, self.attitude, first)
        self.attitude = q, 0.0, demand.thrust
        self.rates = demand.rates, demand.thrust
        motors = self.fly_rates(omega, demand.rates, demand.thrust)
        return Output(motors, demand.thrust, q, demand.rates, NAN3)


def compiled(memory: Any, position: Any, velocity: Any, q: Any, omega: Any, demand: Any) -> Output:
    rest = (memory, GAINS, FILTERS, DT)
    if isinstance(demand, Demand):
        return cascade_tick(position, velocity, q, omega, demand, *rest)
    if isinstance(demand, TrajectoryDemand):
        return trajectory_tick(position, velocity, q, omega, demand, *rest)
    if isinstance(demand, AttitudeDemand):
        return attitude_tick(velocity, q, omega, demand, *rest)
    return rate_tick(velocity, q, omega, demand, *rest)


def some_demand(kind: int, rng: np.random.Generator) -> Any:
    def some(scale: float) -> Any:
        values = rng.normal(0.0, scale, 3)
        return triple(np.where(rng.random(3) < 0.25, NAN, values))

    whole, yaw = triple(rng.normal(0.0, 1.0, 3)), float(rng.uniform(-3.0, 3.0))
    yaw_rate, thrust = float(rng.normal()), float(rng.uniform(0.3, 0.7))
    if rng.random() < 0.3:
        yaw = NAN
    if rng.random() < 0.3:
        yaw_rate = NAN
    if kind == 0:
        return Demand(some(2.0), some(2.0), yaw, yaw_rate)
    if kind == 1:
        return TrajectoryDemand(some(2.0), some(2.0), some(2.0), yaw, yaw_rate)
    if kind == 2:
        q = LEVEL + rng.normal(0.0, 0.2, 4)
        a, b, c, d = (q / np.linalg.norm(q)).tolist()
        return AttitudeDemand((a, b, c, d), float(rng.normal()), thrust)
    return RateDemand(whole, thrust)


@pytest.mark.parametrize("first", range(4))
@pytest.mark.parametrize("seed", range(4))
def test_every_kind_of_tick_follows_the_reference(first: int, seed: int) -> None:
    """Kinds of demand change in flight, after an odd or an even number of ticks."""
    rng = np.random.default_rng((seed, first))
    memory, reference = new_memory(), Reference()
    kind = first
    for _ in range(16):
        demand = some_demand(kind, rng)
        for _ in range(int(rng.integers(1, 6))):
            q = LEVEL + rng.normal(0.0, 0.1, 4)
            a, b, c, d = (q / np.linalg.norm(q)).tolist()
            state = (
                triple(rng.normal(0.0, 1.0, 3)),
                triple(rng.normal(0.0, 1.0, 3)),
                (a, b, c, d),
                triple(rng.normal(0.0, 0.3, 3)),
            )
            ours, theirs = compiled(memory, *state, demand), reference.tick(*state, demand)
            for name in Output._fields:
                expected = getattr(theirs, name)
                np.testing.assert_allclose(
                    getattr(ours, name), expected, rtol=1e-9, atol=1e-9, err_msg=name
                )
        kind = int(rng.integers(4))
