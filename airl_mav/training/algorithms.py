"""From a specification to a learner: our double DQN, PPO, and any other of stable-baselines3."""

from __future__ import annotations

import difflib
import importlib
import inspect
import math
from typing import Any

import torch
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecEnv

from airl_mav.core.errors import UsageError
from airl_mav.policy.runtime import first_line
from airl_mav.training.config import AlgorithmSpec, NetworkSpec
from airl_mav.training.dqn import DoubleDQN
from airl_mav.training.networks import policy_arguments, to_channels_last

POLICY = "MultiInputPolicy"

CLASSES = {
    "dqn": "airl_mav.training.dqn.DoubleDQN",
    "ppo": "stable_baselines3.PPO",
    "a2c": "stable_baselines3.A2C",
    "ddpg": "stable_baselines3.DDPG",
    "sac": "stable_baselines3.SAC",
    "td3": "stable_baselines3.TD3",
    "qrdqn": "sb3_contrib.QRDQN",
    "tqc": "sb3_contrib.TQC",
    "trpo": "sb3_contrib.TRPO",
}
"""Algorithms that take Dict observations, need no action mask and have no memory."""

DISCRETE_ONLY = frozenset({"dqn", "qrdqn"})
CONTINUOUS_ONLY = frozenset({"ddpg", "sac", "td3", "tqc"})

SHARED_FIELDS = ("learning_rate", "gamma", "batch_size", "buffer_size", "learning_starts")
"""Fields of the specification that have the same name in stable-baselines3."""

DQN_FIELDS = {
    "n_step": "n_step",
    "double": "double",
    "env_steps_per_update": "env_steps_per_update",
    "target_interval": "target_update_interval",
    "exploration_initial": "exploration_initial_eps",
    "exploration_final": "exploration_final_eps",
    "exploration_fraction": "exploration_fraction",
    "precision": "precision",
}
"""Fields that only `dqn` has, and their names there."""

DQN_OPTIONS = ("max_grad_norm", "tau", "stats_window_size")
"""Arguments of stable-baselines3's DQN that have no field."""

NOT_OPTIONS = frozenset(
    {"self", "policy", "env", "seed", "device", "verbose", "policy_kwargs", "tensorboard_log"}
    | {"action_noise", "monitor_wrapper", "_init_setup_model", *SHARED_FIELDS}
    | {"replay_buffer_class", "replay_buffer_kwargs", "rollout_buffer_class"}
    | {"rollout_buffer_kwargs", "optimize_memory_usage"}
)
"""Arguments of stable-baselines3 that come from elsewhere or cannot stand in a file."""

BATCH = 128
ON_POLICY_BATCH = 256
ROLLOUT = 4096
"""Steps of all vehicles between two rounds of updates of `ppo` and `trpo`."""

OPTION_DEFAULTS: dict[str, dict[str, Any]] = {"ppo": {"n_epochs": 4, "ent_coef": 0.005}, "trpo": {}}
"""Defaults that differ from those of stable-baselines3."""


def make_model(
    algorithm: AlgorithmSpec,
    network: NetworkSpec,
    vec_env: VecEnv,
    seed: int,
    tensorboard_log: str | None = None,
    device: str = "cpu",
) -> BaseAlgorithm:
    """Build a learner with fresh weights; makes torch use one thread.

    Raises:
        UsageError: Unknown algorithm or option, a field that the algorithm does not have, a value
            that it does not take, or actions that it cannot choose.
    """
    # More threads than free cores make the small matrices here 5 to 10 times slower.
    torch.set_num_threads(1)
    learner = _algorithm_class(algorithm.name)
    _check_actions(algorithm.name, vec_env.action_space)
    arguments = _arguments(algorithm, learner, vec_env.num_envs)
    try:
        model: BaseAlgorithm = learner(
            POLICY,
            vec_env,
            seed=seed,
            device=device,
            tensorboard_log=tensorboard_log,
            policy_kwargs=policy_arguments(network),
            **arguments,
        )
    except (AssertionError, TypeError, ValueError) as error:
        if not algorithm.options:
            raise
        raise UsageError(f"algorithm.options of {algorithm.name!r}: {first_line(error)}") from None
    to_channels_last(model.policy)
    return model


def _algorithm_class(name: str) -> Any:
    """Return the class of an algorithm."""
    if name not in CLASSES:
        raise UsageError(f"algorithm.name = {name!r}: accepted: {', '.join(CLASSES)}")
    module, _, class_name = CLASSES[name].rpartition(".")
    try:
        return getattr(importlib.import_module(module), class_name)
    except ModuleNotFoundError:
        raise UsageError(
            f"algorithm.name = {name!r}: needs sb3-contrib (pip install sb3-contrib)"
        ) from None


def _check_actions(name: str, space: spaces.Space[Any]) -> None:
    discrete = isinstance(space, spaces.Discrete)
    if name in (CONTINUOUS_ONLY if discrete else DISCRETE_ONLY):
        kind, wanted = ("discrete", "continuous") if discrete else ("continuous", "discrete")
        excluded = CONTINUOUS_ONLY if discrete else DISCRETE_ONLY
        fitting = ", ".join(known for known in CLASSES if known not in excluded)
        raise UsageError(
            f"algorithm.name = {name!r}: chooses {wanted} actions, the action set is {kind}; "
            f"accepted: {fitting}"
        )


def _arguments(spec: AlgorithmSpec, learner: Any, vehicles: int) -> dict[str, Any]:
    """Return the constructor's arguments, those of `options` included."""
    known = list(inspect.signature(learner.__init__).parameters)
    if learner is DoubleDQN:
        known = [*SHARED_FIELDS, *DQN_OPTIONS]
    fields = {name: name for name in SHARED_FIELDS if name in known}
    fields |= DQN_FIELDS if learner is DoubleDQN else {}
    for name in spec.model_fields_set - {"name", "options", "learning_rate_final"}:
        if name not in fields:
            raise UsageError(
                f"algorithm.{name}: {spec.name!r} has no such field; fields: {', '.join(fields)}"
            )
    arguments = {argument: getattr(spec, name) for name, argument in fields.items()}
    on_policy = spec.name in OPTION_DEFAULTS
    if spec.learning_rate_final is not None:
        arguments["learning_rate"] = LinearSchedule(
            spec.learning_rate, spec.learning_rate_final, end_fraction=1.0
        )
    if spec.batch_size is None and "batch_size" in arguments:
        arguments["batch_size"] = ON_POLICY_BATCH if on_policy else BATCH
    if on_policy:
        arguments |= OPTION_DEFAULTS[spec.name]
        arguments["n_steps"] = _rollout_steps(arguments["batch_size"], vehicles)
    accepted = [name for name in known if name not in NOT_OPTIONS]
    for name in spec.options:
        if name not in accepted:
            near = difflib.get_close_matches(name, accepted, n=1)
            hint = f"did you mean {near[0]!r}?" if near else f"accepted: {', '.join(accepted)}"
            raise UsageError(f"algorithm.options.{name}: unknown to {spec.name!r}; {hint}")
    # A TOML list is what stable-baselines3 takes as a tuple.
    options = {k: tuple(v) if isinstance(v, list) else v for k, v in spec.options.items()}
    return arguments | options


def _rollout_steps(batch_size: int, vehicles: int) -> int:
    """Return the steps of each vehicle in a rollout that whole batches fill."""
    multiple = batch_size // math.gcd(batch_size, vehicles)
    return max(ROLLOUT // vehicles // multiple, 1) * multiple
