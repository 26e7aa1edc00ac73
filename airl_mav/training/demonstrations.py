"""What an expert did, or would have done, remembered: a ring of steps of all vehicles."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from airl_mav.policy.observation_spec import Encoded


class Demonstrations:
    """Observations and the expert's actions.

    Args:
        steps: Decisions to remember, of all vehicles together.
        vehicles: Vehicles a row.
        shapes: Shape and type of each array of an observation, without the leading axis.
        actions: The action space.
    """

    def __init__(
        self,
        steps: int,
        vehicles: int,
        shapes: Mapping[str, tuple[tuple[int, ...], np.dtype[Any]]],
        actions: spaces.Space[Any],
    ) -> None:
        size = max(steps // vehicles, 1), vehicles
        discrete = isinstance(actions, spaces.Discrete)
        self.head = 0
        self.filled = 0
        self._observations = {k: np.zeros((*size, *s), t) for k, (s, t) in shapes.items()}
        self._actions = np.zeros(
            size if discrete else (*size, *(actions.shape or ())),
            np.int64 if discrete else np.float32,
        )

    def __len__(self) -> int:
        """Return the number of decisions that are remembered."""
        return self.filled * self._actions.shape[1]

    def add(self, observations: Mapping[str, NDArray[Any]], actions: NDArray[Any]) -> None:
        """Store what all vehicles saw, and what the expert would have done."""
        for key, array in self._observations.items():
            array[self.head] = observations[key]
        self._actions[self.head] = actions
        rows = len(self._actions)
        self.head = (self.head + 1) % rows
        self.filled = min(self.filled + 1, rows)

    def sample(self, batch: int, generator: np.random.Generator) -> tuple[Encoded, NDArray[Any]]:
        """Draw observations and their actions uniformly, with replacement."""
        rows = generator.integers(self.filled, size=batch)
        vehicles = generator.integers(self._actions.shape[1], size=batch)
        seen = {key: array[rows, vehicles] for key, array in self._observations.items()}
        return seen, self._actions[rows, vehicles]

    def get_state(self) -> dict[str, NDArray[Any]]:
        """Return the whole memory by name; views, not copies."""
        named = {name: array[: self.filled] for name, array in self._named().items()}
        return named | {"head": np.array(self.head)}

    def set_state(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Restore what `get_state` returned.

        Raises:
            ValueError: It is of a memory with other shapes.
        """
        for name, array in self._named().items():
            saved = state[name]
            if saved.shape[1:] != array.shape[1:] or len(saved) > len(array):
                raise ValueError(f"replay {name}: {saved.shape} does not fit {array.shape}")
            array[: len(saved)] = saved
        self.filled, self.head = len(state["actions"]), int(state["head"])

    def _named(self) -> dict[str, NDArray[Any]]:
        seen = {f"observations/{key}": array for key, array in self._observations.items()}
        return {"actions": self._actions} | seen
