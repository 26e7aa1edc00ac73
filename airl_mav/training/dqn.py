"""Double DQN with n-step returns, on stable-baselines3's DQN.

Double Q-learning: van Hasselt et al., "Deep Reinforcement Learning with Double Q-learning" (AAAI
2016). N-step returns: Sutton, "Learning to predict by the methods of temporal differences" (1988);
as in Rainbow, there is no off-policy correction within the n steps.

The replay memory is a ring buffer with one row per step of all vehicles. Each observation is stored
once: the next observation is in the next row. The last observation of a truncated episode is in no
row and is stored separately.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from typing import Any, NamedTuple, cast

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3 import DQN
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.utils import polyak_update
from stable_baselines3.dqn.policies import DQNPolicy
from torch.nn import functional

from airl_mav.policy.layouts import Encoded
from airl_mav.training.config import Precision

RUNNING, TERMINATED, TRUNCATED = 0, 1, 2

NOT_ASIDE = -1


class Batch(NamedTuple):
    """Samples of n-step transitions, arrays (batch, ...).

    A target is `returns + discounts * value(next_observations)`; `discounts` is gamma^k for k
    rewards, 0 after the end of an episode.
    """

    observations: Encoded
    actions: NDArray[np.int64]
    returns: NDArray[np.float32]
    discounts: NDArray[np.float32]
    next_observations: Encoded


Shapes = Mapping[str, tuple[tuple[int, ...], np.dtype[Any]]]
"""Shape and type of each array of an observation."""


def shapes_of(space: spaces.Space[Any]) -> Shapes:
    """Return the shapes of the observations of a Dict space."""
    assert isinstance(space, spaces.Dict)  # noqa: S101 (MultiInputPolicy's)
    boxes = {k: cast("spaces.Box", v) for k, v in space.spaces.items()}
    return {k: (box.shape, box.dtype) for k, box in boxes.items()}


class Ring:
    """Ring buffer of observations and actions, a row per step of all vehicles."""

    def __init__(self, shapes: Shapes, actions: NDArray[Any]) -> None:
        """Use zero-filled `actions` (rows, vehicles, ...), with observations of these shapes."""
        self.rows, self.vehicles = int(actions.shape[0]), int(actions.shape[1])
        size = self.rows, self.vehicles
        self.head = 0
        self.filled = 0
        self._actions = actions
        self._observations = {k: np.zeros((*size, *s), t) for k, (s, t) in shapes.items()}

    def _store(self, observations: Mapping[str, NDArray[Any]], actions: NDArray[Any]) -> None:
        """Write the current row and advance to the next one."""
        for key, array in self._observations.items():
            array[self.head] = observations[key]
        self._actions[self.head] = actions
        self.head = (self.head + 1) % self.rows
        self.filled = min(self.filled + 1, self.rows)

    def get_state(self) -> dict[str, NDArray[Any]]:
        """Return the complete memory by name; views, not copies."""
        state = {name: array[: self.filled] for name, array in self._named().items()}
        return state | {"head": np.array(self.head)}

    def set_state(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Restore the state from `get_state`; ValueError for other shapes."""
        named = self._named()
        for name, array in named.items():
            saved = state[name]
            if saved.shape[1:] != array.shape[1:] or len(saved) > self.rows:
                raise ValueError(f"replay {name}: {saved.shape} does not fit {array.shape}")
        for name, array in named.items():
            array[: len(state[name])] = state[name]
        self.filled, self.head = len(state["actions"]), int(state["head"])

    def _named(self) -> dict[str, NDArray[Any]]:
        seen = {f"observations/{key}": array for key, array in self._observations.items()}
        return {"actions": self._actions} | seen


