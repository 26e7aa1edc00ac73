"""Export of stable-baselines3 models and torch modules to policy folders."""

from __future__ import annotations

import importlib
import inspect
import zipfile
from collections.abc import Callable, Collection, Sequence
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.preprocessing import preprocess_obs
from stable_baselines3.common.vec_env import VecNormalize
from torch import nn

from airl_mav.core.errors import FieldError, UsageError
from airl_mav.core.plugins import MODELS, load_part
from airl_mav.policy import card, layouts, observation_spec
from airl_mav.policy.actions import (
    BODY_RATES,
    ActionSpec,
    continuous_numbers,
    discrete_actions,
)
from airl_mav.profiles.projections import CHANNELS, KINDS
from airl_mav.training import export_request, onnx_export
from airl_mav.training.onnx_export import RecurrentNetwork

USUAL = ("depth", layouts.VELOCITY, layouts.GOAL)
"""Inputs of most networks."""

CHECKED = 64
"""Number of random observations to compare decisions on."""

_LIBRARIES = ("airl_mav.training.dqn", "stable_baselines3", "sb3_contrib")


class _Network(nn.Module):
    """Adapter from arrays in the order of their keys to SB3's Dict of observations."""

    def __init__(self, inner: nn.Module, keys: Sequence[str]) -> None:
        super().__init__()
        self.inner = inner
        self.keys = tuple(keys)

    def forward(self, *arrays: torch.Tensor) -> torch.Tensor:
        found: torch.Tensor = self.inner(dict(zip(self.keys, arrays, strict=True)))
        return found


class _ByName(nn.Module):
    """Adapter from a Dict of observations to named arguments."""

    def __init__(self, inner: nn.Module, names: Sequence[str]) -> None:
        super().__init__()
        self.inner = inner
        self.names = tuple(names)

    def forward(self, seen: dict[str, torch.Tensor]) -> torch.Tensor:
        found: torch.Tensor = self.inner(*(seen[name] for name in self.names))
        return found


class _MeanOfQuantiles(nn.Module):
    """QR-DQN: the value of an action is the mean of its quantiles."""

    def __init__(self, quantiles: nn.Module) -> None:
        super().__init__()
        self.quantiles = quantiles

    def forward(self, seen: dict[str, torch.Tensor]) -> torch.Tensor:
        found: torch.Tensor = self.quantiles(seen).mean(dim=1)
        return found


class _Actor(nn.Module):
    """The path from observations to actions, without noise and value function."""

    def __init__(self, owner: Any, extractor: nn.Module, *layers: nn.Module) -> None:
        super().__init__()
        self.space, self.scaled = owner.observation_space, owner.normalize_images
        self.extractor = extractor
        self.layers = nn.Sequential(*layers)

    def forward(self, seen: dict[str, torch.Tensor]) -> torch.Tensor:
        # SB3 divides uint8 images by 255 here.
        scaled = preprocess_obs(cast("Any", seen), self.space, normalize_images=self.scaled)
        found: torch.Tensor = self.layers(self.extractor(scaled))
        return found


