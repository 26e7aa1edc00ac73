"""A goal with a height, flown in lockstep through the real MAVSDK."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w

from airl_mav.arena.walls import openings_of
from airl_mav.envs.evaluation import LearnedPilots, SinglePilots, fly_seeds
from airl_mav.envs.fleet import FlightStatus
from airl_mav.envs.navigation import Navigation
from airl_mav.envs.spec import spec_of
from airl_mav.flight.judge import Outcome
from airl_mav.lockstep.lockstep_flight import fly
from airl_mav.policy.actions import Action
from airl_mav.policy.observation import Observation
from airl_mav.policy.registry import LearnedPolicy
from tests.support.lockstep_kit import demo_scenario

SEED, ALTITUDE_M, HEIGHT_M, RADIUS_M, NORTH_M = 4, 2.0, 4.2, 1.0, 12.0
SPEED_M_S = 2.0


class Climbing:
    """Pilot that flies in a straight line to the goal, including the climb."""

    def __init__(self) -> None:
        self.below: list[float] = []

    def act(self, observation: Observation) -> Action:
        assert observation.goal_down is not None
        forward, right = observation.goal
        below = float(observation.goal_down)
        self.below.append(below)
        share = SPEED_M_S / max(float(np.hypot(forward, right)), 1.0)
        return Action(float(forward) * share, float(right) * share, 0.0, below * share)


class Level(Climbing):
    """The same, and says nothing of the vertical."""

    def act(self, observation: Observation) -> Action:
        climbing = super().act(observation)
        return Action(climbing.forward_m_s, climbing.right_m_s, 0.0)


@pytest.fixture(scope="module")
def arena(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return an empty arena whose goal is above the altitude of take-off."""
    path = tmp_path_factory.mktemp("arena") / "above.toml"
    goal = {"north_m": NORTH_M, "east_m": 0.0, "height_m": HEIGHT_M}
    profile = {"base": "no-obstacles", "description": "a goal above", "goal": goal}
    path.write_bytes(tomli_w.dumps(profile).encode())
    return path


def asked(arena: Path) -> dict[str, Any]:
    return {
        "policy": "greedy",
        "arena": str(arena),
        "seed": SEED,
        "altitude_m": ALTITUDE_M,
        "goal_radius_m": RADIUS_M,
        "time_limit_s": 20.0,
        "hold_s": 0.2,
    }


def test_it_climbs_to_the_goal_at_both_levels(arena: Path) -> None:
    """The closed form of the way: from (0, 0, 2) m straight to (12, 0, 4.2) m, less the radius."""
    pilot = Climbing()
    flown = fly(demo_scenario(**asked(arena)), pilot, 0, SEED)
    record = flown.record
    assert record.outcome is Outcome.SUCCESS, record.reason
    assert record.goal == (NORTH_M, 0.0, -HEIGHT_M)
    end = flown.trajectory.between(record.navigation_us or 0, record.ended_us).position[-1]
    away = float(np.linalg.norm(end - np.array(record.goal)))
    assert away == pytest.approx(RADIUS_M, abs=0.05)
    assert -end[2] > HEIGHT_M - RADIUS_M > ALTITUDE_M + RADIUS_M
    assert pilot.below[0] == pytest.approx(ALTITUDE_M - HEIGHT_M, abs=0.3)
    # MAVSDK's setpoints agree: down is negative during the climb.
    setpoints = flown.latency["setpoint"]
    assert setpoints[1:-1, 2].max() < -0.1
    environment = spec_of(
        None,
        {
            "arena": str(arena),
            "image_width_px": 16,
            "image_height_px": 12,
            "episode": {
                "altitude_m": ALTITUDE_M,
                "goal_radius_m": RADIUS_M,
                "time_limit_s": 20.0,
                "hold_s": 0.2,
            },
        },
    )
    navigation = Navigation(environment, 1)
    pilots = SinglePilots(Climbing, 5.0)
    ((_, twin),) = fly_seeds(navigation, pilots, [SEED])
    assert twin.verdict == FlightStatus.SUCCESS
    navigated_s = (record.ended_us - (record.navigation_us or 0)) / 1e6
    assert twin.flight_time_s == pytest.approx(navigated_s, rel=0.1)


def test_passing_below_the_goal_is_not_reaching_it(arena: Path) -> None:
    flown = fly(demo_scenario(**(asked(arena) | {"time_limit_s": 12.0})), Level(), 0, SEED)
    assert flown.record.outcome is Outcome.TIMEOUT
    path = flown.trajectory.between(flown.record.navigation_us or 0, flown.record.ended_us)
    away = np.hypot(path.position[:, 0] - NORTH_M, path.position[:, 1])
    assert away.min() < 0.5 * RADIUS_M


@pytest.mark.nightly
def test_the_shipped_policy_flies_through_the_gates_at_both_levels() -> None:
    """Seed 1 has three gates. Where it crosses their planes, it is within their openings."""
    seed = 1
    scenario = demo_scenario(policy="gates", arena="gates", seed=seed, time_limit_s=60.0)
    policy = scenario.fresh_policy(seed)
    flown = fly(scenario, policy, 0, seed)
    assert flown.record.outcome is Outcome.SUCCESS, flown.record.reason
    openings = openings_of(scenario.arena_of(seed))
    path = flown.trajectory.between(flown.record.navigation_us or 0, flown.record.ended_us).position
    assert len(openings) == 3
    for center, half in zip(openings.center, openings.half_size, strict=True):
        (crossed,) = np.flatnonzero((path[:-1, 0] < center[0]) & (path[1:, 0] >= center[0]))
        # A sample is a few centimetres away from the plane.
        assert (np.abs(path[crossed, 1:] - center[1:]) < half[1:]).all()
    rules = {"hold_s": 0.2, "goal_radius_m": 1.0, "time_limit_s": 60.0}
    knobs = {"actions": "velocity3d-fixed-yaw", "max_speed_m_s": 4.0, "goal_height": True}
    size = {"image_width_px": 32, "image_height_px": 24, "frames": 4}
    environment = spec_of(None, {"arena": "gates", "episode": rules} | knobs | size)
    assert isinstance(policy, LearnedPolicy)
    pilots = LearnedPilots(policy, np.random.default_rng)
    ((_, twin),) = fly_seeds(Navigation(environment, 1), pilots, [seed])
    assert twin.verdict == FlightStatus.SUCCESS
    navigated_s = (flown.record.ended_us - (flown.record.navigation_us or 0)) / 1e6
    assert twin.flight_time_s == pytest.approx(navigated_s, rel=0.1)
