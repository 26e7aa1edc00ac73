"""Checkpoints: everything that a training run needs to resume exactly.

A checkpoint is a folder. It is written under another name, brought to the disk and renamed; then
the file `latest` names it. Whenever the process dies, a whole one lies there. Save between two
rollouts only (stable-baselines3's `on_rollout_start`): within one, part of the state is in local
variables.

Nothing is unpickled: weights are read with `weights_only`, arrays without objects, the rest is
JSON.
"""

from __future__ import annotations

import json
import pickle
import shutil
import warnings
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm

from airl_mav.core.errors import UsageError
from airl_mav.core.files import (
    Arrays,
    json_line,
    naming,
    read_json,
    replace_file,
    sha256_of,
    sync,
    sync_folder,
)
from airl_mav.training.learner_state import collect, restore

SCHEMA = 1
KEEP = 2
"""Checkpoints that stay: the newest, and one to go back to."""

LATEST = "latest"
PREFIX = "checkpoint-"
PARTIAL = ".partial"
DAMAGED = ".damaged"
WEIGHTS, ARRAYS, STATE, MANIFEST = "weights.pt", "arrays.npz", "state.json", "manifest.json"


class DamagedError(Exception):
    """A checkpoint does not match its manifest."""


def save_checkpoint(folder: Path, model: BaseAlgorithm, meta: Mapping[str, Any]) -> Path:
    """Write a checkpoint; keep the one before it, remove those before that.

    Args:
        folder: The folder of all checkpoints of the run.
        model: The learner, between two rollouts; its environment is `Restorable`.
        meta: What the caller wants back from `load_latest`; JSON.

    Returns:
        The folder of this checkpoint.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for leftover in folder.glob(f"{PREFIX}*{PARTIAL}"):
        shutil.rmtree(leftover)
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
    sync_folder(folder)
    replace_file(folder / LATEST, f"{final.name}\n".encode())
    for old in _all(folder)[:-KEEP]:
        # Half removed, it must not look like a checkpoint.
        old.rename(old.with_name(old.name + PARTIAL))
        shutil.rmtree(old.with_name(old.name + PARTIAL))
    return final


def _write(partial: Path, model: BaseAlgorithm, meta: Mapping[str, Any]) -> None:
    """Write the files of a checkpoint and bring them to the disk. Raises OSError."""
    weights, arrays, state = collect(model)
    keywords: dict[str, Any] = dict(arrays)
    with naming(partial):
        with (partial / WEIGHTS).open("wb") as file:
            torch.save(weights, file)
        with (partial / ARRAYS).open("wb") as file:
            np.savez(file, **keywords)
        (partial / STATE).write_text(json.dumps({"learner": state, "meta": meta}, default=_plain))
        files = {name: sha256_of(partial / name) for name in (WEIGHTS, ARRAYS, STATE)}
        (partial / MANIFEST).write_bytes(json_line({"schema": SCHEMA, "files": files}))
        for path in partial.iterdir():
            sync(path)
    sync_folder(partial)


def load_latest(
    folder: Path, model: BaseAlgorithm, refused: Callable[[str], None] = warnings.warn
) -> dict[str, Any] | None:
    """Restore a learner and its environment from the newest whole checkpoint.

    Continue with `model.learn(total - model.num_timesteps, reset_num_timesteps=False)`.

    Args:
        folder: The folder of all checkpoints of the run.
        model: A learner made from the same specification.
        refused: Called with one line per damaged checkpoint that is skipped.

    Returns:
        The caller's `meta`; None when there is no checkpoint yet.

    Raises:
        UsageError: All are damaged, or they are of another specification.
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
            # Out of the count of those that stay.
            aside = old.with_name(old.name + DAMAGED)
            shutil.rmtree(aside, ignore_errors=True)
            old.rename(aside)
        meta: dict[str, Any] = state["meta"]
        return meta
    if damaged:
        raise UsageError(f"{folder}: every checkpoint is damaged; train anew in another folder")
    return None


def _read(path: Path) -> tuple[dict[str, Any], Arrays, dict[str, Any]]:
    """Read a checkpoint. Raises DamagedError when it is not what was written."""
    try:
        manifest = read_json(path / MANIFEST, SCHEMA, "checkpoint")
        for name in (WEIGHTS, ARRAYS, STATE):
            if sha256_of(path / name) != manifest["files"][name]:
                raise DamagedError(f"{name} has changed since it was written")
        with np.load(path / ARRAYS, allow_pickle=False) as archive:
            arrays = dict(archive)
        weights = torch.load(path / WEIGHTS, map_location="cpu", weights_only=True)
        return weights, arrays, json.loads((path / STATE).read_text())
    except UsageError as error:
        raise DamagedError(str(error)) from None
    except OSError as error:
        name = Path(error.filename).name if error.filename else "a file"
        raise DamagedError(f"{name}: {error.strerror}") from None
    except (ValueError, KeyError, TypeError, AttributeError, pickle.UnpicklingError):
        raise DamagedError(f"{MANIFEST} does not describe it") from None


def _candidates(folder: Path) -> list[Path]:
    """Return the checkpoints in the order to try them."""
    there = _all(folder)[::-1]
    with suppress(OSError, UnicodeDecodeError):
        named = folder / (folder / LATEST).read_text().strip()
        # False sorts first; the others stay newest first.
        there.sort(key=lambda path: path != named)
    return there


def _all(folder: Path) -> list[Path]:
    """Return the checkpoints of a run, oldest first."""
    found = [path for path in folder.glob(f"{PREFIX}*") if path.name[len(PREFIX) :].isdigit()]
    return sorted(found, key=_serial)


def _serial(path: Path) -> int:
    return int(path.name[len(PREFIX) :])


def _plain(value: Any) -> Any:
    """Return a numpy scalar or array as JSON has it."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} is no JSON")
