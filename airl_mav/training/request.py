"""Options of a training: a configuration, and changes to it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from pydantic import BaseModel, Field

from airl_mav.core.errors import FieldError, UsageError
from airl_mav.core.fields import optional, switch
from airl_mav.core.progress import Event, Progress
from airl_mav.profiles.loading import load_profile
from airl_mav.training.training_folder import Evaluation, TrainingProgress

if TYPE_CHECKING:
    from airl_mav.training.config import TrainingConfig


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
        # Imported here, as it needs optional packages, which are checked first.
        from airl_mav.training.config import TrainingConfig, check_fields, configured

        loaded = load_profile("training", self.config, TrainingConfig)
        try:
            check_fields(loaded.algorithm)
        except FieldError as error:  # The error is in the file, not in an option.
            raise UsageError(f"{self.config}: {error.line(sign=' = ')}") from None
        # Without options that are not part of the configuration.
        asked = TrainRequest.model_fields.keys() - {"config", "out", "name", "resume"}
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


class TrainingBar(TrainingProgress):
    """A bar with the success rate, a line for every evaluation. A `TrainingProgress`."""

    def __init__(self, progress: Progress, steps: int) -> None:
        self._progress = progress
        self._bar = progress.bar("training", steps, unit="decisions")

    def waiting(self, why: str) -> None:
        """Print a line."""
        self._progress.note(why)

    def trained(self, steps: int, success: float | None, zone: int | None) -> None:
        """Draw the bar."""
        text = "" if success is None else f"success {success:.0%} in training"
        text += "" if zone is None else f", zone {zone}"
        figures = {"training_success": success, "zone": zone}
        self._bar.update(completed=steps, postfix=text, figures=figures)

    def evaluated(self, evaluation: Evaluation, *, best: bool) -> None:
        """Print a line, and report the evaluation to programs."""
        self._progress.tell(
            Evaluated(
                steps=evaluation.steps,
                episodes=evaluation.episodes,
                success_rate=evaluation.success_rate,
                collision_rate=evaluation.collision_rate,
                flight_time_s=evaluation.flight_time_s,
                zone=evaluation.zone,
                best=best,
            )
        )
        time = "" if evaluation.flight_time_s is None else f"{evaluation.flight_time_s:6.2f} s"
        zone = "" if evaluation.zone is None else f"  zone {evaluation.zone}"
        zone += _of_training(evaluation)
        self._progress.note(
            f"{evaluation.steps:>11,} decisions {evaluation.seconds:7.0f} s  success "
            f"{evaluation.success_rate:6.1%}  {time}{zone}{'  best so far' if best else ''}"
        )


def _of_training(evaluation: Evaluation) -> str:
    """Return the training success if random actions make it differ from the evaluation."""
    success = evaluation.training_success
    if success is None or success - evaluation.success_rate < FLOWN_BY_CHANCE:
        return ""
    return f"  ({success:.1%} with training's random actions)"
