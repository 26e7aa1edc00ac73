"""The folder of a sweep: what is in it, and how it is written.

sweep.json              the sweep, what it was made with, every result and cell so far
sweep.md, .html, .png   the same for people
trials/<trial>/         a training folder (`training.store`), and of the sweep:
    progress.json       how far the training is, while it runs
    result.json         what came out: its being there is what ends a trial

A trial is carried out by whoever gets it, in whatever process, on whatever machine sees the
folder, and goes on where the last one was cut off.
"""

from __future__ import annotations

import fcntl
import json
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from airl_mav.core.clock import utc_now
from airl_mav.core.errors import UsageError
from airl_mav.core.files import read_json
from airl_mav.core.provenance import describe_machine, git_state, package_versions
from airl_mav.sweep.config import SweepConfig
from airl_mav.sweep.result import TrialResult, read_result, write_result
from airl_mav.sweep.trial import Trial

SCHEMA = 1
"""Version of `sweep.json`; docs/sweep.md describes it."""

SWEEP_FILE = "sweep.json"
RESULT_FILE = "result.json"
PROGRESS_FILE = "progress.json"
LOCK_FILE = ".lock"
TRIALS = "trials"

MAY_CHANGE = ("description", "grids", "seeds")
"""Fields with which a sweep can go on changed: they add trials, or leave some for later."""


@dataclass(frozen=True)
class Progress:
    """How far a training is."""

    steps: int
    """Decisions of all vehicles so far."""
    success: float | None
    """Success rate at its last evaluation, 0 to 1."""


@dataclass(frozen=True)
class SweepFolder:
    """A sweep on disk. Goes to other processes by pickle."""

    path: Path
    config: SweepConfig

    @classmethod
    def at(cls, path: Path, config: SweepConfig) -> SweepFolder:
        """Return the folder of a sweep, old or new.

        Raises:
            UsageError: It cannot be made, or holds a sweep with other trainings or flights.
        """
        try:
            (path / TRIALS).mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UsageError(f"--out {path}: {error.strerror}") from None
        if (path / SWEEP_FILE).exists():
            theirs = config_of(read_data(path))
            changed = [
                name
                for name in SweepConfig.model_fields
                if name not in MAY_CHANGE and getattr(theirs, name) != getattr(config, name)
            ]
            if changed:
                raise UsageError(
                    f"--out {path}: holds a sweep with another {' and '.join(changed)}; "
                    "accepted: the same, or another folder"
                )
        return cls(path, config)

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Keep the folder to this command. Raises UsageError when another one is at it."""
        with (self.path / LOCK_FILE).open("wb") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                raise UsageError(f"--out {self.path}: another sweep is at work here") from None
            yield

    def made(self, command: str) -> dict[str, Any]:
        """Return what the sweep was made with: as it was begun, or as of now.

        Args:
            command: The words of the command line.
        """
        if (self.path / SWEEP_FILE).exists():
            made: dict[str, Any] = read_data(self.path)["made"]
            return made
        return {
            "created_utc": utc_now().isoformat(timespec="seconds"),
            "command": command,
            "versions": package_versions(),
            "machine": describe_machine(),
            "git": git_state(),
        }

    def trial_path(self, trial: Trial) -> Path:
        """Return the folder of a trial."""
        return self.path / TRIALS / trial.name

    @property
    def evaluation(self) -> dict[str, Any]:
        """On which flights results rest."""
        return self.config.evaluation.model_dump(mode="json")

    def result(self, trial: Trial) -> TrialResult | None:
        """Return what a trial came to; None while it has not ended. Raises UsageError."""
        return read_result(self.trial_path(trial) / RESULT_FILE, trial, self.evaluation)

    def results(self, wanted: Sequence[Trial]) -> list[TrialResult]:
        """Return the results that are there, in the order of the trials. Raises UsageError."""
        return [found for trial in wanted if (found := self.result(trial)) is not None]

    def finish(self, result: TrialResult, checkpoints: Path) -> None:
        """End a trial; what was only there to go on with is removed."""
        write_result(self.trial_path(result.trial) / RESULT_FILE, result, self.evaluation)
        shutil.rmtree(checkpoints, ignore_errors=True)
        (self.trial_path(result.trial) / PROGRESS_FILE).unlink(missing_ok=True)

    def note_progress(self, trial: Trial, progress: Progress) -> None:
        """Say how far a trial is, to whoever looks on. Lost by a power cut, and no loss."""
        path = self.trial_path(trial) / PROGRESS_FILE
        partial = path.with_name(path.name + ".partial")
        data = {"steps": progress.steps, "success": progress.success}
        partial.write_text(json.dumps(data), encoding="utf-8")
        partial.replace(path)

    def progress(self, trial: Trial) -> Progress | None:
        """Return how far a trial is; None when it has not begun, or has ended."""
        with suppress(OSError, ValueError, KeyError, TypeError):
            data = json.loads((self.trial_path(trial) / PROGRESS_FILE).read_bytes())
            return Progress(int(data["steps"]), data["success"])
        return None


def as_data(config: SweepConfig) -> dict[str, Any]:
    """Return a sweep with all its defaults as JSON values; it can be read back."""
    data = config.model_dump(mode="json", exclude_none=True)
    for field in ("network", "seed"):
        del data["training"][field]
    del data["training"]["environment"]["arena"]
    return data


def read_data(path: Path) -> dict[str, Any]:
    """Return what `sweep.json` in a folder holds. Raises UsageError."""
    return read_json(path / SWEEP_FILE, SCHEMA, "sweep")


def config_of(data: dict[str, Any]) -> SweepConfig:
    """Return the sweep that `sweep.json` holds. Raises UsageError."""
    try:
        return SweepConfig.model_validate(data["config"])
    except (KeyError, ValidationError) as error:
        raise UsageError(f"{SWEEP_FILE}: config: {str(error).splitlines()[0]}") from None
