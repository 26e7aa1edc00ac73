"""From a specification to a learner: every known name learns, misuse gets one line."""

from __future__ import annotations

import importlib
import inspect
from typing import Any

import pytest
from stable_baselines3 import DQN, PPO

from airl_mav.core.errors import UsageError
from airl_mav.training.algorithms import ROLLOUT, make_model
from airl_mav.training.config import ALGORITHMS, AlgorithmSpec, NetworkSpec, TrainingConfig
from airl_mav.training.dqn import DoubleDQN
from tests.support.toy_fleet import ToyFleet

SHORT: dict[str, dict[str, Any]] = {
    "ppo": {"options": {"n_steps": 16, "n_epochs": 1}, "batch_size": 32},
    "recurrent-ppo": {"options": {"n_steps": 16, "lstm_hidden_size": 8}, "batch_size": 32},
    "trpo": {"options": {"n_steps": 8}, "batch_size": 16},
    "a2c": {},
}
NOT_OPTIONS = frozenset(
    {"self", "policy", "env", "seed", "device", "verbose", "policy_kwargs", "tensorboard_log"}
    | {"action_noise", "monitor_wrapper", "_init_setup_model", "learning_rate", "gamma"}
    | {"batch_size", "buffer_size", "learning_starts"}
    | {"replay_buffer_class", "replay_buffer_kwargs", "rollout_buffer_class"}
    | {"rollout_buffer_kwargs", "optimize_memory_usage"}
)
"""Arguments of stable-baselines3 that come from elsewhere or cannot stand in a file."""

REPLAYING = {"buffer_size": 500, "learning_starts": 50, "batch_size": 8}


def make(name: str, *, continuous: bool = False, **fields: Any) -> Any:
    spec = AlgorithmSpec(name=name, **fields)
    return make_model(spec, NetworkSpec(), ToyFleet(4, continuous=continuous), seed=0)


@pytest.mark.parametrize("name", sorted(ALGORITHMS.keys() - {"bc", "dagger"}))
def test_every_known_algorithm_learns(name: str) -> None:
    model = make(
        name, continuous=ALGORITHMS[name].actions == "continuous", **SHORT.get(name, REPLAYING)
    )
    before = {k: v.clone() for k, v in model.policy.state_dict().items()}
    model.learn(100)
    after = model.policy.state_dict()
    assert any(not before[key].equal(after[key]) for key in before)


def test_dqn_takes_every_field() -> None:
    model = make(
        "dqn",
        learning_rate=0.01,
        gamma=0.9,
        batch_size=7,
        buffer_size=1000,
        learning_starts=77,
        n_step=5,
        double=False,
        env_steps_per_update=9,
        target_interval=99,
        exploration_initial=0.8,
        exploration_final=0.1,
        exploration_fraction=0.5,
        precision="bfloat16",
        options={"max_grad_norm": 3.0},
    )
    assert isinstance(model, DoubleDQN)
    assert model.lr_schedule(1.0) == 0.01
    assert (model.gamma, model.batch_size, model.learning_starts) == (0.9, 7, 77)
    assert (model.n_step, model.double, model.env_steps_per_update) == (5, False, 9)
    assert (model.target_update_interval, model.precision) == (99, "bfloat16")
    assert (model.replay.n_step, model.replay.gamma, model.max_grad_norm) == (5, 0.9, 3.0)
    assert model.replay.rows * model.n_envs == 1000 + 5 * 4
    assert model.exploration_schedule(1.0) == 0.8
    assert model.exploration_schedule(0.75) == pytest.approx(0.45)
    assert model.exploration_schedule(0.4) == pytest.approx(0.1)


@pytest.mark.parametrize("vehicles", [1, 3, 32, 48])
def test_whole_batches_fill_a_rollout(vehicles: int) -> None:
    model = make_model(AlgorithmSpec(name="ppo"), NetworkSpec(), ToyFleet(vehicles), seed=0)
    assert isinstance(model, PPO)
    assert model.n_steps * vehicles % model.batch_size == 0
    assert model.n_steps * vehicles >= ROLLOUT / 2