class NStepReplay(Ring):
    """Replay memory of `steps` transitions, in rows of `vehicles`.

    A chain has at most `n_step` rewards.
    """

    def __init__(
        self, steps: int, vehicles: int, shapes: Shapes, n_step: int, gamma: float
    ) -> None:
        # A sample needs the next n rows.
        size = max(steps // vehicles, 1) + n_step, vehicles
        super().__init__(shapes, np.zeros(size, np.int64))
        self.n_step = n_step
        self.gamma = gamma
        self._rewards = np.zeros(size, np.float32)
        self._ends = np.zeros(size, np.uint8)
        self._slots = np.full(size, NOT_ASIDE, np.int32)
        self._last = {k: np.zeros((vehicles, *s), t) for k, (s, t) in shapes.items()}
        self._free = list(range(vehicles))

    def __len__(self) -> int:
        """Return the number of transitions that can be sampled."""
        return max(self.filled - self.n_step, 0) * self.vehicles

    def add(
        self,
        observations: Mapping[str, NDArray[Any]],
        actions: NDArray[Any],
        rewards: NDArray[Any],
        dones: NDArray[np.bool_],
        infos: Sequence[Mapping[str, Any]],
    ) -> None:
        """Store one step of all vehicles; rewards, actions and dones are (vehicles,).

        `infos` of ended episodes have `TimeLimit.truncated` and `terminal_observation`.
        """
        row = self.head
        used = self._slots[row]
        self._free += used[used != NOT_ASIDE].tolist()
        self._rewards[row] = rewards
        self._ends[row] = RUNNING
        self._slots[row] = NOT_ASIDE
        for vehicle in np.flatnonzero(dones).tolist():
            info = infos[vehicle]
            truncated = bool(info.get("TimeLimit.truncated", False))
            self._ends[row, vehicle] = TRUNCATED if truncated else TERMINATED
            if truncated:
                self._slots[row, vehicle] = self._put_aside(info["terminal_observation"])
        self._store(observations, actions)

    def sample(self, batch: int, generator: np.random.Generator) -> Batch:
        """Draw transitions uniformly, with replacement."""
        age = generator.integers(self.filled - self.n_step, size=batch)
        vehicle = generator.integers(self.vehicles, size=batch)
        oldest = self.head if self.filled == self.rows else 0
        return self.transitions((oldest + age) % self.rows, vehicle)

    def transitions(self, rows: NDArray[np.int64], vehicles: NDArray[np.int64]) -> Batch:
        """Return the n-step transitions from (row, vehicle); each row must have n later rows."""
        returns = np.zeros(len(rows), np.float32)
        weight = np.ones(len(rows), np.float32)
        last = rows
        ended = np.zeros(len(rows), np.bool_)
        for k in range(self.n_step):
            # An ended chain stays at its last row without further rewards.
            last = np.where(ended, last, (rows + k) % self.rows)
            returns += np.where(ended, np.float32(0), weight * self._rewards[last, vehicles])
            weight = np.where(ended, weight, weight * np.float32(self.gamma))
            ended = self._ends[last, vehicles] != RUNNING
        slots = self._slots[last, vehicles]
        aside = slots != NOT_ASIDE
        following = {k: v[(last + 1) % self.rows, vehicles] for k, v in self._observations.items()}
        for key, array in following.items():
            array[aside] = self._last[key][slots[aside]]
        return Batch(
            {k: v[rows, vehicles] for k, v in self._observations.items()},
            self._actions[rows, vehicles],
            returns,
            np.where(self._ends[last, vehicles] == TERMINATED, np.float32(0), weight),
            following,
        )

    def get_state(self) -> dict[str, NDArray[Any]]:
        """Return the complete memory by name; views, not copies."""
        state = super().get_state()
        state |= {f"last/{key}": each for key, each in self._last.items()}
        state["free"] = np.array(self._free, np.int32)
        return state

    def set_state(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Restore the state from `get_state`; ValueError for other shapes."""
        super().set_state(state)
        self._last = {key: state[f"last/{key}"].copy() for key in self._last}
        self._free = state["free"].tolist()

    def _named(self) -> dict[str, NDArray[Any]]:
        named = super()._named()
        named |= {"rewards": self._rewards, "ends": self._ends, "slots": self._slots}
        return named

    def _put_aside(self, observation: Mapping[str, NDArray[Any]]) -> int:
        """Store an episode's last observation and return its slot."""
        if not self._free:
            size = len(next(iter(self._last.values())))
            self._free = list(range(size, 2 * size))
            self._last = {k: np.concatenate([v, np.zeros_like(v)]) for k, v in self._last.items()}
        slot = self._free.pop()
        for key, array in self._last.items():
            array[slot] = observation[key]
        return slot


def autocast(device: torch.device, precision: Precision) -> AbstractContextManager[Any]:
    """Return the context for forward passes with a precision."""
    return torch.autocast(device.type, torch.bfloat16, enabled=precision == "bfloat16")


class DoubleDQN(DQN):
    """DQN with double Q-learning, n-step returns and Dict observations of n vehicles.

    Intervals count steps of single vehicles. Vehicles explore independently. One generator draws
    exploration and samples, so that a run can be resumed exactly. Arguments are as in
    `config.AlgorithmSpec` and stable-baselines3's DQN.
    """

    def __init__(
        self,
        policy: str | type[DQNPolicy],
        env: Any,
        *,
        n_step: int = 3,
        double: bool = True,
        env_steps_per_update: int = 32,
        target_update_interval: int = 8000,
        precision: Precision = "float32",
        _init_setup_model: bool = True,
        **arguments: Any,
    ) -> None:
        super().__init__(
            policy,
            env,
            train_freq=1,
            gradient_steps=1,
            target_update_interval=target_update_interval,
            _init_setup_model=False,
            **arguments,
        )
        self.n_step = n_step
        self.double = double
        self.env_steps_per_update = env_steps_per_update
        self.precision = precision
        if _init_setup_model:
            self._setup_model()

    def _setup_model(self) -> None:
        shapes = shapes_of(self.observation_space)
        self.replay = NStepReplay(self.buffer_size, self.n_envs, shapes, self.n_step, self.gamma)
        # The base class only passes it between methods that are overridden below.
        self.replay_buffer = cast("ReplayBuffer", self.replay)
        # Learning requires a complete chain.
        self.learning_starts = max(self.learning_starts, self.n_step * self.n_envs)
        self.generator = np.random.default_rng(self.seed)
        super()._setup_model()

    def _sample_action(
        self,
        learning_starts: int,
        action_noise: ActionNoise | None = None,  # noqa: ARG002 (the base class's signature)
        n_envs: int = 1,
    ) -> tuple[NDArray[Any], NDArray[Any]]:
        """Return an action for each vehicle, twice: as executed and as stored."""
        warm_up = self.num_timesteps < learning_starts
        share = 1.0 if warm_up else self.exploration_rate
        greedy = self.generator.random(n_envs) >= share
        choices = int(cast("spaces.Discrete", self.action_space).n)
        actions = self.generator.integers(choices, size=n_envs)
        if greedy.any():
            seen = cast("Mapping[str, NDArray[Any]]", self._last_obs)
            with torch.no_grad(), autocast(self.device, self.precision):
                values = self.q_net(self._tensors({k: v[greedy] for k, v in seen.items()}))
            actions[greedy] = values.argmax(dim=1).cpu().numpy()
        return actions, actions

    def _store_transition(
        self,
        replay_buffer: ReplayBuffer,  # noqa: ARG002 (the base class's signature)
        buffer_action: NDArray[Any],
        new_obs: NDArray[Any] | dict[str, NDArray[Any]],
        reward: NDArray[Any],
        dones: NDArray[Any],
        infos: list[dict[str, Any]],
    ) -> None:
        seen = cast("Mapping[str, NDArray[Any]]", self._last_obs)
        self.replay.add(seen, buffer_action, reward, dones, infos)
        self._last_obs = new_obs

    def _on_step(self) -> None:
        if self._due(self.target_update_interval):
            polyak_update(self.q_net.parameters(), self.q_net_target.parameters(), self.tau)
        self.exploration_rate = self.exploration_schedule(self._current_progress_remaining)
        self.logger.record("rollout/exploration_rate", self.exploration_rate)

    def train(self, gradient_steps: int, batch_size: int = 100) -> None:
        """Run the updates due after the last step of all vehicles."""
        updates = gradient_steps * self._due(self.env_steps_per_update)
        if not updates:
            return
        self.policy.set_training_mode(True)
        self._update_learning_rate(self.policy.optimizer)
        losses = [
            self._update(self.replay.sample(batch_size, self.generator)) for _ in range(updates)
        ]
        self._n_updates += updates
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        self.logger.record("train/loss", float(np.mean(losses)))

    def _update(self, batch: Batch) -> float:
        """Run one update and return its loss."""
        following = self._tensors(batch.next_observations)
        returns, discounts = self._tensor(batch.returns), self._tensor(batch.discounts)
        with torch.no_grad(), autocast(self.device, self.precision):
            values = self.q_net_target(following).float()
            chooser = self.q_net(following) if self.double else values
            chosen = chooser.argmax(dim=1, keepdim=True)
            target = returns + discounts * values.gather(1, chosen).squeeze(1)
        with autocast(self.device, self.precision):
            estimates = self.q_net(self._tensors(batch.observations)).float()
        taken = estimates.gather(1, self._tensor(batch.actions)[:, None]).squeeze(1)
        loss = functional.smooth_l1_loss(taken, target)
        self.policy.optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(self.q_net.parameters(), self.max_grad_norm)
        self.policy.optimizer.step()
        return loss.item()

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "replay", "generator"]

    def _due(self, interval: int) -> int:
        """Return the number of multiples of an interval within the last step of all vehicles."""
        return self.num_timesteps // interval - (self.num_timesteps - self.n_envs) // interval

    def _tensor(self, array: NDArray[Any]) -> torch.Tensor:
        return torch.from_numpy(array).to(self.device)

    def _tensors(self, arrays: Mapping[str, NDArray[Any]]) -> dict[str, torch.Tensor]:
        return {key: self._tensor(array) for key, array in arrays.items()}
