"""Imitation learning: behaviour cloning and DAgger, as a learner of stable-baselines3.

Behaviour cloning flies the expert and learns its actions (Pomerleau, "ALVINN", NIPS 1988). DAgger
flies the learner for a growing share of decisions, and labels the visited states with the expert's
actions (Ross, Gordon, Bagnell, AISTATS 2011, arXiv 1011.0686). Behaviour cloning is DAgger with the
expert always in control.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, cast

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import (
    ActorCriticPolicy,
    BasePolicy,
    MultiInputActorCriticPolicy,
)
from stable_baselines3.common.type_aliases import MaybeCallback, Schedule
from torch.nn import functional

from airl_mav.addons.imitation.experts import Expert
from airl_mav.core.errors import UsageError
from airl_mav.envs.sb3 import NavigationVecEnv
from airl_mav.policy.observation_spec import Encoded
from airl_mav.training.config import ExpertName
from airl_mav.training.dqn import Ring, Shapes, shapes_of


class Demonstrations(Ring):
    """Observations and the expert's actions."""

    def __init__(
        self, steps: int, vehicles: int, shapes: Shapes, actions: spaces.Space[Any]
    ) -> None:
        shape = () if isinstance(actions, spaces.Discrete) else actions.shape or ()
        kind = np.int64 if isinstance(actions, spaces.Discrete) else np.float32
        rows = max(steps // vehicles, 1)
        super().__init__(shapes, np.zeros((rows, vehicles, *shape), kind))

    def __len__(self) -> int:
        """Return the number of stored decisions."""
        return self.filled * self.vehicles

    def add(self, observations: Mapping[str, NDArray[Any]], actions: NDArray[Any]) -> None:
        """Store the observations of all vehicles, and the expert's actions."""
        self._store(observations, actions)

    def sample(self, batch: int, generator: np.random.Generator) -> tuple[Encoded, NDArray[Any]]:
        """Draw observations and their actions uniformly, with replacement."""
        rows = generator.integers(self.filled, size=batch)
        vehicles = generator.integers(self.vehicles, size=batch)
        seen = {key: array[rows, vehicles] for key, array in self._observations.items()}
        return seen, self._actions[rows, vehicles]


class Imitation(BaseAlgorithm):
    """Imitation of an expert with the networks of PPO, without learning the value.

    Intervals count steps of single vehicles. One generator draws the pilot of each decision and the
    samples, so that a run can be resumed exactly. `env` is a `NavigationVecEnv`, whose state the
    expert reads. The other arguments are as in `config.AlgorithmSpec`, its options and
    stable-baselines3's base class.
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MultiInputPolicy": MultiInputActorCriticPolicy
    }
    policy: ActorCriticPolicy

    def __init__(
        self,
        policy: str,
        env: NavigationVecEnv,
        *,
        expert: ExpertName = "planner",
        learning_rate: float | Schedule = 3e-4,
        batch_size: int = 256,
        buffer_size: int = 100_000,
        learning_starts: int = 2000,
        env_steps_per_update: int = 32,
        expert_share_initial: float = 1.0,
        expert_share_final: float = 0.0,
        expert_share_fraction: float = 0.3,
        max_grad_norm: float = 1.0,
        _init_setup_model: bool = True,
        **arguments: Any,
    ) -> None:
        super().__init__(
            policy,
            env,
            learning_rate,
            supported_action_spaces=(spaces.Discrete, spaces.Box),
            support_multi_env=True,
            **arguments,
        )
        self.expert_name: ExpertName = expert
        self.batch_size = batch_size
        self.buffer_size = buffer_size
        self.learning_starts = learning_starts
        self.env_steps_per_update = env_steps_per_update
        self.expert_shares = expert_share_initial, expert_share_final, expert_share_fraction
        self.max_grad_norm = max_grad_norm
        if _init_setup_model:
            self._setup_model()

    def _setup_model(self) -> None:
        self._setup_lr_schedule()
        self.set_random_seed(self.seed)
        policy = self.policy_class(
            self.observation_space, self.action_space, self.lr_schedule, **self.policy_kwargs
        )
        self.policy = cast("ActorCriticPolicy", policy.to(self.device))
        if not isinstance(self.env, NavigationVecEnv):
            raise UsageError(f"algorithm.expert: none for a {type(self.env).__name__}")
        self._expert = Expert(self.expert_name, self.env.env.navigation)
        self.env.teach(self._expert)
        shapes = shapes_of(self.observation_space)
        self.replay = Demonstrations(self.buffer_size, self.n_envs, shapes, self.action_space)
        self.generator = np.random.default_rng(self.seed)

    @property
    def expert_share(self) -> float:
        """Present share of the decisions made by the expert."""
        first, last, fraction = self.expert_shares
        gone = 1.0 - self._current_progress_remaining
        return first + (last - first) * min(1.0, gone / fraction)

    def learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 100,
        tb_log_name: str = "imitation",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> Imitation:
        """Fly and learn for a number of steps; see stable-baselines3's `BaseAlgorithm.learn`."""
        total, hooks = self._setup_learn(
            total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar
        )
        hooks.on_training_start(locals(), globals())
        logged = self._episode_num
        while self.num_timesteps < total:
            hooks.on_rollout_start()
            infos = self._fly()
            hooks.update_locals(locals())
            if not hooks.on_step():
                break
            hooks.on_rollout_end()
            self._update_current_progress_remaining(self.num_timesteps, total)
            self._train()
            if self._episode_num // log_interval > logged // log_interval:
                logged = self._episode_num
                self.logger.record("rollout/expert_share", self.expert_share)
                self.logger.dump(self.num_timesteps)
            del infos
        hooks.on_training_end()
        return self

    def _fly(self) -> list[dict[str, Any]]:
        """Fly one step of all vehicles and store the expert's actions; return the infos."""
        assert self.env is not None and self._last_obs is not None  # noqa: S101 (_setup_learn)
        seen = cast("Encoded", self._last_obs)
        shown = self._expert.decide()
        theirs = self.generator.random(self.n_envs) < self.expert_share
        flown = shown
        if not theirs.all():
            own, _ = self.policy.predict(seen, deterministic=True)
            flown = np.where(theirs.reshape(-1, *[1] * (shown.ndim - 1)), shown, own)
        self.replay.add(seen, shown)
        following, _, dones, infos = self.env.step(flown)
        self._last_obs = cast("dict[str, NDArray[Any]]", following)
        self._last_episode_starts = dones
        self.num_timesteps += self.n_envs
        self._episode_num += int(dones.sum())
        self._update_info_buffer(infos, dones)
        return infos

    def _train(self) -> None:
        """Run the updates due after the last step of all vehicles."""
        interval = self.env_steps_per_update
        due = self.num_timesteps // interval - (self.num_timesteps - self.n_envs) // interval
        if not due or self.num_timesteps < self.learning_starts:
            return
        self.policy.set_training_mode(True)
        self._update_learning_rate(self.policy.optimizer)
        losses = [self._update() for _ in range(due)]
        self._n_updates += due
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        self.logger.record("train/loss", float(np.mean(losses)))

    def _update(self) -> float:
        """Run one update and return its loss."""
        observations, actions = self.replay.sample(self.batch_size, self.generator)
        wanted = torch.from_numpy(actions).to(self.device)
        distribution = self.policy.get_distribution(
            {key: torch.from_numpy(a).to(self.device) for key, a in observations.items()}
        )
        if isinstance(self.action_space, spaces.Discrete):
            loss = -distribution.log_prob(wanted).mean()
        else:
            loss = functional.mse_loss(distribution.mode(), wanted)
        self.policy.optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(self.policy.parameters(), self.max_grad_norm)
        self.policy.optimizer.step()
        return loss.item()

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "replay", "generator", "_expert"]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        return ["policy", "policy.optimizer"], []