def network_of(
    model: BaseAlgorithm, keys: Sequence[str] = USUAL, learned: VecNormalize | None = None
) -> nn.Module:
    """Return the actor of an SB3 or sb3-contrib model, for `export_network`.

    `keys` are the keys of the layout's arrays, in order, `learned` is the VecNormalize around the
    environment. Raises UsageError if the policy's class is not supported.
    """
    policy: Any = model.policy
    keys = tuple(keys)

    def normalised(inner: nn.Module) -> nn.Module:
        if learned is None or not export_request.normalised_keys(learned):
            return inner
        return export_request.Normalised(inner, learned)

    def network(inner: nn.Module) -> nn.Module:
        return _Network(normalised(inner), keys)

    if hasattr(policy, "quantile_net"):
        return network(_MeanOfQuantiles(policy.quantile_net))
    if hasattr(policy, "q_net"):
        return network(policy.q_net)
    actor: Any = getattr(policy, "actor", None)
    if hasattr(actor, "latent_pi"):
        # SAC and related: the mode of the squashed Gaussian is the squashed mean.
        return network(
            _Actor(actor, actor.features_extractor, actor.latent_pi, actor.mu, nn.Tanh())
        )
    if actor is not None:
        return network(actor)
    if hasattr(policy, "mlp_extractor"):
        # PPO and related: logits of discrete actions; else the mean, squashed or clipped.
        last: nn.Module = nn.Identity()
        if isinstance(policy.action_space, spaces.Box):
            last = nn.Tanh() if policy.squash_output else nn.Hardtanh(-1.0, 1.0)
        hidden = policy.mlp_extractor.policy_net
        extractor = policy.pi_features_extractor
        if hasattr(policy, "lstm_actor"):
            head = nn.Sequential(hidden, policy.action_net, last)
            parts = (normalised(_Actor(policy, extractor)), policy.lstm_actor, head)
            return RecurrentNetwork(*parts, keys)
        return network(_Actor(policy, extractor, hidden, policy.action_net, last))
    raise UsageError(f"{type(model).__name__}: its {type(policy).__name__} cannot be exported")


def _further_keys(seen: spaces.Space[Any]) -> tuple[str, ...]:
    """Return the keys of the images of additional cameras in an observation space, sorted."""
    parts = seen.spaces if isinstance(seen, spaces.Dict) else {}
    found = (key for key, part in parts.items() if len(part.shape or ()) == 3)
    return tuple(sorted(key for key in found if key not in KINDS))


def check_spaces(
    model: BaseAlgorithm,
    spec: observation_spec.ObservationSpec,
    actions: ActionSpec,
    normalised: Collection[str] = (),
) -> None:
    """Raise UsageError unless a model's spaces match a layout and an action set."""
    seen = model.observation_space
    wanted = {key: (box.shape, box.dtype) for key, box in layouts.boxes(spec).items()}
    accepted = ", ".join(f"{k} {np.dtype(kind)} {shape}" for k, (shape, kind) in wanted.items())
    parts = dict(seen.spaces) if isinstance(seen, spaces.Dict) else {"not a Dict": seen}
    images = {spec.kind, *spec.further_keys.values()}.difference(normalised)
    fits = parts.keys() == wanted.keys() and all(
        isinstance(part, spaces.Box)
        and part.shape == wanted[key][0]
        # SB3 converts all floats to float32.
        and (part.dtype == np.uint8 if key in images else part.dtype.kind == "f")
        for key, part in parts.items()
    )
    if not fits:
        found = ", ".join(f"{key} {part.dtype} {part.shape}" for key, part in parts.items())
        told = f"observation space {found}; accepted with this layout: {accepted}"
        if not spec.cameras and (others := _further_keys(seen)):
            told += f". What camera {', '.join(others)} is of is told by --like CONFIGURATION"
        if any(part.dtype != np.uint8 for key, part in parts.items() if key in images):
            told += ". What a VecNormalize made of them is told by --vec-normalize FILE"
        if not spec.in_flight and layouts.IN_FLIGHT in parts:
            told += f". What {layouts.IN_FLIGHT} tells is told by --like CONFIGURATION"
        raise UsageError(told)
    space, count = model.action_space, discrete_actions(actions)
    if count is not None:
        if not (isinstance(space, spaces.Discrete) and space.n == count and space.start == 0):
            raise UsageError(
                f"action space {space}; accepted with {actions.set!r}: Discrete({count})"
            )
    elif not (
        isinstance(space, spaces.Box)
        and space.shape == (continuous_numbers(actions),)
        and (space.low == -1.0).all()
        and (space.high == 1.0).all()
    ):
        raise UsageError(
            f"action space {space}; accepted with {actions.set!r}: "
            f"Box(-1.0, 1.0, ({continuous_numbers(actions)},), float32)"
        )


