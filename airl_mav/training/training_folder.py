"""Folder of a training run, and the options of a training: a configuration, and changes to it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, ClassVar

from pydantic import BaseModel, Field, TypeAdapter

from airl_mav.core import errors, files, machine
from airl_mav.core.fields import optional, switch
from airl_mav.core.progress import Event, Progress
from airl_mav.profiles.loading import load_profile
from airl_mav.training.config import TrainingConfig, check_fields, configured

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
    reward: float | None = None
    """Mean sum of a built-in reward in an episode, without costs; None in older files."""

    @property
    def rank(self) -> tuple[float, float]:
        """Sort key, higher is better: success rate first, then flight time."""
        return self.success_rate, -(self.flight_time_s or 1e9)


_EVALUATION, _CONFIG = TypeAdapter(Evaluation), TypeAdapter(TrainingConfig)


class TrainingFolder:
    """A training run on disk; it can be read and resumed after a kill at any time."""

    def __init__(self, path: Path) -> None:
        """Wrap a folder; UsageError for a link in it. `begin` makes or checks the run in it."""
        self.path = path
        self.checkpoints = files.subfolder(path, "checkpoints")
        self.tensorboard = files.subfolder(path, "tensorboard")
        self.best_model = files.subfolder(path, "best") / BEST_MODEL
        """Best weights so far, in stable-baselines3's format."""
        self.zones = files.subfolder(path, "zones")
        self.policy = files.subfolder(path, "policy")

    @classmethod
    def begin(
        cls,
        path: Path,
        config: TrainingConfig,
        command: str,
        *,
        resume: bool,
        mixed: bool = False,
        say: Callable[[str], None] = lambda _: None,
    ) -> TrainingFolder:
        """Start a run in a folder or open its run; UsageError if it cannot be resumed.

        `mixed` resumes a run of other code, and adds this code to `resumed_with` in `train.json`.
        """
        folder = cls(path)
        if not folder.begun:
            plain = config.model_dump(mode="json", exclude_none=True)
            about = {"schema": SCHEMA, **machine.provenance(command), "config": plain}
            files.write_json(path / CONFIG_FILE, about)
            return folder
        if not resume:
            raise errors.UsageError(
                f"{path}: holds a training run already; accepted: another folder, or resume"
            )
        theirs = files.typed(_CONFIG, folder.about()["config"], path / CONFIG_FILE)
        if changed := [
            name
            for name in TrainingConfig.model_fields
            if getattr(theirs, name) != getattr(config, name)
        ]:
            raise errors.UsageError(
                f"{path}: the run to resume has another configuration "
                f"({', '.join(changed)}); accepted: the same"
            )
        about = folder.about()
        since = about.get("resumed_with", [])
        machine.check_code(path, about, since, mixed=mixed, say=say)
        if machine.code_now() not in (machine.code_of(about), *since):
            about["resumed_with"] = [*since, machine.code_now()]
            files.write_json(path / CONFIG_FILE, about)
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
        return files.subfolder(self.zones, f"zone-{zone}")

    def save_best(self, model: bytes, evaluation: Evaluation) -> None:
        """Save the best weights, then their evaluation."""
        self.best_model.parent.mkdir(exist_ok=True)
        files.replace_file(self.best_model, model)
        files.write_json(self.best_model.parent / BEST_FILE, asdict(evaluation))


