"""Checkpoints: the complete state for an exact resume of a training run.

A checkpoint is a folder, written under another name, synced and renamed. The file `latest` then
names it, so that a complete one always exists. Save only between two rollouts (stable-baselines3's
`on_rollout_start`). During a rollout, part of the state is in local variables. Nothing is
unpickled.
"""

from __future__ import annotations

import io
import json
import pickle
import random
import shutil
import warnings
import zipfile
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from operator import attrgetter
from pathlib import Path
from typing import Any, Protocol, cast

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import DictReplayBuffer
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from airl_mav.core import files
from airl_mav.core.errors import UsageError

COUNTERS = (
    "num_timesteps",
    "_total_timesteps",
    "_num_timesteps_at_start",
    "_episode_num",
    "_n_updates",
    "_n_calls",
    "_current_progress_remaining",
    "exploration_rate",
)
"""Plain numbers of a learner; each learner has some of them."""

NOISE = ("exploration_mat", "exploration_matrices")
"""Noise that gSDE draws for a rollout before stable-baselines3 calls `on_rollout_start`."""


class Restorable(Protocol):
    """A VecEnv whose state can be saved and restored."""

    def get_state(self) -> Mapping[str, NDArray[Any]]:
        """Return the complete state by name."""

    def set_state(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Restore the state from `get_state`."""


def collect(model: BaseAlgorithm) -> tuple[dict[str, Any], files.Arrays, dict[str, Any]]:
    """Return the state of a learner and its environment: weights, arrays, the rest."""
    weights: dict[str, Any] = {
        "states": model.get_parameters(),
        "variables": {n: attrgetter(n)(model).detach() for n in _variables(model)},
        "rng": {"cpu": torch.get_rng_state()},
    }
    if memory := _memory(model):
        weights["memory"] = memory
    if model.use_sde:
        noise = _explorer(model).action_dist
        weights["noise"] = {name: getattr(noise, name) for name in NOISE}
    if model.device.type == "cuda":
        weights["rng"]["cuda"] = torch.cuda.get_rng_state(model.device)
    last = cast("Mapping[str, NDArray[Any]]", model._last_obs)
    arrays = {f"last_obs/{key}": array for key, array in last.items()}
    arrays["last_episode_starts"] = np.asarray(model._last_episode_starts)
    arrays |= {f"env/{key}": array for key, array in _env(model).get_state().items()}
    arrays |= {f"replay/{key}": array for key, array in _get_replay(model).items()}
    state = {
        "counters": {name: getattr(model, name) for name in COUNTERS if hasattr(model, name)},
        "episodes": list(model.ep_info_buffer or ()),
        "successes": list(model.ep_success_buffer or ()),
        "random": {
            "python": random.getstate(),
            # stable-baselines3 shuffles and explores with the global generator.
            "numpy": np.random.get_state(legacy=False),  # noqa: NPY002
            "generators": [each.bit_generator.state for each in _generators(model)],
        },
    }
    return weights, arrays, state


def restore(
    model: BaseAlgorithm, weights: dict[str, Any], arrays: files.Arrays, state: dict[str, Any]
) -> None:
    """Restore the state from `collect`; KeyError, RuntimeError or ValueError if it does not fit."""
    model.set_parameters(weights["states"], exact_match=True, device=model.device)
    for name in _variables(model):
        attrgetter(name)(model).data.copy_(weights["variables"][name])
    for ours, saved in zip(_memory(model), weights.get("memory", []), strict=True):
        if ours.shape != saved.shape:
            raise ValueError(f"memory of shape {tuple(saved.shape)}, not {tuple(ours.shape)}")
        ours.copy_(saved)
    if model.use_sde:
        _restore_noise(model, weights["noise"])
    starts = arrays["last_episode_starts"]
    if starts.shape != (model.n_envs,):
        raise ValueError(f"{len(starts)} vehicles, not {model.n_envs}")
    model._last_obs = _below("last_obs/", arrays)
    model._last_episode_starts = starts
    _set_replay(model, _below("replay/", arrays))
    _env(model).set_state(_below("env/", arrays))
    for name, value in state["counters"].items():
        setattr(model, name, value)
    window = model._stats_window_size
    model.ep_info_buffer = deque(state["episodes"], maxlen=window)
    model.ep_success_buffer = deque(state["successes"], maxlen=window)
    # Last, as the calls above may have drawn random numbers.
    version, internal, gauss = state["random"]["python"]
    random.setstate((version, tuple(internal), gauss))
    np.random.set_state(state["random"]["numpy"])  # noqa: NPY002
    for generator, saved in zip(_generators(model), state["random"]["generators"], strict=True):
        generator.bit_generator.state = saved
    torch.set_rng_state(weights["rng"]["cpu"])
    if model.device.type == "cuda":
        torch.cuda.set_rng_state(weights["rng"]["cuda"], model.device)


def _variables(model: BaseAlgorithm) -> list[str]:
    return model._get_torch_save_params()[1]


def _memory(model: BaseAlgorithm) -> list[torch.Tensor]:
    """Return the memory of a recurrent learner's networks for the running episodes."""
    states = getattr(model, "_last_lstm_states", None)
    return [] if states is None else [each for pair in states for each in pair]


def _explorer(model: BaseAlgorithm) -> Any:
    """Return the part of a policy that draws gSDE's noise."""
    return getattr(model, "actor", None) or model.policy


def _restore_noise(model: BaseAlgorithm, saved: Mapping[str, torch.Tensor]) -> None:
    """Restore gSDE's noise, and skip the draw at the start of the next rollout."""
    explorer = _explorer(model)
    for name in NOISE:
        setattr(explorer.action_dist, name, saved[name].to(model.device))

    def once(n_envs: int = 1) -> None:  # noqa: ARG001 (the replaced method's signature)
        del explorer.reset_noise

    explorer.reset_noise = once


def _generators(model: BaseAlgorithm) -> list[np.random.Generator]:
    """Return the random generators of a learner, without the global ones."""
    own = getattr(model, "generator", None)
    return [model.action_space.np_random, *([] if own is None else [own])]


def _env(model: BaseAlgorithm) -> Restorable:
    if not hasattr(model.env, "get_state"):
        raise TypeError(f"{type(model.env).__name__} has no get_state/set_state")
    return cast("Restorable", model.env)


def _below(prefix: str, arrays: files.Arrays) -> files.Arrays:
    return {k.removeprefix(prefix): v for k, v in arrays.items() if k.startswith(prefix)}


def _get_replay(model: BaseAlgorithm) -> files.Arrays:
    """Return the filled part of a learner's replay memory by name; empty without replay memory."""
    if (own := getattr(model, "replay", None)) is not None:
        state: files.Arrays = own.get_state()
        return state
    buffer = _stock_buffer(model)
    if buffer is None:
        return {}
    filled = buffer.buffer_size if buffer.full else buffer.pos
    arrays = {name: array[:filled] for name, array in _stock_arrays(buffer).items()}
    return arrays | {"pos": np.array(buffer.pos), "full": np.array(buffer.full)}


def _set_replay(model: BaseAlgorithm, saved: Mapping[str, NDArray[Any]]) -> None:
    """Restore the data of `_get_replay`. Raises ValueError if the size differs."""
    if (own := getattr(model, "replay", None)) is not None:
        own.set_state(saved)
        return
    buffer = _stock_buffer(model)
    if buffer is None:
        return
    for name, array in _stock_arrays(buffer).items():
        array[: len(saved[name])] = saved[name]
    buffer.pos, buffer.full = int(saved["pos"]), bool(saved["full"])


def _stock_buffer(model: BaseAlgorithm) -> DictReplayBuffer | None:
    buffer = model.replay_buffer if isinstance(model, OffPolicyAlgorithm) else None
    return buffer if isinstance(buffer, DictReplayBuffer) else None


def _stock_arrays(buffer: DictReplayBuffer) -> files.Arrays:
    names = ("actions", "rewards", "dones", "timeouts")
    arrays: files.Arrays = {name: getattr(buffer, name) for name in names}
    arrays |= {f"observations/{key}": array for key, array in buffer.observations.items()}
    return arrays | {f"next/{key}": array for key, array in buffer.next_observations.items()}


SCHEMA = 1
KEEP = 2
"""Number of checkpoints kept: the newest and a fallback."""

LATEST = "latest"
PREFIX = "checkpoint-"
PARTIAL = ".partial"
DAMAGED = ".damaged"
_BROKEN = (EOFError, pickle.UnpicklingError, zipfile.BadZipFile)
WEIGHTS, ARRAYS, STATE, MANIFEST = "weights.pt", "arrays.npz", "state.json", "manifest.json"


class DamagedError(Exception):
    """A checkpoint does not match its manifest."""


def save_checkpoint(folder: Path, model: BaseAlgorithm, meta: Mapping[str, Any]) -> Path:
    """Write a checkpoint with JSON data `meta`; return its folder. Keeps the previous one."""
    folder.mkdir(parents=True, exist_ok=True)
    for leftover in folder.glob(f"{PREFIX}*{PARTIAL}"):
        files.remove(leftover)
    there = _all(folder)
    final = folder / f"{PREFIX}{_serial(there[-1]) + 1 if there else 1:06d}"
    partial = final.with_name(final.name + PARTIAL)
    partial.mkdir()
    try:
        _write(partial, model, meta)
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)
        raise
    partial.rename(final)
    files.sync_folder(folder)
    files.replace_file(folder / LATEST, f"{final.name}\n".encode())
    for old in _all(folder)[:-KEEP]:
        # A partly removed folder must not look like a checkpoint.
        files.remove(old.rename(old.with_name(old.name + PARTIAL)))
    return final


