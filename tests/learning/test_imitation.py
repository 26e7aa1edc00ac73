"""Experts and imitation learning: the planner flies well, and policies keep its behaviour."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from stable_baselines3.common.callbacks import BaseCallback

from airl_mav.addons.imitation.imitation import StatefulExpert, choices
from airl_mav.addons.imitation.planner import PlannerBody, beside, map_of
from airl_mav.envs.evaluation import (
    EpisodeResult,
    fly_episodes,
    fly_seeds,
    mean_of_successes,
    success_rate,
)
from airl_mav.envs.navigation import Navigation
from airl_mav.envs.sb3 import NavigationVecEnv
from airl_mav.envs.spec import spec_of
from airl_mav.envs.vector import NavigationVectorEnv
from airl_mav.policy.actions import ActionSpec, commands
from airl_mav.policy.observation import Observation
from airl_mav.policy.registry import load_learned
from airl_mav.training.algorithms import make_model
from airl_mav.training.checkpoint import load_latest, save_checkpoint
from airl_mav.training.config import ExpertName, TrainingConfig
from airl_mav.training.training_run import nominal, train

SMALL = {"image_width_px": 16, "image_height_px": 12}


class Taught:
    """An expert as a pilot."""

    def __init__(self, navigation: Navigation, name: ExpertName) -> None:
        self.expert, self.actions = StatefulExpert(name, navigation), navigation.spec.action_spec
        self.failed: dict[int, str] = {}

    def begin(self, slot: int, seed: int) -> None:
        self.expert.begin([slot])

    def decide(self, seen: Observation, flying: NDArray[np.bool_]) -> NDArray[np.float64]:
        return commands(self.actions, self.expert.decide())


def flown_by(name: ExpertName, seeds: Sequence[int], **knobs: Any) -> list[EpisodeResult]:
    navigation = Navigation(spec_of(None, SMALL | knobs), min(len(seeds), 20))
    pilots = Taught(navigation, name)
    return [flown for _, flown in fly_seeds(navigation, pilots, seeds)]


@pytest.mark.parametrize(
    ("arena", "actions", "least"),
    [
        ("static-obstacles", "arc-25", 0.97),
        ("dynamic-obstacles", "velocity", 0.97),
        # Both at once.
        pytest.param("crowded", "velocity", 0.95, marks=pytest.mark.nightly),
    ],
)
def test_the_planner_is_safer_and_faster_than_what_it_teaches(
    arena: str, actions: str, least: float
) -> None:
    flown = flown_by("planner", range(1, 41), arena=arena, actions=actions)
    assert success_rate(flown) >= least
    # The policy `static-obstacles` takes 7.8 s in static-obstacles.
    assert (mean_of_successes(flown, "flight_time_s") or np.inf) < 6.5


@pytest.mark.parametrize("actions", ["arc-25", "velocity"])
def test_choices_are_actions_of_the_set(actions: str) -> None:
    spec = ActionSpec.model_validate({"set": actions, "max_speed_m_s": 3.0})
    known = choices(spec)
    np.testing.assert_array_equal(commands(spec, known.actions), known.commands)
    speed = np.hypot(known.commands[:, 0], known.commands[:, 1])
    assert (speed.min(), speed.max()) == (0.0, pytest.approx(3.0))


def test_the_map_is_the_way_around() -> None:
    """Without obstacles the time to go is the distance; behind one it is longer, never inside."""
    free = Navigation(spec_of(None, SMALL | {"arena": "open-field"}), 1)
    free.begin([0], [3])
    arenas, body = free.whole_truth().arenas, PlannerBody(0.3, 0.1, 2.5, 5.0, 3.0)
    known = map_of(arenas, 0, body)
    rows, columns = np.indices(known.gap.shape)
    north, east = known.north + rows * known.cell, known.east + columns * known.cell
    away = np.hypot(north - arenas.goal[0, 0], east - arenas.goal[0, 1])
    far = (known.gap > 2.0) & (away > 5.0)
    assert np.abs(known.to_go - away)[far].max() < 0.08 * away[far].max()
    crowd = Navigation(spec_of(None, SMALL | {"arena": "dense-obstacles"}), 1)
    crowd.begin([0], [3])
    arenas = crowd.whole_truth().arenas
    among = map_of(arenas, 0, body)
    rows, columns = np.indices(among.gap.shape)
    north, east = among.north + rows * among.cell, among.east + columns * among.cell
    away = np.hypot(north - arenas.goal[0, 0], east - arenas.goal[0, 1])
    assert (among.to_go > away - 2.0 * among.cell).all()
    centers = arenas.center[0, : arenas.n_static[0], :2]
    inside = np.rint((centers - (among.north, among.east)) / among.cell).astype(int)
    assert (among.gap[inside[:, 0], inside[:, 1]] < 0.0).all()
    for row, column in ((0, 0), (30, 40), (61, 17), *inside.tolist()):
        at = among.north + row * among.cell, among.east + column * among.cell
        walls = np.abs(arenas.bounds[0, :4] - np.repeat(at, 2))
        found = [beside(arenas, 0, k, body, *at) for k in range(arenas.n_static[0])]
        assert among.gap[row, column] == pytest.approx(min(*found, *walls))


def config(name: str, **changes: Any) -> TrainingConfig:
    values: dict[str, Any] = {
        "description": "an apprentice",
        "steps": 3200,
        "vehicles": 16,
        "environment": SMALL | {"arena": "static-obstacles", "episode": {"time_limit_s": 30.0}},
        "algorithm": {
            "name": name,
            "learning_starts": 300,
            "env_steps_per_update": 8,
            "learning_rate": 1e-3,
            "batch_size": 64,
        },
        "selection": {"every": 3200, "episodes": 10},
    }
    return TrainingConfig.model_validate(values | changes)


@pytest.mark.nightly
def test_dagger_learns_within_seconds(tmp_path: Path) -> None:
    """Chance reaches no goal in static-obstacles; after 3200 decisions more than half are."""
    asked = config("dagger")
    result = train(asked, tmp_path / "run", name="apprentice")
    assert result.card.algorithm == "dagger"
    policy = load_learned(result.folder.policy)
    flown = list(fly_episodes(nominal(asked.environment), policy.act_batch, range(1, 41)))
    rng = np.random.default_rng(0)
    chance = fly_episodes(
        nominal(asked.environment),
        lambda seen: rng.integers(0, 25, len(seen["goal"])),
        range(1, 21),
    )
    assert success_rate(list(chance)) < 0.2
    assert success_rate(flown) > 0.5


class SaveOnce(BaseCallback):
    """Saves between two steps, halfway."""

    def __init__(self, folder: Path, at: int) -> None:
        super().__init__()
        self.folder, self.at = folder, at

    def _on_rollout_start(self) -> None:
        if self.num_timesteps >= self.at and not self.folder.exists():
            save_checkpoint(self.folder, self.model, {})

    def _on_step(self) -> bool:
        return True


@pytest.mark.parametrize(("name", "actions"), [("dagger", "velocity"), ("bc", "arc-25")])
def test_goes_on_bit_for_bit(name: str, actions: str, tmp_path: Path) -> None:
    environment = SMALL | {"arena": "dynamic-obstacles", "actions": actions}
    # The ring goes round.
    algorithm = {"name": name, "learning_starts": 40, "buffer_size": 100}
    asked = config(name, environment=environment, algorithm=algorithm | {"batch_size": 8})

    def fresh(seed: int) -> Any:
        env = NavigationVecEnv(NavigationVectorEnv(4, asked.environment))
        env.seed(seed)
        return make_model(asked.algorithm, asked.network, env, seed)

    straight = fresh(1)
    straight.learn(280, callback=SaveOnce(tmp_path / "checkpoints", 140))
    resumed = fresh(2)
    load_latest(tmp_path / "checkpoints", resumed)
    assert resumed.num_timesteps == 140
    resumed.learn(280 - resumed.num_timesteps, reset_num_timesteps=False)
    ours, theirs = straight.policy.state_dict(), resumed.policy.state_dict()
    assert all(ours[key].equal(theirs[key]) for key in ours)
    assert straight._n_updates == resumed._n_updates > 0
    assert not any(
        ours[key].equal(fresh(1).policy.state_dict()[key]) for key in ours if "action_net" in key
    )


def test_bfloat16_learns_as_float32_does() -> None:
    losses = []
    for precision in ("float32", "bfloat16"):
        algorithm = {"name": "bc", "learning_starts": 40, "batch_size": 32, "precision": precision}
        environment = SMALL | {"arena": "no-obstacles", "actions": "velocity"}
        asked = config("bc", environment=environment, algorithm=algorithm)
        env = NavigationVecEnv(NavigationVectorEnv(4, asked.environment))
        env.seed(1)
        model: Any = make_model(asked.algorithm, asked.network, env, 1)
        model.learn(400)
        assert all(weights.dtype == torch.float32 for weights in model.policy.parameters())
        losses.append(model._update())
    assert losses[0] != losses[1] == pytest.approx(losses[0], rel=0.1)


def test_cloning_never_flies_the_learner() -> None:
    asked = config("bc", environment=SMALL | {"arena": "no-obstacles"})
    env = NavigationVecEnv(NavigationVectorEnv(2, asked.environment))
    model: Any = make_model(asked.algorithm, asked.network, env, 1)
    model._current_progress_remaining = 0.0
    assert model.expert_share == 1.0
    dagger: Any = make_model(config("dagger").algorithm, asked.network, env, 1)
    shares = []
    for left in (1.0, 0.85, 0.7, 0.0):
        dagger._current_progress_remaining = left
        shares.append(dagger.expert_share)
    assert shares == pytest.approx([1.0, 0.5, 0.0, 0.0])
