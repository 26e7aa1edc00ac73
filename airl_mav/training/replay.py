"""Replay memory with n-step returns for n vehicles and Dict observations.

A ring of rows, one row a step of all vehicles. Each observation is stored once: the next one is
that of the next row. Only where the time ran out does a chain need an observation that no row
holds, the last one of the episode; those lie aside.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from airl_mav.policy.observation_spec import Encoded

RUNNING, TERMINATED, TRUNCATED = 0, 1, 2
"""Status of an episode after a step."""

NOT_ASIDE = -1


class Batch(NamedTuple):
    """Samples of n-step transitions; every array has a leading axis (batch,).

    A target is `returns + discounts * value(next_observations)`. `discounts` is gamma^k for a chain
    of k rewards, 0 where the episode terminated.
    """

    observations: Encoded
    actions: NDArray[np.int64]
    returns: NDArray[np.float32]
    discounts: NDArray[np.float32]
    next_observations: Encoded


class NStepReplay:
    """The memory.

    Args:
        steps: Transitions to remember, of all vehicles together.
        vehicles: Vehicles a row.
        shapes: Shape and type of each array of an observation, without the leading axis.
        n_step: Rewards that a chain sums at most.
        gamma: Discount of one step.
    """

    def __init__(
        self,
        steps: int,
        vehicles: int,
        shapes: Mapping[str, tuple[tuple[int, ...], np.dtype[Any]]],
        n_step: int,
        gamma: float,
    ) -> None:
        # A sample needs the n rows behind it.
        self.rows = max(steps // vehicles, 1) + n_step
        self.vehicles = vehicles
        self.n_step = n_step
        self.gamma = gamma
        self.head = 0
        self.filled = 0
        size = (self.rows, vehicles)
        self._observations = {k: np.zeros((*size, *s), t) for k, (s, t) in shapes.items()}
        self._actions = np.zeros(size, np.int64)
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
        """Store one step of all vehicles.

        Args:
            observations: What they saw before the step.
            actions: What they did, (vehicles,).
            rewards: What they got, (vehicles,).
            dones: Whose episode ended.
            infos: Of those, `TimeLimit.truncated` and then `terminal_observation` are read.
        """
        row = self.head
        used = self._slots[row]
        self._free += used[used != NOT_ASIDE].tolist()
        for key, array in self._observations.items():
            array[row] = observations[key]
        self._actions[row] = actions
        self._rewards[row] = rewards
        self._ends[row] = RUNNING
        self._slots[row] = NOT_ASIDE
        for vehicle in np.flatnonzero(dones).tolist():
            info = infos[vehicle]
            truncated = bool(info.get("TimeLimit.truncated", False))
            self._ends[row, vehicle] = TRUNCATED if truncated else TERMINATED
            if truncated:
                self._slots[row, vehicle] = self._put_aside(info["terminal_observation"])
        self.head = (row + 1) % self.rows
        self.filled = min(self.filled + 1, self.rows)

    def sample(self, batch: int, generator: np.random.Generator) -> Batch:
        """Draw transitions uniformly, with replacement."""
        age = generator.integers(self.filled - self.n_step, size=batch)
        vehicle = generator.integers(self.vehicles, size=batch)
        oldest = self.head if self.filled == self.rows else 0
        return self.transitions((oldest + age) % self.rows, vehicle)

    def transitions(self, rows: NDArray[np.int64], vehicles: NDArray[np.int64]) -> Batch:
        """Return the n-step transitions that begin at (row, vehicle); each row has n behind it."""
        returns = np.zeros(len(rows), np.float32)
        weight = np.ones(len(rows), np.float32)
        last = rows
        ended = np.zeros(len(rows), np.bool_)
        for k in range(self.n_step):
            # A chain that has ended stays on its last row with nothing more to gain.
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
        """Return the whole memory by name; views, not copies."""
        named = self._named_rows()
        state = {name: array[: self.filled] for name, array in named.items()}
        state |= {f"last/{key}": array for key, array in self._last.items()}
        state["free"] = np.array(self._free, np.int32)
        state["head"] = np.array(self.head)
        return state

    def set_state(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Restore what `get_state` returned.

        Raises:
            ValueError: It is of a memory with other shapes.
        """
        named = self._named_rows()
        for name, array in named.items():
            saved = state[name]
            if saved.shape[1:] != array.shape[1:] or len(saved) > self.rows:
                raise ValueError(f"replay {name}: {saved.shape} does not fit {array.shape}")
        self.head = int(state["head"])
        self.filled = len(state["rewards"])
        for name, array in named.items():
            array[: self.filled] = state[name]
        self._last = {key: state[f"last/{key}"].copy() for key in self._last}
        self._free = state["free"].tolist()

    def _named_rows(self) -> dict[str, NDArray[Any]]:
        named: dict[str, NDArray[Any]] = {
            "actions": self._actions,
            "rewards": self._rewards,
            "ends": self._ends,
            "slots": self._slots,
        }
        return named | {f"observations/{key}": array for key, array in self._observations.items()}

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
