"""Hover start: the state after a take-off, without its duration."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import pytest

from airl_mav.arena.generate import generate
from airl_mav.core.clock import SimClock
from airl_mav.core.constants import TAKEOFF_REACHED_M, US_PER_S
from airl_mav.faults import Fault
from airl_mav.profiles.arena import ArenaSpec
from airl_mav.profiles.loading import load_profile
from airl_mav.profiles.vehicle import WindSettings, load_vehicle
from airl_mav.scenario.aircraft import Aircraft
from firmware_sim.autopilot.commander import FlightPhase
from firmware_sim.autopilot.flight_modes import Mode
from firmware_sim.simulation import EpisodeSetup, HoverStart, Simulation

ALTITUDE_M = 2.5

Make = Callable[..., Simulation]


@pytest.fixture
def make() -> Iterator[Make]:
    made: list[Simulation] = []

    def simulation(vehicle: str = "quad", *, arena: str = "", **aircraft: object) -> Simulation:
        profile = load_vehicle(vehicle)
        place = None
        if arena:
            spec = load_profile("arenas", arena, ArenaSpec)
            place = generate(spec, 3, name=arena, vehicle_width_m=profile.body.width_m)
        setup = EpisodeSetup(profile, place, 3, Aircraft(**aircraft))
        made.append(Simulation(setup, start_us=0, clock=SimClock()))
        return made[-1]

    yield simulation
    for each in made:
        each.close()


def begun(simulation: Simulation) -> Simulation:
    origin = load_vehicle("quad-vio").told_origin
    gps = simulation.plant.sense().gps is not None
    assert HoverStart(ALTITUDE_M, None if gps else origin).fly(simulation)
    simulation.begin()
    return simulation


@pytest.mark.parametrize("vehicle", ["quad", "quad-vio"])
def test_the_vehicle_hovers_at_the_altitude_as_after_a_take_off(make: Make, vehicle: str) -> None:
    simulation = begun(make(vehicle))
    internals = simulation.autopilot.internals
    assert internals is not None
    assert (internals.flight.phase, internals.flight.mode) == (FlightPhase.AIR, Mode.HOLD)
    assert not internals.flight.failsafe
    state, truth = internals.state(), simulation.truth
    assert -truth.position[2] == pytest.approx(ALTITUDE_M, abs=2 * TAKEOFF_REACHED_M)
    assert np.hypot(*truth.position[:2]) < 1.0
    error = np.abs(state.estimate.position - truth.position)
    drift_m = 0.0 if vehicle == "quad" else 0.3  # Visual odometry drifts, unknown to the filter.
    assert np.all(error < 4.0 * state.estimate.sigma[:3] + drift_m)
    assert state.estimate.healthy
    assert state.home is not None
    assert state.takeoff_us > state.armed_us > 0
    assert 0.98 < truth.battery_remaining < 1.0
    assert truth.power_w > 100.0, "the rotors turn"


def test_the_episode_begins_in_the_hover(make: Make) -> None:
    simulation = begun(make())
    assert simulation.start_us == simulation.time_us > 5 * US_PER_S
    assert len(simulation.arrays()["trajectory/time_us"]) == 0
    internals = simulation.autopilot.internals
    assert internals is not None
    assert internals.take_messages() == []
    assert internals.take_events() == []
    for _ in range(1000):
        simulation.tick()
    times_us = simulation.arrays()["trajectory/time_us"]
    assert times_us[0] >= simulation.start_us
    assert internals.flight.mode is Mode.HOLD
    assert -simulation.truth.position[2] == pytest.approx(ALTITUDE_M, abs=TAKEOFF_REACHED_M)


def test_it_comes_through_wind(make: Make) -> None:
    simulation = begun(make(wind=WindSettings(north_m_s=6.0, gust_m_s=2.0)))
    assert np.hypot(*simulation.truth.position[:2]) < 2.0


def test_moving_obstacles_and_faults_begin_with_the_episode(make: Make) -> None:
    off = Fault.model_validate("gps off at 1s")
    simulation = begun(make(arena="dynamic-obstacles", faults=(off,)))
    assert simulation.faults is not None
    assert simulation.faults.acted(simulation.time_us) == []
    for _ in range(500):
        simulation.tick()
    (acted,) = simulation.faults.acted(simulation.time_us)
    assert acted.from_us - simulation.start_us == US_PER_S
    assert simulation.plant.record["moves_us"][0] == simulation.start_us


def test_a_vehicle_that_refuses_to_arm_stays_on_the_ground_and_says_why(make: Make) -> None:
    simulation = make(battery_charge=0.03)
    assert not HoverStart(ALTITUDE_M).fly(simulation)
    internals = simulation.autopilot.internals
    assert internals is not None
    assert internals.flight.phase is FlightPhase.STANDBY
    assert any("battery" in message.text.lower() for message in internals.take_messages())
