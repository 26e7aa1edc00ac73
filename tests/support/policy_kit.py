"""Small real models of stable-baselines3 and sb3-contrib, and policies exported from them."""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import sb3_contrib
import stable_baselines3
import torch
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, create_mlp
from torch import nn

from airl_mav.policy.actions import ActionSpec, discrete_actions
from airl_mav.policy.card import PolicyCard, PolicyFacts
from airl_mav.policy.layouts import Encoded, boxes, image_key
from airl_mav.policy.observation_spec import ObservationSpec
from airl_mav.training.algorithms import ImageExtractor, dense_units
from airl_mav.training.config import NetworkSpec
from airl_mav.training.export import export_sb3

SPEC = ObservationSpec(height_px=24, width_px=32, horizontal_fov_deg=90.0, range_m=20.0)
"""Fits the camera of the shipped vehicle `quad`: 64x48 px."""


class Nowhere(gymnasium.Env[dict[str, np.ndarray], Any]):
    """An environment that only has spaces: a model cannot be made without one."""

    def __init__(self, spec: ObservationSpec, action_space: spaces.Space[Any]) -> None:
        self.observation_space: spaces.Space[Any] = spaces.Dict(
            {
                key: spaces.Box(box.low, box.high, box.shape, box.dtype)
                for key, box in boxes(spec).items()
            }
        )
        self.action_space = action_space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        super().reset(seed=seed)
        return self.observation_space.sample(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        return self.observation_space.sample(), 0.0, True, False, {}


class Eye(BaseFeaturesExtractor):
    """Two convolutions; velocity and goal join behind them."""

    def __init__(self, observation_space: spaces.Dict) -> None:
        self.image = image_key(observation_space.spaces)
        shape = observation_space[self.image].shape
        assert shape is not None
        layers = nn.Sequential(
            *(nn.Conv2d(shape[0], 4, 3, stride=2), nn.ReLU()),
            *(nn.Conv2d(4, 8, 3, stride=2), nn.ReLU()),
        )
        features = layers(torch.zeros(1, *shape)).numel()
        super().__init__(observation_space, features + 6)
        self.layers = layers

    def forward(self, seen: dict[str, torch.Tensor]) -> torch.Tensor:
        flat = self.layers(seen[self.image]).flatten(1)
        return torch.cat([flat, seen["velocity"], seen["goal"]], dim=1)


def action_space(actions: ActionSpec) -> spaces.Space[Any]:
    count = discrete_actions(actions)
    if count is None:
        return spaces.Box(-1.0, 1.0, (2,), np.float32)
    return spaces.Discrete(count)


def parameters_of(spec: NetworkSpec, height_px: int, width_px: int, outputs: int = 25) -> int:
    """Return the weights and biases of a network as torch builds it, from image to outputs."""
    seen = Nowhere(
        SPEC.model_copy(update={"height_px": height_px, "width_px": width_px}),
        spaces.Discrete(outputs),
    )
    assert isinstance(seen.observation_space, spaces.Dict)
    with torch.device("meta"):
        extractor = ImageExtractor(seen.observation_space, spec)
        head = nn.Sequential(*create_mlp(extractor.features_dim, outputs, dense_units(spec)))
    return sum(each.numel() for part in (extractor, head) for each in part.parameters())


def make_model(
    algorithm: str = "DQN",
    actions: str = "arc-25",
    *,
    spec: ObservationSpec = SPEC,
    space: spaces.Space[Any] | None = None,
    seed: int = 1,
    **options: Any,
) -> BaseAlgorithm:
    """Return a model whose random weights make it decide differently here and there."""
    learner = getattr(stable_baselines3, algorithm, None) or getattr(sb3_contrib, algorithm)
    environment = Nowhere(spec, space or action_space(ActionSpec.model_validate({"set": actions})))
    if "buffer_size" in inspect.signature(learner.__init__).parameters:
        options.setdefault("buffer_size", 10)
    policy_kwargs = {"features_extractor_class": Eye, "net_arch": [16, 16]}
    policy_kwargs |= options.pop("policy_kwargs", {})
    model: BaseAlgorithm = learner(
        "MultiInputLstmPolicy" if algorithm == "RecurrentPPO" else "MultiInputPolicy",
        environment,
        policy_kwargs=policy_kwargs,
        seed=seed,
        device="cpu",
        **options,
    )
    rng = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for weights in model.policy.parameters():
            inputs = max(1, weights[0].numel())
            weights.copy_(1.5 / inputs**0.5 * torch.randn(weights.shape, generator=rng))
            if weights.dim() == 1:
                weights.mul_(0.1)
    return model


def facts(**changes: Any) -> PolicyFacts:
    known: dict[str, Any] = {
        "name": "tiny",
        "description": "random weights",
        "observation": SPEC,
        "actions": ActionSpec(),
        "hold_s": 0.4,
        "goal_radius_m": 2.5,
        "altitude_m": 2.0,
        "algorithm": "DQN",
    }
    return PolicyFacts(**(known | changes))


def export_tiny(
    folder: Path, algorithm: str = "DQN", actions: str = "arc-25", **changes: Any
) -> PolicyCard:
    """Export a model of the kit; changes go to the card's facts."""
    with_torch = changes.pop("with_torch", False)
    spec = changes.get("observation", SPEC)
    action_spec = ActionSpec.model_validate({"set": actions})
    model = make_model(algorithm, actions, spec=spec)
    told = facts(**({"actions": action_spec} | changes))
    return export_sb3(model, told, folder, with_torch=with_torch)


def noise(n: int, seed: int = 5, spec: ObservationSpec = SPEC) -> Encoded:
    """Return n random observations in a layout."""
    rng = np.random.default_rng(seed)
    # Bright and dark ones: white noise alone would look the same to convolutions.
    depth = rng.random((n, *boxes(spec)["depth"].shape)) * rng.random((n, 1, 1, 1)) * 256.0
    return {
        "depth": depth.astype(np.uint8),
        "velocity": rng.normal(size=(n, 3)).astype(np.float32),
        "goal": rng.normal(size=(n, 3)).astype(np.float32),
    }