@pytest.mark.parametrize(
    ("fields", "line"),
    [
        ({"name": "reinforce"}, "algorithm.name 'reinforce': accepted: dqn, qr-dqn, ppo, rec"),
        ({"name": "sac"}, "'sac': accepted: a continuous action set (environment.actions: veloc"),
        ({"name": "tqc"}, "and this one is discrete; with it: dqn, qr-dqn, ppo, recurrent-ppo"),
        ({"name": "ppo", "n_step": 3}, "algorithm.n_step: 'ppo' has no such field; fields: learn"),
        ({"name": "a2c", "batch_size": 3}, "algorithm.batch_size: 'a2c' has no such field"),
        ({"name": "ppo", "options": {"nsteps": 3}}, "did you mean 'n_steps'"),
        ({"name": "dqn", "options": {"train_freq": 3}}, "options.train_freq: unknown to 'dqn'"),
        ({"name": "ppo", "options": {"policy": "x"}}, "options.policy: unknown to 'ppo'"),
        ({"name": "ppo", "options": {"gamma": 0.5}}, "options.gamma: unknown to 'ppo'"),
        ({"name": "ppo", "options": {"clip_range": "x"}}, "clip_range 'x': accepted: 0 < value"),
        ({"name": "qr-dqn", "options": {"n_quantiles": 0}}, "n_quantiles 0: accepted: 1 <= value"),
        ({"name": "a2c", "options": {"n_steps": 0}}, "options.n_steps 0: accepted: 1 <= value"),
        ({"name": "a2c", "options": {"n_step": 3}}, "did you mean 'n_steps'"),
        (
            {"name": "td3", "options": {"tau": "x"}},
            "algorithm.options.tau 'x': accepted: 0 < value",
        ),
        ({"name": "ddpg", "options": {"train_freq": 0}}, "train_freq 0: accepted: 1 <= value"),
        ({"name": "trpo", "options": {"target_kl": "a"}}, "target_kl 'a': accepted: 0 < value"),
        ({"name": "sac", "options": {"ent_coef": "low"}}, "algorithm.options.ent_coef 'low': acc"),
        (
            {"name": "recurrent-ppo", "options": {"shared_lstm": True}},
            "algorithm.options of 'recurrent-ppo': You must choose",
        ),
    ],
)
def test_misuse_gets_one_line(fields: dict[str, Any], line: str) -> None:
    with pytest.raises(UsageError) as refusal:
        make(**fields)
    assert line in str(refusal.value)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("name", ["dqn", "qr-dqn"])
def test_discrete_learners_are_refused_on_continuous_actions(name: str) -> None:
    with pytest.raises(UsageError, match="accepted: a discrete action set"):
        make(name, continuous=True)
    with pytest.raises(UsageError, match=r"a discrete action set \(environment.actions: arc-25,"):
        TrainingConfig.model_validate(
            {
                "description": "any",
                "algorithm": {"name": name},
                "environment": {"actions": "velocity"},
            }
        )


@pytest.mark.parametrize("name", ALGORITHMS)
def test_the_table_has_what_the_classes_take(name: str) -> None:
    """Nothing that a file may hold is missing, and nothing is in it that the class refuses."""
    row = ALGORITHMS[name]
    module, _, learner = row.source.rpartition(".")
    taken = inspect.signature(getattr(importlib.import_module(module), learner)).parameters
    if "arguments" in taken:  # Passed on to stable-baselines3's.
        assert set(row.options.model_fields) <= {*taken, *inspect.signature(DQN).parameters}
        return
    steps = {"n_steps"} if "buffer_size" in taken else set()  # Not with Dict observations.
    assert set(row.fields.values()) < set(taken)
    assert set(row.options.model_fields) - set(row.to_policy) == (set(taken) - NOT_OPTIONS - steps)
    assert set(row.defaults) <= set(row.options.model_fields)


def test_options_reach_the_learner_and_the_network() -> None:
    tqc = make(
        "tqc",
        continuous=True,
        options={"n_quantiles": 9, "n_critics": 3, "top_quantiles_to_drop_per_net": 1, "tau": 0.1},
    )
    assert (tqc.critic.n_quantiles, tqc.critic.n_critics) == (9, 3)
    assert (tqc.top_quantiles_to_drop_per_net, tqc.tau) == (1, 0.1)
    assert make("qr-dqn", options={"n_quantiles": 11}).policy.n_quantiles == 11
    with pytest.raises(UsageError, match=r"algorithm.expert: none for a ToyFleet"):
        make("dagger")
    assert make("recurrent-ppo").policy.lstm_actor.hidden_size == 128
    timid = make("ppo", continuous=True, options={"log_std_init": -1.5})
    assert timid.policy.log_std.tolist() == [-1.5, -1.5]