def _write(partial: Path, model: BaseAlgorithm, meta: Mapping[str, Any]) -> None:
    """Write the files of a checkpoint and sync them to disk. Raises OSError."""
    weights, arrays, state = collect(model)
    # In memory first: torch reports a full disk as another error.
    buffer = io.BytesIO()
    torch.save(weights, buffer)
    files.replace_file(partial / WEIGHTS, buffer.getvalue())
    files.save_arrays(partial / ARRAYS, arrays)
    text = json.dumps({"learner": state, "meta": meta}, default=_plain)
    files.replace_file(partial / STATE, text.encode())
    digests = {name: files.sha256_of(partial / name) for name in (WEIGHTS, ARRAYS, STATE)}
    files.replace_file(partial / MANIFEST, files.json_line({"schema": SCHEMA, "files": digests}))


def load_latest(
    folder: Path, model: BaseAlgorithm, refused: Callable[[str], None] = warnings.warn
) -> dict[str, Any] | None:
    """Restore a learner and its environment from the newest undamaged checkpoint.

    Continue with `model.learn(total - model.num_timesteps, reset_num_timesteps=False)`. Returns the
    saved `meta`, None without a checkpoint; `refused` receives a line per damaged one. Raises
    UsageError if all are damaged, or of another specification.
    """
    damaged: list[Path] = []
    for path in _candidates(folder):
        try:
            weights, arrays, state = _read(path)
        except DamagedError as error:
            refused(f"{path}: damaged checkpoint, not used: {error}")
            damaged.append(path)
            continue
        try:
            restore(model, weights, arrays, state["learner"])
        except (KeyError, ValueError, RuntimeError) as error:
            reason = str(error).strip().splitlines()
            raise UsageError(
                f"{path}: a checkpoint of another configuration: "
                f"{' '.join(line.strip() for line in reason)[:200]}"
            ) from None
        for old in damaged:
            # Damaged checkpoints do not count towards KEEP.
            aside = old.with_name(old.name + DAMAGED)
            files.remove(aside)
            old.rename(aside)
        meta: dict[str, Any] = state["meta"]
        return meta
    if damaged:
        raise UsageError(f"{folder}: every checkpoint is damaged; train anew in another folder")
    return None


