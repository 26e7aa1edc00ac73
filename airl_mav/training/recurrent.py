"""Recurrent policies of sb3-contrib: the actor, with its memory as inputs and outputs.

The LSTM is unrolled to one step, so that an export has only products and sums and any batch size.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from torch import nn
from torch.nn import functional

from airl_mav.policy.layouts import GOAL, VELOCITY
from airl_mav.policy.observation_spec import Encoded
from airl_mav.policy.runtime import Shapes

HIDDEN, CELL = "hidden", "cell"
"""Names of the two memory arrays (n, layers, units) of an LSTM."""


class LstmStep(nn.Module):
    """One layer of an LSTM, one step: hidden' and cell' (n, units) of inputs, hidden and cell."""

    def __init__(self, lstm: nn.LSTM, layer: int) -> None:
        super().__init__()
        self.units = lstm.hidden_size
        self.input_weight = getattr(lstm, f"weight_ih_l{layer}")
        self.hidden_weight = getattr(lstm, f"weight_hh_l{layer}")
        self.input_bias = getattr(lstm, f"bias_ih_l{layer}")
        self.hidden_bias = getattr(lstm, f"bias_hh_l{layer}")

    def forward(
        self, seen: torch.Tensor, hidden: torch.Tensor, cell: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the layer's output, which is the next hidden, and the next cell."""
        gates = functional.linear(seen, self.input_weight, self.input_bias)
        gates = gates + functional.linear(hidden, self.hidden_weight, self.hidden_bias)
        # torch's order of the gates.
        take, keep, new, show = gates.chunk(4, dim=1)
        cell = torch.sigmoid(keep) * cell + torch.sigmoid(take) * torch.tanh(new)
        return torch.sigmoid(show) * torch.tanh(cell), cell


class RecurrentNetwork(nn.Module):
    """From the three inputs, hidden and cell to the outputs, the next hidden and the next cell."""

    def __init__(
        self, features: nn.Module, lstm: nn.LSTM, head: nn.Module, image: str = "depth"
    ) -> None:
        """Connect features of Dict observations, with the image's key, LSTM and output head."""
        super().__init__()
        self.image = image
        self.features = features
        self.steps = nn.ModuleList(LstmStep(lstm, layer) for layer in range(lstm.num_layers))
        self.head = head
        self.state: Shapes = {
            HIDDEN: (lstm.num_layers, lstm.hidden_size),
            CELL: (lstm.num_layers, lstm.hidden_size),
        }

    def forward(
        self,
        image: torch.Tensor,
        velocity: torch.Tensor,
        goal: torch.Tensor,
        hidden: torch.Tensor,
        cell: torch.Tensor,
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return the outputs (n, k), and hidden and cell (n, layers, units) after the decision."""
        seen = {self.image: image, VELOCITY: velocity, GOAL: goal}
        return self.decided(seen, hidden, cell)

    def decided(
        self, seen: dict[str, torch.Tensor], hidden: torch.Tensor, cell: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return the outputs of `forward` for observations by key."""
        found = self.features(seen)
        hiddens, cells = [], []
        for layer, step in enumerate(self.steps):
            found, kept = step(found, hidden[:, layer], cell[:, layer])
            hiddens.append(found)
            cells.append(kept)
        return self.head(found), torch.stack(hiddens, dim=1), torch.stack(cells, dim=1)


class RecurrentOfAny(RecurrentNetwork):
    """Recurrent network for any arrays, in the order of their keys."""

    def __init__(
        self, features: nn.Module, lstm: nn.LSTM, head: nn.Module, keys: Sequence[str]
    ) -> None:
        """Initialize as `RecurrentNetwork`, with keys."""
        super().__init__(features, lstm, head)
        self.keys = tuple(keys)

    def forward(self, *arrays: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return the outputs (n, k), and hidden and cell (n, layers, units) after the decision."""
        *seen, hidden, cell = arrays
        return self.decided(dict(zip(self.keys, seen, strict=True)), hidden, cell)


class GreedyDecisions:
    """Greedy decisions of a learner, n flights at a time; `began` resets a flight's memory."""

    def __init__(self, model: BaseAlgorithm) -> None:
        self._model = model
        self._state: tuple[NDArray[Any], ...] | None = None
        self._new: set[int] = set()

    def began(self, slot: int) -> None:
        """Mark the start of an episode in a slot."""
        self._new.add(slot)

    def __call__(self, seen: Encoded) -> NDArray[Any]:
        """Return the actions of n vehicles."""
        starts = np.zeros(len(next(iter(seen.values()))), np.bool_)
        starts[list(self._new)] = True
        self._new.clear()
        actions, self._state = self._model.predict(
            seen, self._state, episode_start=starts, deterministic=True
        )
        return actions
