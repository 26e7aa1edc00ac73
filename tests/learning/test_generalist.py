"""The policy `generalist`: a network with the planner's candidates and map."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from airl_mav.core.errors import FieldError
from airl_mav.envs.evaluation import EpisodeResult, LearnedPilots, fly_seeds
from airl_mav.envs.fleet import FlightStatus
from airl_mav.envs.navigation import Navigation
from airl_mav.envs.spec import EnvironmentSpec
from airl_mav.policy.registry import LearnedPolicy, load_policy
from airl_mav.profiles.loading import profiles_dir

SEEDS = range(700_301, 700_307)
TOLD = ("command", "latency")


def spec(arena: str, **more: object) -> EnvironmentSpec:
    return EnvironmentSpec.model_validate(
        {"arena": arena, "in_flight": TOLD, "episode": {"hold_s": 0.1}} | more
    )


def flown(
    environment: EnvironmentSpec, slots: int, seeds: range = SEEDS
) -> dict[int, EpisodeResult]:
    policy = load_policy("generalist", 0.1)
    assert isinstance(policy, LearnedPolicy)
    pilots = LearnedPilots(policy, np.random.default_rng)
    navigation = Navigation(environment, slots)
    return {each.seed: each for _, each in fly_seeds(navigation, pilots, seeds)}


def test_a_flight_depends_on_its_seed_alone() -> None:
    environment = spec("crowded")
    together, alone = (flown(environment, slots, SEEDS[:3]) for slots in (3, 1))
    assert together == alone


def test_it_reaches_goals_in_a_corridor() -> None:
    corridor = str(profiles_dir() / "arenas" / "test" / "corridor.toml")
    verdicts = [each.verdict for each in flown(spec(corridor), 6).values()]
    assert verdicts == [FlightStatus.SUCCESS] * 6


def test_it_flies_through_gates_of_different_heights() -> None:
    verdicts = [each.verdict for each in flown(spec("gates"), 6).values()]
    assert verdicts == [FlightStatus.SUCCESS] * 6


@pytest.mark.parametrize("compensate", [False, True])
def test_it_flies_late(compensate: bool) -> None:
    late = spec("static-obstacles", compensate=compensate, delay={"latency": ("396ms",)})
    found = flown(late, 6)
    assert sum(each.verdict == FlightStatus.SUCCESS for each in found.values()) >= 5
    # Three decisions in two seconds, and slowly.
    assert all(each.decisions < 2.2 * each.flight_time_s for each in found.values())


@pytest.mark.parametrize("compensate", [False, True])
def test_a_compensated_observation_says_so(compensate: bool) -> None:
    navigation = Navigation(spec("no-obstacles", compensate=compensate), 1)
    navigation.begin([0], [1], None)
    told = navigation.see().in_flight
    assert told is not None
    assert told.foreseen == compensate


def test_a_training_has_no_memory_of_a_flight() -> None:
    navigation = Navigation(spec("no-obstacles", layout="candidates"), 1)
    navigation.begin([0], [1], None)
    with pytest.raises(FieldError, match=r"layout.*candidates.*without a memory"):
        navigation.observe()


def test_its_card_names_its_training() -> None:
    policy = load_policy("generalist", 0.1)
    assert isinstance(policy, LearnedPolicy)
    script = (policy.card.training.command or "").split()[1]
    assert (Path(__file__).resolve().parents[2] / script).is_file()
