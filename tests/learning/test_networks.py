"""Networks: the paper's parameter counts, shapes, inputs, rejected specifications."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import pytest
import torch
from pydantic import ValidationError
from stable_baselines3.common.preprocessing import preprocess_obs
from torch.nn import functional

from airl_mav.core.errors import UsageError
from airl_mav.training.algorithms import (
    ImageExtractor,
    flat_size,
    make_model,
    to_channels_last,
)
from airl_mav.training.config import AlgorithmSpec, NetworkSpec
from airl_mav.training.dqn import DoubleDQN
from tests.support.policy_kit import parameters_of
from tests.support.toy_fleet import HEIGHT, WIDTH, ToyFleet, observation_space


@pytest.mark.parametrize(
    ("layers", "filters", "parameters"),
    [(5, 32, 40_412_761), (4, 48, 90_904_345), (7, 32, 40_433_369), (8, 64, 161_771_033)],
)
def test_templates_have_the_papers_parameters(layers: int, filters: int, parameters: int) -> None:
    spec = NetworkSpec(kind="template", layers=layers, filters=filters)
    assert parameters_of(spec, 154, 256) == parameters


def test_appendix_network_is_the_one_of_air_learnings_code() -> None:
    spec = NetworkSpec(kind="appendix")
    # Its code fixes the flat size; the parameters by hand: conv, dense on 32,640 + 6, output.
    assert flat_size(spec, 154, 256) == 32_640
    convolutions = (16 + 1) * 32 + (16 * 32 + 1) * 64 + (4 * 64 + 1) * 128 + (128 + 1) * 64
    dense = (32_646 + 1) * 256 + 2 * (256 + 1) * 256 + (256 + 1) * 25
    assert parameters_of(spec, 154, 256) == convolutions + dense


def test_appendix_network_of_a_low_image_starts_with_stride_two() -> None:
    spec, explicit = NetworkSpec(kind="appendix"), (2, 2, 1, 1)
    assert flat_size(spec, 24, 32) == flat_size(
        NetworkSpec(kind="appendix", strides=explicit), 24, 32
    )
    assert flat_size(spec, 48, 64) == flat_size(
        NetworkSpec(kind="appendix", strides=(4, 2, 1, 1)), 48, 64
    )


@pytest.mark.parametrize(("height", "width", "flat"), [(24, 32, 3 * 4 * 32), (48, 64, 6 * 8 * 32)])
def test_small_network(height: int, width: int, flat: int) -> None:
    spec = NetworkSpec()
    assert flat_size(spec, height, width) == flat
    convolutions = (9 + 1) * 16 + (9 * 16 + 1) * 32 + 2 * (9 * 32 + 1) * 32
    dense = (flat + 6 + 1) * 128 + (128 + 1) * 128 + (128 + 1) * 25
    assert parameters_of(spec, height, width) == convolutions + dense


@pytest.mark.parametrize(
    "spec",
    [
        NetworkSpec(),
        NetworkSpec(strides=(1, 2, 1, 1)),
        NetworkSpec(kind="appendix", strides=(1, 1, 1, 1)),
        NetworkSpec(kind="template", layers=3, filters=8),
    ],
)
@pytest.mark.parametrize("name", ["dqn", "ppo"])
def test_policy_is_what_is_counted(spec: NetworkSpec, name: str) -> None:
    model = make_model(AlgorithmSpec(name=name), spec, ToyFleet(4), seed=0)
    modules: list[Any]
    if isinstance(model, DoubleDQN):
        modules = [model.q_net]
    else:
        policy: Any = model.policy
        modules = [policy.features_extractor, policy.mlp_extractor.policy_net, policy.action_net]
    counted = sum(weights.numel() for module in modules for weights in module.parameters())
    assert counted == parameters_of(spec, HEIGHT, WIDTH, outputs=3)


def test_extractor_convolves_the_scaled_image_and_joins_the_vectors() -> None:
    torch.manual_seed(0)
    extractor = ImageExtractor(observation_space(), NetworkSpec())
    rng = np.random.default_rng(0)
    seen = {
        "depth": torch.from_numpy(rng.integers(0, 256, (5, 1, HEIGHT, WIDTH), np.uint8)),
        "velocity": torch.from_numpy(rng.normal(size=(5, 3)).astype(np.float32)),
        "goal": torch.from_numpy(rng.normal(size=(5, 3)).astype(np.float32)),
    }
    features = extractor(preprocess_obs(seen, observation_space()))
    image = seen["depth"].float() / 255.0
    weights = list(extractor.parameters())
    for kernel, bias, stride in zip(weights[::2], weights[1::2], (2, 2, 2, 1), strict=True):
        image = functional.relu(functional.conv2d(image, kernel, bias, stride, padding=1))
    expected = torch.cat([image.flatten(1), seen["velocity"], seen["goal"]], dim=1)
    assert features.shape == (5, extractor.features_dim)
    torch.testing.assert_close(features, expected)


def test_weights_layout_changes_speed_not_values() -> None:
    torch.manual_seed(0)
    plain = ImageExtractor(observation_space(), NetworkSpec())
    other = copy.deepcopy(plain)
    to_channels_last(other)
    seen = {
        "depth": torch.rand(3, 1, HEIGHT, WIDTH),
        "velocity": torch.rand(3, 3),
        "goal": torch.rand(3, 3),
    }
    changed = [p for p in other.parameters() if not p.is_contiguous()]
    assert len(changed) == 3  # All but the first, which has one channel.
    torch.testing.assert_close(other(seen), plain(seen))


def test_too_small_an_image_is_refused() -> None:
    with pytest.raises(UsageError, match="16x8 px is too small"):
        flat_size(NetworkSpec(kind="appendix"), 8, 16)


@pytest.mark.parametrize(
    "fields",
    [
        {"kind": "template", "layers": 3},
        {"kind": "small", "filters": 3},
        {"kind": "template", "layers": 3, "filters": 8, "strides": (1, 1, 1, 1)},
        {"strides": (0, 1, 1, 1)},
        {"strides": (1, 1, 1)},
        {"kind": "template", "layers": 0, "filters": 8},
    ],
)
def test_wrong_specifications_are_refused(fields: dict[str, Any]) -> None:
    with pytest.raises(ValidationError):
        NetworkSpec(**fields)
