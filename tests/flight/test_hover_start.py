"""Flights from a hover start and from take-off, with the same seeds, in lockstep."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.stats import binomtest

from airl_mav.addons.rehearsal_env.gym_env import RehearsalEnv
from airl_mav.core.constants import US_PER_S
from airl_mav.core.errors import FieldError
from airl_mav.flight.episode_record import EpisodeRecord
from airl_mav.flight.judge import Outcome
from airl_mav.lockstep.lockstep_flight import fly
from airl_mav.lockstep.stage import LockstepStage
from airl_mav.rehearsal.firmware_process import episode_setup
from airl_mav.rehearsal.run_folder import FlownEpisode
from airl_mav.scenario.model import Scenario
from airl_mav.scenario.resolve import ResolvedScenario, resolve
from companion.pilot import MissionResult
from tests.support.lockstep_kit import SEED, demo_scenario, fly_as_companion

AHEAD = 22
"""An action of arc-25 that flies straight on."""

PAIRED_SEED = 40_001
"""First seed of the paired flights."""


def flown(scenario: ResolvedScenario, seed: int = SEED) -> FlownEpisode:
    return fly(scenario, scenario.fresh_policy(seed), 0, seed)


def test_a_flight_begins_in_the_air_and_ends_at_the_verdict() -> None:
    scenario = demo_scenario(start="hover")
    flight = flown(scenario)
    record = flight.record
    assert record.outcome is Outcome.SUCCESS
    assert record.notes == ()
    assert flight.trajectory.position[0, 2] == pytest.approx(-2.5, abs=0.4)
    assert flight.trajectory.time_us[-1] - record.ended_us <= 500_000
    assert record.navigation_us is not None
    began_s = (record.navigation_us - record.started_us) / US_PER_S
    assert record.tours_s == pytest.approx(began_s, abs=0.05)
    assert flown(scenario).record == record, "the same flight every time"


def test_mavsdk_sees_a_vehicle_in_the_air() -> None:
    scenario = demo_scenario(start="hover")
    seen: dict[str, Any] = {}

    def look() -> None:
        stage.clock.sleep_until(stage.clock.time_us() + 2 * US_PER_S)
        telemetry = stage.link._telemetry
        seen["status"] = stage.link.status()
        seen["in air"] = bool(telemetry.in_air())
        seen["missing"] = stage.link.missing_health()
        seen["height"] = telemetry.position().relative_altitude_m
        seen["home"] = telemetry.home().latitude_deg

    with LockstepStage() as stage:
        stage.run(episode_setup(scenario, scenario.arena_of(SEED), SEED), look)
    assert seen["status"].armed
    assert seen["status"].mode == "hold"
    assert seen["in air"]
    assert seen["missing"] == []
    assert seen["height"] == pytest.approx(2.5, abs=0.4)
    assert np.isfinite(seen["home"])


def test_a_companion_does_not_fly_a_vehicle_on_the_ground() -> None:
    scenario = demo_scenario(start="ground")
    results: list[MissionResult] = []

    def program() -> None:
        policy, goal = scenario.fresh_policy(SEED), scenario.arena_of(SEED).goal_point
        results.append(fly_as_companion(stage, policy, goal, start="hover"))

    with LockstepStage() as stage:
        simulation = stage.run(episode_setup(scenario, scenario.arena_of(SEED), SEED), program)
        assert simulation.truth.position[2] > -0.1
    assert results[0].reason == "not in the air after 5 s"


def test_a_hover_start_needs_the_built_in_firmware_and_faults_of_the_air() -> None:
    with pytest.raises(FieldError, match="ground with real firmware"):
        demo_scenario(start="hover", firmware="px4", real={"px4_connect": True})
    with pytest.raises(FieldError, match="a hover start has no climb"):
        demo_scenario(start="hover", faults=("gps off at climb",))
    demo_scenario(start="hover", faults=("gps off at offboard",))


def test_level_gym_starts_in_a_hover_anyway() -> None:
    assert resolve(Scenario(level="gym", start="hover")).takeoff_s == 0.0


def test_an_environment_of_rehearsals_starts_in_a_hover() -> None:
    env = RehearsalEnv(start="hover", episode={"time_limit_s": 3.0})
    _, info = env.reset(seed=SEED)
    assert info["flight_time_s"] < 0.2
    ended = False
    while not ended:
        _, _, terminated, truncated, info = env.step(AHEAD)
        ended = terminated or truncated
    env.close()
    assert env.flown is not None
    record = env.flown.record
    assert record.outcome.value == info["outcome"]
    assert record.navigation_us is not None
    assert record.navigation_us - record.started_us < US_PER_S


@pytest.mark.nightly
@pytest.mark.parametrize(
    "flights",
    [pytest.param(10, marks=pytest.mark.slow), pytest.param(100, marks=pytest.mark.nightly)],
)
def test_hover_and_ground_starts_fly_alike(flights: int) -> None:
    """From the start of navigation on, over pairs of the same seed.

    Of 100 pairs, relative differences had a standard deviation of 1.3 % (time), 0.9 % (distance)
    and 1.9 % (energy): a median over 10 of them has a standard error of at most 0.8 %.
    """
    starts = {start: demo_scenario(start=start) for start in ("ground", "hover")}
    pairs = [
        [flown(scenario, PAIRED_SEED + i).record for scenario in starts.values()]
        for i in range(flights)
    ]
    reached = [[record.outcome is Outcome.SUCCESS for record in pair] for pair in pairs]
    lost, won = reached.count([True, False]), reached.count([False, True])
    if lost + won:
        assert binomtest(lost, lost + won).pvalue > 0.05  # exact McNemar
    both = [pair for pair, there in zip(pairs, reached, strict=True) if all(there)]
    assert len(both) >= 0.9 * flights
    for name in ("flight_time_s", "distance_m", "energy_j"):
        figures = np.array([[figure(record, name) for record in pair] for pair in both])
        assert np.median(figures[:, 1] / figures[:, 0]) == pytest.approx(1.0, abs=0.01), name


def figure(record: EpisodeRecord, name: str) -> float:
    assert record.quality is not None
    return float(getattr(record.quality, name))
