"""The folder of a training run: what is in it, and how it is written.

train.json          the configuration and what it was made with
evaluations.jsonl   one line an evaluation on the selection seeds
tensorboard/        curves
checkpoints/        everything needed to go on
best/               the best weights so far, and which they are
policy/             the result: policy.onnx and card.json
"""

from __future__ import annotations

import fcntl
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from airl_mav.core.clock import utc_now
from airl_mav.core.errors import UsageError
from airl_mav.core.files import (
    append_lines,
    json_line,
    read_json,
    read_lines,
    read_typed,
    replace_file,
    typed,
    write_json,
)
from airl_mav.core.provenance import describe_machine, git_state, package_versions
from airl_mav.training.config import TrainingConfig

SCHEMA = 1
CONFIG_FILE = "train.json"
EVALUATIONS_FILE = "evaluations.jsonl"
LOCK_FILE = ".lock"
"""Locked while a process trains; the system unlocks it however the process ends."""
BEST_FILE = "best.json"
BEST_MODEL = "model.zip"


@dataclass(frozen=True)
class Evaluation:
    """One evaluation on the selection seeds, and the state of the training."""

    steps: int
    """Decisions of all vehicles so far."""
    seconds: float
    """Wall time of the training so far, evaluations left out [s]."""
    episodes: int
    success_rate: float
    collision_rate: float
    flight_time_s: float | None
    """Mean of the successful ones; None when there is none."""
    distance_m: float | None
    training_success: float | None
    """Of the last episodes in training, exploration included."""
    zone: int | None
    """Curriculum zone that is open; None without a curriculum."""

    @property
    def rank(self) -> tuple[float, float]:
        """Better is greater: success rate first, then flight time."""
        return self.success_rate, -(self.flight_time_s or 1e9)


_EVALUATION = TypeAdapter(Evaluation)


class TrainingProgress:
    """Receives the progress of a training run; by itself it ignores it."""

    def trained(self, steps: int, success: float | None, zone: int | None) -> None:
        """Called after each step of all vehicles.

        Args:
            steps: Decisions of all vehicles so far.
            success: Share of the last recent episodes that reached the goal; None before one.
            zone: Open curriculum zone; None without a curriculum.
        """

    def evaluated(self, evaluation: Evaluation, *, best: bool) -> None:
        """Called after an evaluation; `best`: better than all before it."""

    def checkpointed(self, steps: int) -> None:
        """Called when a checkpoint is on the disk."""


class TrainingFolder:
    """A training run on disk; it can be read and resumed after a kill at any moment."""

    def __init__(self, path: Path) -> None:
        """Wrap a folder; use `begin`, `create` or `open`."""
        self.path = path

    @classmethod
    def begin(
        cls, path: Path, config: TrainingConfig, command: str, *, resume: bool
    ) -> TrainingFolder:
        """Open the folder to resume its run, if it holds one, or create it. Raises UsageError."""
        if resume and (path / CONFIG_FILE).exists():
            return cls.open(path, config)
        return cls.create(path, config, command)

    @classmethod
    def create(cls, path: Path, config: TrainingConfig, command: str) -> TrainingFolder:
        """Make the folder. Raises UsageError when it already holds a run."""
        if (path / CONFIG_FILE).exists():
            raise UsageError(
                f"{path}: holds a training run already; accepted: another folder, or resume"
            )
        try:
            path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UsageError(f"{path}: {error.strerror}") from None
        about = {
            "schema": SCHEMA,
            "created_utc": utc_now().isoformat(timespec="seconds"),
            "command": command,
            "config": config.model_dump(mode="json", exclude_none=True),
            "versions": package_versions(),
            "machine": describe_machine(),
            "git": git_state(),
        }
        write_json(path / CONFIG_FILE, about)
        return cls(path)

    @classmethod
    def open(cls, path: Path, config: TrainingConfig) -> TrainingFolder:
        """Open a run. Raises UsageError if there is none, or it has another configuration."""
        folder = cls(path)
        theirs = TrainingConfig.model_validate(folder.about()["config"])
        if theirs != config:
            changed = [
                name
                for name in TrainingConfig.model_fields
                if getattr(theirs, name) != getattr(config, name)
            ]
            raise UsageError(
                f"{path}: the run to resume has another configuration "
                f"({', '.join(changed)}); accepted: the same"
            )
        return folder

    def about(self) -> dict[str, Any]:
        """Return what `train.json` holds. Raises UsageError when there is no run."""
        return read_json(self.path / CONFIG_FILE, SCHEMA, "training run")

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Lock the folder. Raises UsageError if another process trains in it."""
        with (self.path / LOCK_FILE).open("wb") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                raise UsageError(f"{self.path}: another process trains here") from None
            yield

    @property
    def checkpoints(self) -> Path:
        """Where checkpoints lie."""
        return self.path / "checkpoints"

    @property
    def tensorboard(self) -> Path:
        """Where TensorBoard looks."""
        return self.path / "tensorboard"

    @property
    def best_model(self) -> Path:
        """The best weights so far, as stable-baselines3 saves them."""
        return self.path / "best" / BEST_MODEL

    @property
    def policy(self) -> Path:
        """The exported result."""
        return self.path / "policy"

    def evaluations(self) -> list[Evaluation]:
        """Return the evaluations so far; a line cut short by a kill is passed over."""
        lines = read_lines(self.path / EVALUATIONS_FILE, None)
        return [typed(_EVALUATION, data, place) for place, data in lines]

    def add_evaluation(self, evaluation: Evaluation) -> None:
        """Append a line; on return it is on the disk."""
        append_lines(self.path / EVALUATIONS_FILE, [asdict(evaluation)])

    def forget_after(self, steps: int) -> None:
        """Drop evaluations later than a checkpoint: going on from it will make them again."""
        kept = [each for each in self.evaluations() if each.steps <= steps]
        replace_file(
            self.path / EVALUATIONS_FILE, b"".join(json_line(asdict(each)) for each in kept)
        )

    def best(self) -> Evaluation | None:
        """Return the evaluation of the best weights; None before the first."""
        file = self.path / "best" / BEST_FILE
        if not file.exists() or not self.best_model.exists():
            return None
        return read_typed(file, _EVALUATION, None, "training run")

    def save_best(self, model: bytes, evaluation: Evaluation) -> None:
        """Save the best weights, then their evaluation."""
        self.best_model.parent.mkdir(exist_ok=True)
        replace_file(self.best_model, model)
        write_json(self.best_model.parent / BEST_FILE, asdict(evaluation))
