"""Vehicles side by side fly as each of them alone, tick by tick, to the last bit."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from airl_mav.arena.generate import generate
from airl_mav.control.cascade import Filters, cascade_tick, filters, rate_tick
from airl_mav.control.demand import Demand, Gains, RateDemand
from airl_mav.control.loops import heading_of
from airl_mav.core.constants import TICK_S, TICK_US
from airl_mav.core.kernels import kernel
from airl_mav.envs.arena_batch import ArenaBatch, batch_of
from airl_mav.envs.fleet import LANES, Fleet, FlightStatus, Rules, hover, new_fleet, vehicle_of
from airl_mav.envs.fleet_step import NAN3, REPEAT_US, advance
from airl_mav.profiles.arena import ArenaSpec
from airl_mav.profiles.loading import load_profile
from airl_mav.profiles.vehicle import Spread, VehicleProfile
from airl_mav.vehicle.airframe import (
    airframe_of,
    drag_force,
    draw_airframe,
    lag,
    settle,
    step,
    wrench,
)
from airl_mav.vehicle.power import PowerModel, flight_power_w
from airl_mav.vehicle.rotation import Vec, rotate
from firmware_sim.autopilot.parameter_store import Parameters

QUAD = load_profile("vehicles", "quad", VehicleProfile)
VEHICLE = vehicle_of(QUAD, Parameters(QUAD.parameters).__getitem__)
RULES = Rules(goal_radius=3.0, time_limit_us=2_000_000)
STATE = ("position", "velocity", "quaternion", "omega", "rotor", "memory", "energy", "velocity_ned")
CALM = (0.0, 0.0, 0.0)


@kernel
def fly_alone(
    fleet: Fleet,
    i: int,
    ticks: int,
    air: NDArray[np.float64],
    gains: Gains,
    weights: Filters,
    power: PowerModel,
) -> None:
    """One vehicle, written down in the order of events: setpoint, cascade, rotors, body."""
    airframe = airframe_of(fleet.airframe[i])
    for _ in range(ticks):
        p = (fleet.position[i, 0], fleet.position[i, 1], fleet.position[i, 2])
        v = (fleet.velocity[i, 0], fleet.velocity[i, 1], fleet.velocity[i, 2])
        q = (
            fleet.quaternion[i, 0],
            fleet.quaternion[i, 1],
            fleet.quaternion[i, 2],
            fleet.quaternion[i, 3],
        )
        w = (fleet.omega[i, 0], fleet.omega[i, 1], fleet.omega[i, 2])
        if fleet.time_us[i] >= fleet.repeat_us[i] and fleet.by_rates[i]:
            fleet.repeat_us[i] += REPEAT_US
        elif fleet.time_us[i] >= fleet.repeat_us[i]:
            c, s = heading_of(q)
            forward, right = fleet.setpoint[i, 0], fleet.setpoint[i, 1]
            fleet.velocity_ned[i, 0] = c * forward - s * right
            fleet.velocity_ned[i, 1] = s * forward + c * right
            fleet.velocity_ned[i, 2] = fleet.setpoint[i, 2]
            fleet.repeat_us[i] += REPEAT_US
        memory = fleet.memory[i]
        if fleet.by_rates[i]:
            s = fleet.setpoint[i]
            rates = RateDemand((s[0], s[1], s[2]), s[3])
            motors = rate_tick(v, q, w, rates, memory, gains, weights, TICK_S).motors
        else:
            n = fleet.velocity_ned[i]
            demand = Demand(NAN3, (n[0], n[1], n[2]), math.nan, fleet.setpoint[i, 3])
            motors = cascade_tick(p, v, q, w, demand, memory, gains, weights, TICK_S).motors
        for k in range(4):
            fleet.rotor[i, k] = settle(
                fleet.rotor[i, k], motors[k], airframe, lag(airframe, TICK_S)
            )
        r = fleet.rotor[i]
        thrust, torque = wrench(r[0], r[1], r[2], r[3], airframe)
        lift = rotate(q, (0.0, 0.0, -thrust))
        row = air[fleet.time_us[i] // TICK_US % len(air)]
        wind = (row[0], row[1], row[2])
        drag = drag_force(v, wind, airframe)
        force = (lift[0] + drag[0], lift[1] + drag[1], lift[2] + drag[2])
        slowed = airframe.drag_angular
        damped = (
            torque[0] - slowed * w[0],
            torque[1] - slowed * w[1],
            torque[2] - slowed * w[2],
        )
        felt = (fleet.felt[i, 0], fleet.felt[i, 1], fleet.felt[i, 2])
        fleet.energy[i] += TICK_S * flight_power_w(thrust, v, q, wind, felt, airframe, power)
        p, v, q, w = step(p, v, q, w, force, damped, airframe, TICK_S)
        for axis in range(3):
            fleet.position[i, axis] = p[axis]
            fleet.velocity[i, axis] = v[axis]
            fleet.omega[i, axis] = w[axis]
        for axis in range(4):
            fleet.quaternion[i, axis] = q[axis]
        fleet.time_us[i] += TICK_US


def fleet_of(n: int, rng: np.random.Generator, wind: Vec = CALM) -> Fleet:
    fleet = new_fleet(n)
    shares = Spread(mass=0.3, thrust=0.1, drag=0.5, rotor_lag=0.5)
    for i in range(n):
        hover(fleet, i, 2.5, VEHICLE, draw_airframe(VEHICLE.airframe, shares, rng), wind=wind)
    return fleet


def arenas_of(n: int, name: str) -> ArenaBatch:
    spec = load_profile("arenas", name, ArenaSpec)
    width_m = QUAD.body.width_m
    return batch_of([generate(spec, s, name=name, vehicle_width_m=width_m) for s in range(n)])


def commanded(fleet: Fleet, rng: np.random.Generator, by_rates: float = 0.0) -> None:
    """Setpoints that saturate motors now and then: full speed to and fro, fast turns.

    A share of them, on average, is of body rates and thrust.
    """
    n = len(fleet.time_us)
    fleet.setpoint[:] = rng.uniform([-12, -12, -3, -3], [12, 12, 1, 3], (n, 4))
    fleet.repeat_us[:] = fleet.time_us
    if by_rates > 0.0:
        fleet.by_rates[:] = rng.random(n) < by_rates
        rates = rng.uniform([-4, -4, -2, 0.2], [4, 4, 2, 0.9], (n, 4))
        fleet.setpoint[fleet.by_rates] = rates[fleet.by_rates]


@pytest.mark.parametrize("n", [1, LANES, 3 * LANES + 1])
@pytest.mark.parametrize("windy", [False, True])
@pytest.mark.parametrize("by_rates", [0.0, 0.5, 1.0])
def test_together_as_alone(n: int, windy: bool, by_rates: float) -> None:
    """Advance different vehicles for different numbers of ticks from different times.

    Commands are velocities, body rates, or one after the other.
    """
    rng = np.random.default_rng(n)
    air = rng.normal(0.0, 4.0, (n, 7, 3)) if windy else np.zeros((n, 1, 3))
    fleet, alone = fleet_of(n, rng), fleet_of(n, np.random.default_rng(n + 1))
    alone.airframe[:] = fleet.airframe
    for name in STATE:
        getattr(alone, name)[:] = getattr(fleet, name)
    far_off = arenas_of(n, "no-obstacles")
    far_off.bounds[:] = [-1e6, 1e6, -1e6, 1e6, 1e6, 0.0]
    fleet.position[:, 2] = alone.position[:, 2] = -1e5
    weights = filters(VEHICLE.gains, TICK_S)
    never = Rules(goal_radius=0.0, time_limit_us=10**12)
    for _ in range(40):
        commanded(fleet, rng, by_rates)
        alone.setpoint[:], alone.repeat_us[:] = fleet.setpoint, fleet.repeat_us
        alone.by_rates[:] = fleet.by_rates
        ticks = rng.integers(0, 12, n)
        advance(fleet, far_off, ticks, VEHICLE, never, air if windy else None)
        for i in range(n):
            fly_alone(alone, i, int(ticks[i]), air[i], VEHICLE.gains, weights, VEHICLE.power)
        for name in (*STATE, "time_us", "repeat_us"):
            np.testing.assert_array_equal(getattr(fleet, name), getattr(alone, name), name)
    assert (np.ptp(fleet.rotor, axis=1) > 0.1).any()


def test_the_motors_of_these_flights_saturate() -> None:
    """Or the flights above would not show that those are mixed alike."""
    n = 4 * LANES
    rng = np.random.default_rng(5)
    fleet, arenas = fleet_of(n, rng), arenas_of(n, "no-obstacles")
    saturated = 0
    for _ in range(20):
        commanded(fleet, rng)
        for _ in range(5):
            advance(fleet, arenas, np.ones(n, np.int64), VEHICLE, RULES, None)
            saturated += int((fleet.memory[:, 12:15] != 0.0).any(axis=1).sum())
    assert saturated > 50


@pytest.mark.parametrize("arena", ["static-obstacles", "dynamic-obstacles"])
def test_neither_order_nor_company_matters(arena: str) -> None:
    """Flights to their ends, some early: in another order, and one vehicle at a time."""
    n = 5 * LANES + 2
    order = np.random.default_rng(1).permutation(n)
    flown = []
    for rows in (np.arange(n), order):
        rng = np.random.default_rng(2)
        fleet, arenas = fleet_of(n, rng), arenas_of(n, arena)
        fleet = Fleet._make(array[rows] for array in fleet)
        arenas = ArenaBatch._make(array[rows] for array in arenas)
        for _ in range(60):
            setpoints = rng.uniform([0, -4, -0.3, -2], [8, 4, 0.3, 2], (n, 4))[rows]
            fleet.setpoint[:], fleet.repeat_us[:] = setpoints, fleet.time_us
            advance(fleet, arenas, rng.integers(1, 15, n)[rows], VEHICLE, RULES, None)
        flown.append(fleet)
    assert len(set(flown[0].verdict)) >= 3
    for together, shuffled in zip(*flown, strict=True):
        np.testing.assert_array_equal(together[order], shuffled)
    one_by_one = fleet_of(n, np.random.default_rng(2))
    arenas = arenas_of(n, arena)
    rng = np.random.default_rng(2)
    fleet_of(n, rng)
    for _ in range(60):
        one_by_one.setpoint[:] = rng.uniform([0, -4, -0.3, -2], [8, 4, 0.3, 2], (n, 4))
        one_by_one.repeat_us[:] = one_by_one.time_us
        ticks = rng.integers(1, 15, n)
        for i in range(n):
            advance(one_by_one, arenas, np.where(np.arange(n) == i, ticks, 0), VEHICLE, RULES, None)
    for together, single in zip(flown[0], one_by_one, strict=True):
        np.testing.assert_array_equal(together, single)


def test_who_has_landed_is_left_alone() -> None:
    n = LANES + 1
    fleet, arenas = fleet_of(n, np.random.default_rng(3)), arenas_of(n, "no-obstacles")
    fleet.verdict[2] = FlightStatus.COLLISION
    before = [array[2].copy() for array in fleet]
    advance(fleet, arenas, np.full(n, 30), VEHICLE, RULES, None)
    assert (np.delete(fleet.time_us, 2) == 30 * TICK_US).all()
    for was, array in zip(before, fleet, strict=True):
        np.testing.assert_array_equal(array[2], was)