class TrainRequest(BaseModel):
    """A training, and the folder of its run."""

    config: str = Field(
        default="static-obstacles",
        description="training configuration: a shipped name, or a path to a .toml",
    )
    out: Path | None = optional("folder of the run; by default runs/train-<config>")
    seed: int | None = optional(
        "seed of weights, exploration and episodes; by default the configuration's"
    )
    computer: str | None = optional(
        "decide as late as this computer in training: a shipped profile, or a path to a"
        " .toml; takes --workload; by default the configuration's"
    )
    workload: str | None = optional(
        "workload of that computer whose latency t2 is drawn in every decision"
    )
    latency: tuple[str, ...] = Field(
        default=(),
        description="sources of t2 in place of computer and workload, as airl evaluate takes them:"
        " 150ms, lognormal:396ms,20ms, COMPUTER/WORKLOAD, FILE; of several, each episode draws one",
    )
    sensing_distance_m: float | None = optional(
        "scale the actions to the safe velocity: the vehicle, deciding as late as its"
        " longest latency, stops for what its camera sees so many metres off; by default the"
        " configuration's, or not"
    )
    steps: int | None = optional(
        "decisions of all vehicles together; by default the configuration's"
    )
    initial: str | None = optional(
        "begin with the best weights of the training run in this folder; by default"
        " the configuration's, or with fresh ones"
    )
    name: str | None = optional("name of the policy on its card; by default the configuration's")
    resume: bool = switch(
        "continue the run in --out from its newest checkpoint; start it if there is none"
    )
    mixed_code: bool = switch(
        "continue a run that another version of the code began; train.json lists the versions"
    )

    @property
    def stem(self) -> str:
        """Name of the configuration."""
        return Path(self.config).stem

    @property
    def folder(self) -> Path:
        """Folder of the run."""
        return self.out or Path("runs") / f"train-{self.stem}"

    def configured(self) -> TrainingConfig:
        """Return the configuration with the given changes. Raises UsageError."""
        loaded = load_profile("training", self.config, TrainingConfig)
        try:
            check_fields(loaded.algorithm)
        except errors.FieldError as error:  # The error is in the file, not in an option.
            raise errors.UsageError(f"{self.config}: {error.line(sign=' = ')}") from None
        # Without options that are not part of the configuration.
        asked = TrainRequest.model_fields.keys() - {"config", "out", "name", "resume", "mixed_code"}
        changes = self.model_dump(include=asked)
        return configured(loaded, **changes)


FLOWN_BY_CHANCE = 0.2
"""Minimum excess of training success over the evaluation's success that is reported."""


@dataclass(frozen=True)
class Evaluated(Event):
    """The policy was evaluated on the selection episodes."""

    event: ClassVar[str] = "evaluation"
    steps: int
    """Decisions of all vehicles so far."""
    episodes: int
    success_rate: float
    """Share of the selection episodes, 0 to 1."""
    collision_rate: float
    flight_time_s: float | None
    """Mean over the successful episodes; None without success."""
    zone: int | None
    """Open zone of the curriculum; None without a curriculum."""
    best: bool
    """True if better than all previous evaluations."""


@dataclass(frozen=True)
class Exported(Event):
    """The best weights were exported."""

    event: ClassVar[str] = "policy"
    path: str


class TrainingProgress:
    """Progress of a training: a bar with the success rate, and a line for every evaluation."""

    def __init__(self, progress: Progress | None = None, steps: int = 0) -> None:
        """Show a training of `steps` decisions; without `progress` nothing is shown."""
        self._progress = progress or Progress()
        self._bar = self._progress.bar("training", steps, unit="decisions")

    def waiting(self, why: str) -> None:
        """Show why the training waits: another process holds the folder's lock."""
        self._progress.note(why)

    def trained(self, steps: int, success: float | None, zone: int | None) -> None:
        """Show the decisions of all vehicles so far; called after each step.

        `success` is the rate of the newest episodes, None before the first; `zone` is the open
        curriculum zone.
        """
        text = "" if success is None else f"success {success:.0%} in training"
        text += "" if zone is None else f", zone {zone}"
        figures = {"training_success": success, "zone": zone}
        self._bar.update(completed=steps, postfix=text, figures=figures)

    def evaluated(self, evaluation: Evaluation, *, best: bool) -> None:
        """Show an evaluation, and report it to programs; `best`: better than all earlier ones."""
        shared = (each.name for each in fields(Evaluated) if each.name != "best")
        self._progress.tell(Evaluated(**{n: getattr(evaluation, n) for n in shared}, best=best))
        time = "" if evaluation.flight_time_s is None else f"{evaluation.flight_time_s:6.2f} s"
        zone = "" if evaluation.zone is None else f"  zone {evaluation.zone}"
        rate, training = evaluation.success_rate, evaluation.training_success
        if training is not None and training - rate >= FLOWN_BY_CHANCE:
            zone += f"  ({training:.1%} with training's random actions)"
        self._progress.note(
            f"{evaluation.steps:>11,} decisions {evaluation.seconds:7.0f} s  success "
            f"{rate:6.1%}  {time}{zone}{'  best so far' if best else ''}"
        )
