"""Wind, spread and sensor noise: the batch twin against closed forms, and against the plant."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

from airl_mav.camera.render import Motion
from airl_mav.core.clock import SimClock
from airl_mav.core.constants import GRAVITY_M_S2, TICK_US
from airl_mav.core.errors import UsageError
from airl_mav.core.streams import Stream, stream
from airl_mav.envs.arena_batch import batch_of
from airl_mav.envs.draws import Winds
from airl_mav.envs.evaluation import Trace
from airl_mav.envs.fleet import Fleet, hover, new_fleet
from airl_mav.envs.fleet_step import advance
from airl_mav.envs.navigation import Navigation
from airl_mav.envs.spec import EnvironmentSpec, spec_of
from airl_mav.experiments.gym_flier import environment_of
from airl_mav.profiles.vehicle import SensorNoise, Spread, WindSettings
from airl_mav.rehearsal.firmware_process import aircraft_of
from airl_mav.scenario.aircraft import Aircraft
from airl_mav.scenario.model import Scenario
from airl_mav.scenario.resolve import resolve
from airl_mav.scenario.stand_alone import StandAloneVehicle
from airl_mav.vehicle.airframe import draw_airframe
from airl_mav.vehicle.atmosphere import BLOCK, wind_of_episode
from airl_mav.vehicle.rotation import rotate
from firmware_sim.interfaces import BatterySample
from firmware_sim.plant.bullet_body import BulletBody, pybullet
from firmware_sim.plant.camera import SimulatedCamera
from firmware_sim.plant.sensors import SensorSuite
from firmware_sim.simulation import EpisodeSetup, Simulation
from tests.learning.test_fleet import ENDLESS, OPEN, QUAD, VEHICLE, PlantPilot, command
from tests.support.blown import fly_blown

GUSTY = WindSettings(north_m_s=-3.0, east_m_s=2.0, gust_m_s=1.5, gust_time_s=1.0)
SPREAD = Spread(mass=0.1, thrust=0.1, drag=0.5, rotor_lag=0.3)
K = QUAD.drag.linear_n_s_m
WEIGHT_N = QUAD.body.mass_kg * GRAVITY_M_S2
STILL_AIR = {"navigation_noise": 0.0}


def navigation(n: int = 1, trace: Trace | None = None, **knobs: object) -> Navigation:
    spec = spec_of(None, {"arena": "no-obstacles", "randomisation": STILL_AIR, **knobs})
    return Navigation(spec, n, trace=trace)


def blown(fleet: Fleet, ticks: int, air: np.ndarray | None) -> None:
    n = len(fleet.time_us)
    advance(fleet, batch_of([OPEN] * n), np.full(n, ticks), VEHICLE, ENDLESS, air)


@pytest.mark.parametrize("seed", [1, 2])
def test_twin_and_plant_fly_the_same_gusts_and_the_same_aircraft(seed: int) -> None:
    """Fly 20 s of manoeuvres; both sides draw gusts and airframe independently from the seed."""
    drawn = draw_airframe(VEHICLE.airframe, SPREAD, stream(seed, Stream.AIRFRAME))
    pilot = PlantPilot(60.0, seed=seed, aircraft=Aircraft(wind=GUSTY), airframe=drawn)
    fleet, arenas, winds = new_fleet(1), batch_of([OPEN]), Winds(1, GUSTY)
    winds.begin(0, seed)
    hover(fleet, 0, 60.0, VEHICLE, drawn)

    rng, off_m = np.random.default_rng(seed), []
    for _ in range(20):
        setpoint = rng.uniform([-2, -2, -0.5, -1.5], [4, 2, 0.5, 1.5])
        command(fleet, 0, setpoint)
        pilot.fly(setpoint, 250)
        fly_blown(
            winds, fleet, 250, lambda n: advance(fleet, arenas, n, VEHICLE, ENDLESS, winds.air)
        )
        off_m.append(np.abs(fleet.position[0] - pilot.plant.truth().position).max())
    assert max(off_m) < 1e-6
    assert fleet.energy[0] == pytest.approx(pilot.energy, rel=1e-6)


def test_a_simulation_draws_what_the_twin_draws() -> None:
    asked = Aircraft(wind=WindSettings(east_m_s=1.0, random_m_s=6.0), spread=SPREAD)
    twin = navigation(
        wind=asked.wind.model_dump(), randomisation={**asked.spread.model_dump(), **STILL_AIR}
    )
    for seed in (3, 4):
        twin.begin([0], [seed])
        plant = Simulation(
            EpisodeSetup(QUAD, None, seed, asked), start_us=0, clock=SimClock()
        ).plant
        assert isinstance(plant.body, BulletBody)
        body = pybullet.getDynamicsInfo(plant.body.number, -1, plant.body.world.number)
        row = twin.fleet.airframe[0]
        assert row.tolist() == list(plant.record["airframe"][0])
        assert body[0] == row[0] != QUAD.body.mass_kg
        np.testing.assert_allclose(body[2], row[1:4], rtol=1e-12)
        assert np.array_equal(twin._winds.air[0, 0], plant.wind.step())
        plant.close()


# --- wind, by closed forms


def test_a_falling_vehicle_drifts_with_the_wind() -> None:
    """Rotors without thrust, linear drag: v' = g - (k / m)(v - w)."""
    wind = np.array([6.0, -3.0, 0.0])
    fleet = new_fleet(1)
    hover(fleet, 0, 400.0, VEHICLE, VEHICLE.airframe._replace(thrust_max=1e-9))
    fleet.rotor[0] = 0.0
    for seconds in (1.0, 4.0):
        blown(fleet, round(seconds * 250) - int(fleet.time_us[0]) // TICK_US, wind[None, None])
        gain = 1.0 - math.exp(-K * seconds / QUAD.body.mass_kg)
        expected = wind * gain + [0.0, 0.0, WEIGHT_N / K * gain]
        np.testing.assert_allclose(fleet.velocity[0], expected, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("thrust_curve", [0.0, 0.5])
def test_an_episode_begins_in_balance_with_the_steady_wind(thrust_curve: float) -> None:
    """It leans by atan(k w / m g) against the wind, heading north, and stays where it is."""
    airframe = VEHICLE.airframe._replace(thrust_curve=thrust_curve, mass=1.6)
    wind, weight_n = (-5.0, 4.0, 0.0), 1.6 * GRAVITY_M_S2
    fleet = new_fleet(1)
    hover(fleet, 0, 20.0, VEHICLE, airframe, wind=wind)
    down = np.array(rotate(tuple(fleet.quaternion[0]), (0.0, 0.0, 1.0)))
    np.testing.assert_allclose(down / down[2] * weight_n, [-5 * K, 4 * K, weight_n], rtol=1e-9)
    nose = rotate(tuple(fleet.quaternion[0]), (1.0, 0.0, 0.0))
    assert math.atan2(nose[1], nose[0]) == pytest.approx(0.0, abs=1e-12)
    lift_n = airframe.thrust_max * np.sum(fleet.rotor[0] ** 2)
    assert lift_n == pytest.approx(math.hypot(weight_n, K * math.hypot(*wind)), rel=1e-9)
    for _ in range(20):
        blown(fleet, 50, np.array(wind)[None, None])
        assert np.abs(fleet.position[0] - [0.0, 0.0, -20.0]).max() < 1e-3


def test_the_drawn_wind_is_uniform_in_speed_and_direction() -> None:
    asked = WindSettings(north_m_s=2.0, random_m_s=8.0, gust_m_s=1.0)
    winds = [wind_of_episode(asked, seed) for seed in range(500)]
    north = np.array([wind.north_m_s for wind in winds]) - 2.0
    east = np.array([wind.east_m_s for wind in winds])
    assert stats.kstest(np.hypot(north, east), stats.uniform(0.0, 8.0).cdf).pvalue > 1e-3
    towards = stats.uniform(-math.pi, 2.0 * math.pi)
    assert stats.kstest(np.arctan2(east, north), towards.cdf).pvalue > 1e-3
    assert {wind.gust_m_s for wind in winds} == {1.0}
    assert wind_of_episode(asked, 7) == winds[7]
    assert wind_of_episode(GUSTY, 7) is GUSTY


def test_the_twin_s_gusts_have_the_spread_and_correlation_time_stated() -> None:
    """Read gusts at each vehicle's tick over many blocks, as `advance` does."""
    winds, sigma, tau = Winds(400, GUSTY), GUSTY.gust_m_s, GUSTY.gust_time_s
    fleet = new_fleet(400)
    for i in range(400):
        winds.begin(i, i)
    rows: list[np.ndarray] = []

    def pass_time(ticks: np.ndarray) -> None:
        air = winds.air
        assert air is not None
        tick = fleet.time_us[0] // TICK_US
        rows.extend(air[:, k % BLOCK].copy() for k in range(tick, tick + ticks[0]))
        fleet.time_us[:] += ticks * TICK_US

    fly_blown(winds, fleet, 1100, pass_time)
    blowing = np.array(rows)
    assert blowing.shape == (1100, 400, 3)
    np.testing.assert_allclose(blowing.mean(axis=(0, 1)), [-3.0, 2.0, 0.0], atol=0.15)
    gusts = blowing - [-3.0, 2.0, 0.0]
    np.testing.assert_allclose(gusts.std(axis=(0, 1)), sigma * np.array([1, 1, 0.5]), rtol=0.05)
    for lag in (1, BLOCK - 1, BLOCK, 500):
        correlation = np.mean(gusts[:-lag] * gusts[lag:], axis=(0, 1)) / gusts.var(axis=(0, 1))
        np.testing.assert_allclose(correlation, math.exp(-0.004 * lag / tau), atol=0.06)


def test_calm_is_bit_by_bit_wind_of_nought() -> None:
    fleets = new_fleet(1), new_fleet(1)
    for fleet, air in zip(fleets, (None, np.zeros((1, 1, 3))), strict=True):
        hover(fleet, 0, 30.0, VEHICLE)
        for forward in (3.0, -1.0, 4.0):
            command(fleet, 0, np.array([forward, 1.0, 0.2, 0.7]))
            blown(fleet, 125, air)
    for name in Fleet._fields:
        assert np.array_equal(getattr(fleets[0], name), getattr(fleets[1], name)), name
    # So that checkpoints of training runs without wind can be gone on with.
    assert not any(key.startswith("winds") for key in navigation().get_state())


def test_a_windy_flight_is_its_seed_s_whatever_flies_beside_and_goes_on_from_a_checkpoint() -> None:
    # With an estimate, as it is by default: nothing else has to be compiled.
    wind, by_default = {**GUSTY.model_dump(), "random_m_s": 2.0}, dict[str, object]()
    many, traced, alone = (
        navigation(3, wind=wind, randomisation=by_default),
        navigation(1, Trace(1), wind=wind, randomisation=by_default),
        navigation(1, wind=wind, randomisation=by_default),
    )
    many.begin([0, 1, 2], [4, 9, 5])
    for each in (traced, alone):
        each.begin([0], [9])
    going = np.array([[2.0, 0.5, 0.3]])
    for k in range(12):
        many.fly(np.repeat(going, 3, axis=0))
        traced.fly(going)
        if k == 6:
            fresh = navigation(1, wind=wind, randomisation=by_default)
            fresh.set_state(alone.get_state())
            alone = fresh
        alone.fly(going)
    where = many.truth().position
    assert np.array_equal(where[1], alone.truth().position[0])
    assert np.array_equal(where[1], traced.truth().position[0])
    assert np.abs(where[1] - where[0]).max() > 0.01


# --- sensors


def test_the_plant_s_camera_has_the_twin_s_pixels() -> None:
    """Compare consecutive frames of a vehicle at rest."""
    noise, seed = SensorNoise(depth_noise=0.05, depth_dropout=0.1), 11
    trace = Trace(1)
    twin = navigation(
        1, trace, arena="static-obstacles", randomisation={**noise.model_dump(), **STILL_AIR}
    )
    twin.begin([0], [seed])
    pose = twin.truth()
    arena = twin.arenas[0]
    assert arena is not None
    camera = SimulatedCamera(twin.camera, arena, 0, noise, seed)
    frames: list[np.ndarray] = []
    while len(frames) < 80:
        at_us = math.ceil(camera.next_us / TICK_US) * TICK_US
        frames.append(
            camera.take(at_us, Motion.at_rest(pose.position[0], pose.quaternion[0])).depth_mm
        )
    camera.restart(0)
    again = camera.take(0, Motion.at_rest(pose.position[0], pose.quaternion[0])).depth_mm
    assert np.array_equal(again, frames[0])
    assert not np.array_equal(frames[0], frames[1])
    seen = []
    for _ in range(4):
        image = twin.see().depth_mm[0]
        seen.append([k for k, frame in enumerate(frames) if np.array_equal(frame, image)])
        twin.fly(np.zeros((1, 3)))
    assert seen[0] == [0]
    # The twin's camera began up to one frame before the episode did.
    taken_us = trace.latency(0)["capture_us"]
    for (k,), at_us in zip(seen, taken_us, strict=True):
        assert 0 <= k - at_us / 33_333 <= 1.1


@pytest.mark.parametrize("times", [0.0, 3.0])
def test_noise_of_navigation_is_times_what_it_was(times: float) -> None:
    row = np.zeros(16)
    row[6], row[15] = 1.0, -GRAVITY_M_S2
    battery = BatterySample(15.0, 10.0, 0.0, 1.0)

    def measured(k: float) -> np.ndarray:
        suite = SensorSuite(QUAD.sensors, np.random.default_rng(3), times=k)
        found = [suite.sample(i * TICK_US, row, battery) for i in range(0, 500, 25)]
        fixes = [s.gps for s in found if s.gps]
        return np.concatenate(
            [s.accel for s in found]
            + [s.gyro for s in found]
            + [s.mag for s in found if s.mag is not None]
            + [fix.velocity_ned for fix in fixes]
            + [[1e7 * f.position.latitude_deg, f.position.altitude_m] for f in fixes]
            + [[s.pressure_hpa for s in found if s.pressure_hpa]]
        )

    exact, usual = measured(0.0), measured(1.0)
    assert np.all(exact != usual)
    np.testing.assert_allclose(measured(times) - exact, times * (usual - exact), atol=1e-6)
    errors = []
    for k in (1.0, times):
        twin = navigation(randomisation={"navigation_noise": k})
        twin.begin([0], [3])
        for _ in range(3):
            twin.fly(np.array([[2.0, 0.0, 0.0]]))
        errors.append(twin.kinematics().position - twin.truth().position)
    np.testing.assert_allclose(errors[1], times * errors[0], atol=1e-12)
    assert np.all(errors[0] != 0.0)


# --- one set of fields


def test_level_gym_flies_what_a_scenario_asks_for() -> None:
    asked = Scenario(
        level="gym",
        arena="no-obstacles",
        wind=GUSTY,
        spread=Spread(mass=0.1),
        sensors=SensorNoise(depth_noise=0.02, navigation_noise=2.0),
    )
    environment = environment_of(resolve(asked))
    assert environment.wind == GUSTY
    drawn = environment.randomisation
    assert (drawn.mass, drawn.thrust, drawn.depth_noise, drawn.navigation_noise) == (
        0.1,
        0,
        0.02,
        2,
    )
    assert drawn.estimation


def test_a_spread_that_cannot_hover_is_refused_in_training() -> None:
    with pytest.raises(UsageError, match=r"randomisation.mass 0.4: .* cannot hover: needs 26.77"):
        navigation(randomisation={"mass": 0.4, "thrust": 0.3})


def test_environments_and_the_vehicle_alone_carry_their_computer() -> None:
    pi = EnvironmentSpec.model_validate({"delay": {"computer": "ras-pi-4"}})
    vehicle, computer_w = aircraft_of(StandAloneVehicle(computer="ras-pi-4"))
    flown = Navigation(pi, 1)
    assert flown.vehicle.body == vehicle.body
    assert flown.vehicle.body.mass_kg == pytest.approx(1.546)
    assert flown._vehicle.computer_w == computer_w == 1.7
    plain, none_w = aircraft_of(StandAloneVehicle())
    assert plain.body == QUAD.body == Navigation(EnvironmentSpec(), 1).vehicle.body
    assert none_w == 0.0