def export(asked: export_request.ExportRequest, command: str) -> card.PolicyCard:
    """Export the .zip of an SB3 model, or a torch module, as a policy; return its card.

    A .zip contains pickled Python objects: it requires `trust`. Raises UsageError if the model is
    not trusted, cannot be loaded or exported or does not fit its description, or the folder is not
    writable. In this case no usable policy is written.
    """
    out = asked.out
    if out.exists() and not out.is_dir():
        raise UsageError(f"{out}: not a folder")
    write: Callable[[card.PolicyFacts], card.PolicyCard]
    if asked.own_module:
        facts = asked.facts(command)
        module = load_module(asked.model, asked.weights, tuple(layouts.boxes(facts.observation)))
        write = partial(onnx_export.export_network, module, folder=out, with_torch=asked.with_torch)
    else:
        asked.check_trust()
        learner = load_sb3(Path(asked.model), asked.algorithm or "")
        facts = asked.facts(command, taken_by(learner))
        path = asked.vec_normalize
        learned = None if path is None else export_request.load_normalisation(path)
        write = partial(
            export_sb3, learner, folder=out, with_torch=asked.with_torch, learned=learned
        )
    try:
        return write(facts)
    except UsageError as error:
        raise UsageError(f"{asked.model}: {error}") from error
    except OSError as error:
        raise UsageError(f"{out}: {error.strerror}") from None


def taken_by(model: BaseAlgorithm) -> export_request.ModelProperties:
    """Return the image and action set of a model's spaces."""
    seen, space = model.observation_space, model.action_space
    images = seen.spaces if isinstance(seen, spaces.Dict) else {}
    kind = next((key for key in KINDS if key in images), None)
    shape = None if kind is None else images[kind].shape
    actions: str | None = None
    if isinstance(space, spaces.Box):
        actions = {3: "velocity3d", 4: BODY_RATES}.get(len(space.low), "velocity")
    goal = images.get(layouts.GOAL)
    tells_height = goal is not None and goal.shape == (4,)
    if kind is None or shape is None or len(shape) != 3:
        return export_request.ModelProperties(actions=actions)
    image = f"{shape[2]}x{shape[1]}"
    return export_request.ModelProperties(
        image, shape[0] // CHANNELS[kind], actions, kind, tells_height or None
    )


def load_module(name: str, weights: Path | None, keys: Sequence[str] = USUAL) -> nn.Module:
    """Return a custom module for `export_network`, named as in `core.plugins`.

    `weights` are its `state_dict` from `torch.save`; None = included. Raises UsageError if the
    module cannot be constructed, or the weights do not fit.
    """
    found = load_part(MODELS, name)
    try:
        module = found if isinstance(found, nn.Module) else found()
    except Exception as error:
        problem = f"cannot be made without arguments: {card.first_line(error)}"
        raise FieldError(MODELS.field, name, problem=problem) from error
    if not isinstance(module, nn.Module):
        raise FieldError(MODELS.field, name, MODELS.wanted)
    if weights is not None:
        _load_weights(module, weights)
    taken = [
        each
        for each in inspect.signature(module.forward).parameters.values()
        if each.default is each.empty and each.kind is not each.VAR_KEYWORD
    ]
    # One argument: the Dict of observations, as in a training loop on the environment itself.
    if len(taken) != 1:
        names = [each.name for each in taken]
        if names != list(keys) and sorted(names) == sorted(keys):
            # A custom layout has sorted arrays; the module may name its arguments in any order.
            return _Network(_ByName(module, names), keys)
        return module
    return _Network(module, keys)


def _load_weights(module: nn.Module, path: Path) -> None:
    """Load a module's weights; only tensors are unpickled. Raises FieldError."""
    if not path.is_file():
        raise FieldError("weights", path, problem="no such file")
    try:
        module.load_state_dict(torch.load(path, map_location="cpu", weights_only=True))
    except Exception as error:  # Any type, from a bad archive to another network's weights.
        told = " ".join(str(error).split())
        raise FieldError("weights", path, problem=f"not the module's: {told[:200]}") from None


