"""From a specification to a learner: our double DQN, PPO, and any other of stable-baselines3."""

from __future__ import annotations

import importlib
import math
from typing import Any

import torch
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecEnv

from airl_mav.core.errors import UsageError
from airl_mav.policy.runtime import first_line
from airl_mav.training import config
from airl_mav.training.networks import policy_arguments, to_channels_last
from airl_mav.training.table import ALGORITHMS, Algorithm

BATCH = ALGORITHMS["dqn"].batch

ROLLOUT = 4096
"""Steps of all vehicles between two rounds of updates of `ppo` and `trpo`."""


def make_model(
    algorithm: config.AlgorithmSpec,
    network: config.NetworkSpec,
    vec_env: VecEnv,
    seed: int,
    tensorboard_log: str | None = None,
    device: str = "cpu",
) -> BaseAlgorithm:
    """Build a learner with fresh weights; makes torch use one thread.

    Raises:
        UsageError: Unknown algorithm or option, unsupported field or value, or unsupported actions.
    """
    # More threads than free cores make the small matrices here 5 to 10 times slower.
    torch.set_num_threads(1)
    row = ALGORITHMS[algorithm.name]
    learner = _algorithm_class(algorithm.name)
    discrete = isinstance(vec_env.action_space, spaces.Discrete)
    config.check_fields(algorithm)
    config.check_actions(algorithm.name, "discrete" if discrete else "continuous")
    arguments = _arguments(algorithm, row, vec_env.num_envs)
    network_arguments = policy_arguments(network)
    network_arguments |= {k: arguments.pop(k) for k in row.to_policy if k in arguments}
    try:
        model: BaseAlgorithm = learner(
            row.policy,
            vec_env,
            seed=seed,
            device=device,
            tensorboard_log=tensorboard_log,
            policy_kwargs=network_arguments,
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
    module, _, class_name = ALGORITHMS[name].source.rpartition(".")
    try:
        return getattr(importlib.import_module(module), class_name)
    except ModuleNotFoundError:
        raise UsageError(
            f"algorithm.name = {name!r}: needs sb3-contrib (pip install sb3-contrib)"
        ) from None


def _arguments(spec: config.AlgorithmSpec, row: Algorithm, vehicles: int) -> dict[str, Any]:
    """Return the constructor's arguments, those of `options` included."""
    arguments = {argument: getattr(spec, name) for name, argument in row.fields.items()}
    if spec.learning_rate_final is not None:
        arguments["learning_rate"] = LinearSchedule(
            spec.learning_rate, spec.learning_rate_final, end_fraction=1.0
        )
    if spec.batch_size is None and "batch_size" in arguments:
        arguments["batch_size"] = row.batch
    arguments |= row.defaults
    if row.rollouts:
        arguments["n_steps"] = _rollout_steps(arguments["batch_size"], vehicles)
    # A TOML list is what stable-baselines3 takes as a tuple.
    options = {k: tuple(v) if isinstance(v, list) else v for k, v in spec.options.items()}
    return arguments | options


def _rollout_steps(batch_size: int, vehicles: int) -> int:
    """Return the steps of each vehicle in a rollout that whole batches fill."""
    multiple = batch_size // math.gcd(batch_size, vehicles)
    return max(ROLLOUT // vehicles // multiple, 1) * multiple