def _read(path: Path) -> tuple[dict[str, Any], files.Arrays, dict[str, Any]]:
    """Read a checkpoint. Raises DamagedError if its files do not match the manifest."""
    try:
        files.subfolder(path.parent, path.name)
        manifest = files.read_json(path / MANIFEST, SCHEMA, "checkpoint")
        for name in (WEIGHTS, ARRAYS, STATE):
            if files.sha256_of(path / name) != manifest["files"][name]:
                raise DamagedError(f"{name} has changed since it was written")
        with np.load(path / ARRAYS, allow_pickle=False) as archive:
            files.check_inflated(archive.zip)
            arrays = dict(archive)
        weights = torch.load(path / WEIGHTS, map_location="cpu", weights_only=True)
        state = files.read_limited(path / STATE, "the state of a training", files.JSON_BYTES)
        return weights, arrays, json.loads(state)
    except UsageError as error:
        raise DamagedError(str(error)) from None
    except OSError as error:
        name = Path(error.filename).name if error.filename else "a file"
        raise DamagedError(f"{name}: {error.strerror}") from None
    except (ValueError, LookupError, TypeError, AttributeError, RecursionError, *_BROKEN):
        raise DamagedError(f"{MANIFEST} does not describe it") from None


def _candidates(folder: Path) -> list[Path]:
    """Return the checkpoints in the order to try them."""
    there = _all(folder)[::-1]
    with suppress(UsageError, UnicodeDecodeError):
        named = folder / files.read_limited(folder / LATEST, "a name", 4096).decode().strip()
        # False sorts first; the others stay newest first.
        there.sort(key=lambda path: path != named)
    return there


def _all(folder: Path) -> list[Path]:
    """Return the checkpoints of a run, oldest first."""
    found = [path for path in folder.glob(f"{PREFIX}*") if path.name[len(PREFIX) :].isdecimal()]
    return sorted(found, key=_serial)


def _serial(path: Path) -> int:
    return int(path.name[len(PREFIX) :])


def _plain(value: Any) -> Any:
    """Return a numpy scalar or array as plain JSON data."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} is no JSON")
