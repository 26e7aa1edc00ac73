"""Construction of learners: built-in double DQN, PPO and other stable-baselines3 algorithms.

Networks follow stable-baselines3. The extractor contains the convolutions and joins their output
with velocity and goal. The dense layers are the policy's `net_arch`, so that every algorithm builds
its own heads on them.
"""

from __future__ import annotations

import importlib
import math
from typing import Any, NamedTuple

import torch
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecEnv
from torch import nn

from airl_mav.core.errors import UsageError
from airl_mav.core.plugins import NETWORKS, load_part
from airl_mav.policy.card import first_line
from airl_mav.policy.layouts import GOAL, IN_FLIGHT, VELOCITY, image_key
from airl_mav.training import config
from airl_mav.training.algorithm_table import Algorithm
from airl_mav.training.config import ALGORITHMS, NetworkSpec

ROLLOUT = 4096
"""Steps of all vehicles in a rollout of `ppo` and `trpo`."""


def make_model(
    algorithm: config.AlgorithmSpec,
    network: config.NetworkSpec,
    vec_env: VecEnv,
    seed: int,
    tensorboard_log: str | None = None,
    device: str = "cpu",
) -> BaseAlgorithm:
    """Build a learner with fresh weights on one torch thread, or raise UsageError."""
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
    """Return the constructor's arguments, including `options`."""
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
    # A TOML list is a tuple in stable-baselines3.
    options = {k: tuple(v) if isinstance(v, list) else v for k, v in spec.options.items()}
    return arguments | options


def _rollout_steps(batch_size: int, vehicles: int) -> int:
    """Return the steps of each vehicle in a rollout that divides into whole batches."""
    multiple = batch_size // math.gcd(batch_size, vehicles)
    return max(ROLLOUT // vehicles // multiple, 1) * multiple


VECTORS = (VELOCITY, GOAL, IN_FLIGHT)
"""Inputs that join the convolutions, in this order and before any others. Layouts may lack some."""

OWN_DENSE = (128, 128)
"""Default units of the dense layers behind a custom extractor."""


class Convolution(NamedTuple):
    """One convolution with square kernel, followed by a ReLU."""

    filters: int
    kernel: int
    stride: int
    padding: int


def convolutions(spec: NetworkSpec, height_px: int) -> list[Convolution]:
    """Return the convolutions of a network for images of a height."""
    if spec.kind == "template":
        assert spec.layers is not None and spec.filters is not None  # noqa: S101 (the validator's)
        return [Convolution(spec.filters, 3, 1, 1)] * spec.layers
    if spec.kind == "small":
        strides = spec.strides or (2, 2, 2, 1)
        return [
            Convolution(filters, 3, stride, 1)
            for filters, stride in zip((16, 32, 32, 32), strides, strict=True)
        ]
    # Air Learning's code has 4, 2, 1, 1 for 154 rows; a low image would vanish after two layers.
    strides = spec.strides or ((4, 2, 1, 1) if height_px >= 48 else (2, 2, 1, 1))
    return [
        Convolution(filters, kernel, stride, 0)
        for filters, kernel, stride in zip((32, 64, 128, 64), (4, 4, 2, 1), strides, strict=True)
    ]


def dense_units(spec: NetworkSpec) -> list[int]:
    """Return the units of each dense layer, without the output."""
    if spec.kind == "template":
        assert spec.layers is not None and spec.filters is not None  # noqa: S101 (the validator's)
        return [spec.filters] * spec.layers
    return [256] * 3 if spec.kind == "appendix" else [128] * 2


def flat_size(spec: NetworkSpec, height_px: int, width_px: int) -> int:
    """Return the convolutions' output size for an image; UsageError if it is too small."""
    height, width, filters = height_px, width_px, 1
    for filters, kernel, stride, padding in convolutions(spec, height_px):  # noqa: B007
        height = (height + 2 * padding - kernel) // stride + 1
        width = (width + 2 * padding - kernel) // stride + 1
        if min(height, width) < 1:
            raise UsageError(
                f"network {spec.kind!r}: an image of {width_px}x{height_px} px is too small "
                "for its convolutions; take smaller strides or a larger image"
            )
    return filters * height * width


class ImageExtractor(BaseFeaturesExtractor):
    """Convolutions over the image, joined with `velocity`, `goal` and others.

    The image is `depth`, `rgb` or `grey` (n, channels, height, width), scaled to 0..1 by
    stable-baselines3. Images of additional cameras have their own, similar convolutions.
    """

    def __init__(self, observation_space: spaces.Dict, spec: NetworkSpec) -> None:
        self.image = image_key(observation_space.spaces)
        shapes = {key: part.shape or () for key, part in observation_space.spaces.items()}
        images = [self.image, *further_images(observation_space)]
        vectors = [key for key in VECTORS if key in shapes]
        vectors += [key for key in shapes if key not in (*images, *VECTORS)]
        numbers = sum(spaces.flatdim(observation_space[key]) for key in vectors)
        numbers += sum(flat_size(spec, *shapes[key][1:]) for key in images)
        super().__init__(observation_space, numbers)
        self.vectors = vectors
        self.convolutions = _convolution_stack(spec, *shapes[self.image][:2])
        self.further = nn.ModuleDict(
            {key: _convolution_stack(spec, *shapes[key][:2]) for key in images[1:]}
        )

    def forward(self, observations: dict[str, torch.Tensor]) -> torch.Tensor:
        """Return the features (n, features_dim)."""
        flat = self.convolutions(observations[self.image])
        others = [stack(observations[key]) for key, stack in self.further.items()]
        # Under autocast the convolutions output bfloat16, the vectors are float32.
        vectors = [observations[key].to(flat.dtype) for key in self.vectors]
        return torch.cat([flat, *others, *vectors], dim=1)


def further_images(observation_space: spaces.Dict) -> list[str]:
    """Return the keys of the images of additional cameras, sorted."""
    main = image_key(observation_space.spaces)
    found = (key for key, part in observation_space.spaces.items() if len(part.shape or ()) == 3)
    return sorted(key for key in found if key != main)


def policy_arguments(spec: NetworkSpec | None = None) -> dict[str, Any]:
    """Return the `policy_kwargs` of a MultiInputPolicy; FieldError for a missing extractor."""
    spec = spec or NetworkSpec()
    extractor: Any = ImageExtractor
    if spec.own:
        extractor = load_part(NETWORKS, spec.kind, _is_extractor)
    return {
        "features_extractor_class": extractor,
        "features_extractor_kwargs": dict(spec.options) if spec.own else {"spec": spec},
        "net_arch": list(spec.dense or OWN_DENSE) if spec.own else dense_units(spec),
        "activation_fn": nn.ReLU,
    }


def _is_extractor(found: Any) -> bool:
    return isinstance(found, type) and issubclass(found, BaseFeaturesExtractor)


def to_channels_last(policy: nn.Module) -> None:
    """Store a finished policy's convolution weights for the CPU's fast kernels; same values."""
    for module in policy.modules():
        if isinstance(module, nn.Conv2d):
            module.to(memory_format=torch.channels_last)  # type: ignore[call-overload]


def _convolution_stack(spec: NetworkSpec, channels: int, height_px: int) -> nn.Sequential:
    layers: list[nn.Module] = []
    for filters, kernel, stride, padding in convolutions(spec, height_px):
        layers += [nn.Conv2d(channels, filters, kernel, stride, padding), nn.ReLU()]
        channels = filters
    return nn.Sequential(*layers, nn.Flatten())
