"""Folder of a training run: content and file formats.

train.json          configuration and provenance
evaluations.jsonl   one line per evaluation on the selection seeds
tensorboard/        curves
checkpoints/        complete state to resume
best/               best weights so far, and their evaluation
zones/zone-0/       with keep_zones: checkpoint and weights at the end of the zone
policy/             result: policy.onnx and card.json
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from airl_mav.core import files
from airl_mav.core.errors import UsageError
from airl_mav.core.machine import provenance
from airl_mav.training.config import TrainingConfig

SCHEMA = 1
CONFIG_FILE = "train.json"
EVALUATIONS_FILE = "evaluations.jsonl"
BEST_FILE = "best.json"
BEST_MODEL = "model.zip"


@dataclass(frozen=True)
class Evaluation:
    """One evaluation on the selection seeds, and the state of the training."""

    steps: int
    """Decisions of all vehicles so far."""
    seconds: float
    """Wall time of the training so far, without evaluations [s]."""
    episodes: int
    success_rate: float
    collision_rate: float
    flight_time_s: float | None
    """Mean over the successful episodes; None without success."""
    distance_m: float | None
    training_success: float | None
    """Success rate of the last training episodes, including exploration."""
    zone: int | None
    """Open curriculum zone; None without a curriculum."""

    @property
    def rank(self) -> tuple[float, float]:
        """Sort key, higher is better: success rate first, then flight time."""
        return self.success_rate, -(self.flight_time_s or 1e9)


_EVALUATION = TypeAdapter(Evaluation)


class TrainingProgress:
    """Progress callbacks of a training run; the base class does nothing."""

    def waiting(self, why: str) -> None:
        """Called while another process holds the folder's lock."""

    def trained(self, steps: int, success: float | None, zone: int | None) -> None:
        """Called after each step of all vehicles, with their decisions so far.

        `success` is the rate of the newest episodes, None before the first; `zone` is the open
        curriculum zone.
        """

    def evaluated(self, evaluation: Evaluation, *, best: bool) -> None:
        """Called after an evaluation; `best`: better than all previous ones."""


class TrainingFolder:
    """A training run on disk; it can be read and resumed after a kill at any time."""

    def __init__(self, path: Path) -> None:
        """Wrap a folder; `begin` makes or checks the run in it."""
        self.path = path
        self.checkpoints = path / "checkpoints"
        self.tensorboard = path / "tensorboard"
        self.best_model = path / "best" / BEST_MODEL
        """Best weights so far, in stable-baselines3's format."""
        self.zones = path / "zones"
        self.policy = path / "policy"

    @classmethod
    def begin(
        cls, path: Path, config: TrainingConfig, command: str, *, resume: bool
    ) -> TrainingFolder:
        """Start a run in a folder or open its run; UsageError if it cannot be resumed."""
        folder = cls(path)
        if not folder.begun:
            plain = config.model_dump(mode="json", exclude_none=True)
            about = {"schema": SCHEMA, **provenance(command), "config": plain}
            files.write_json(path / CONFIG_FILE, about)
            return folder
        if not resume:
            raise UsageError(
                f"{path}: holds a training run already; accepted: another folder, or resume"
            )
        theirs = TrainingConfig.model_validate(folder.about()["config"])
        if changed := [
            name
            for name in TrainingConfig.model_fields
            if getattr(theirs, name) != getattr(config, name)
        ]:
            raise UsageError(
                f"{path}: the run to resume has another configuration "
                f"({', '.join(changed)}); accepted: the same"
            )
        return folder

    @property
    def begun(self) -> bool:
        """True if the folder contains a run."""
        return (self.path / CONFIG_FILE).exists()

    def about(self) -> dict[str, Any]:
        """Return the content of `train.json`. Raises UsageError without a run."""
        return files.read_json(self.path / CONFIG_FILE, SCHEMA, "training run")

    def evaluations(self) -> list[Evaluation]:
        """Return the evaluations so far; a line truncated by a kill is skipped."""
        lines = files.read_lines(self.path / EVALUATIONS_FILE, None)
        return [files.typed(_EVALUATION, data, place) for place, data in lines]

    def add_evaluation(self, evaluation: Evaluation) -> None:
        """Append a line and sync it to disk."""
        files.append_lines(self.path / EVALUATIONS_FILE, [asdict(evaluation)])

    def forget_after(self, steps: int) -> None:
        """Drop evaluations later than a checkpoint: the resumed run repeats them."""
        kept = [each for each in self.evaluations() if each.steps <= steps]
        files.replace_file(
            self.path / EVALUATIONS_FILE, b"".join(files.json_line(asdict(each)) for each in kept)
        )

    def best(self) -> Evaluation | None:
        """Return the evaluation of the best weights; None before the first."""
        file = self.path / "best" / BEST_FILE
        if not file.exists() or not self.best_model.exists():
            return None
        return files.read_typed(file, _EVALUATION, None, "training run")

    def zone(self, zone: int) -> Path:
        """Return the folder of the files saved for a curriculum zone."""
        return self.zones / f"zone-{zone}"

    def save_best(self, model: bytes, evaluation: Evaluation) -> None:
        """Save the best weights, then their evaluation."""
        self.best_model.parent.mkdir(exist_ok=True)
        files.replace_file(self.best_model, model)
        files.write_json(self.best_model.parent / BEST_FILE, asdict(evaluation))