def export_sb3(
    model: BaseAlgorithm,
    facts: card.PolicyFacts,
    folder: Path,
    *,
    with_torch: bool = False,
    learned: VecNormalize | None = None,
) -> card.PolicyCard:
    """Write a model of SB3 or sb3-contrib as `policy.onnx` with its card, and return the card.

    `learned` is the VecNormalize around its environment, exported with the network. Raises
    UsageError if the model's spaces do not fit the facts, or it cannot be exported.
    """
    check_spaces(model, facts.observation, facts.actions, export_request.normalised_keys(learned))
    network = network_of(model, tuple(layouts.boxes(facts.observation)), learned)
    training = model.policy.training
    model.policy.set_training_mode(False)
    try:
        _check_decisions(model, network, facts, learned)
        return onnx_export.export_network(network, facts, folder, with_torch=with_torch)
    finally:
        model.policy.set_training_mode(training)


def load_sb3(path: Path, algorithm: str) -> BaseAlgorithm:
    """Load a model from a saved .zip of an algorithm's class; UsageError if it is not one.

    The archive contains pickled Python objects: load only archives from trusted sources.
    """
    learner = algorithm_class(algorithm)
    if not path.is_file():
        raise UsageError(f"{path}: no such file")
    if not zipfile.is_zipfile(path):
        raise UsageError(f"{path}: not a .zip of stable-baselines3")
    try:
        # No training: no replay memory for a million steps.
        model: BaseAlgorithm = learner.load(
            path, device="cpu", custom_objects={"buffer_size": 1000, "tensorboard_log": None}
        )
    except Exception as error:  # Unpickling raises arbitrary exceptions.
        raise UsageError(
            f"{path}: not a model of {learner.__name__}: {card.first_line(error)}"
        ) from None
    return model


def algorithm_class(name: str) -> type[BaseAlgorithm]:
    """Return an algorithm's class by its name, ignoring case; UsageError lists the known ones."""
    known: dict[str, type[BaseAlgorithm]] = {}
    for library in _LIBRARIES:
        members = inspect.getmembers(importlib.import_module(library), inspect.isclass)
        known |= {
            key: found
            for key, found in members
            if issubclass(found, BaseAlgorithm) and not inspect.isabstract(found)
        }
    for key, found in known.items():
        if key.lower() == name.lower():
            return found
    raise UsageError(f"algorithm {name!r}: accepted: {', '.join(sorted(known))}")


def _check_decisions(
    model: BaseAlgorithm, network: nn.Module, facts: card.PolicyFacts, learned: VecNormalize | None
) -> None:
    """Raise UsageError unless the network decides as the model's own `predict` does."""
    rng, device = np.random.default_rng(2), model.device
    seen = onnx_export.random_inputs(facts.observation, CHECKED, rng)
    memory = onnx_export.random_memory(onnx_export.memory_of(network), CHECKED, rng)
    # sb3-contrib has the layers first, then the rows.
    state = tuple(array.swapaxes(0, 1) for array in memory.values()) or None
    shown: Any = seen if learned is None else learned.normalize_obs(seen)
    decided, _ = model.policy.predict(shown, state, deterministic=True)
    with torch.no_grad():
        arrays = [*(seen[key] for key in layouts.boxes(facts.observation)), *memory.values()]
        found = network(*(torch.from_numpy(array).to(device) for array in arrays))
        outputs = (found[0] if memory else found).cpu().numpy()
    slack = onnx_export.TOLERANCE * max(1.0, float(np.abs(outputs).max()))
    if discrete_actions(facts.actions) is None:
        same = np.abs(outputs - decided).max() <= slack
    else:
        # Either of two equally good actions may win.
        same = (outputs[np.arange(CHECKED), decided] >= outputs.max(axis=1) - slack).all()
    if not same:
        raise UsageError(
            f"{type(model).__name__}: its {type(model.policy).__name__} decides by more than its "
            "network: it cannot be exported"
        )
