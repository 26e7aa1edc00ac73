"""What a training is asked for: a configuration, and what changes in it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from pydantic import BaseModel, Field

from airl_mav.core.errors import FieldError, UsageError
from airl_mav.core.fields import optional, switch
from airl_mav.profiles.loading import load_profile

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
        """Return the configuration with what was given put into it. Raises UsageError."""
        # Imported here: it takes what the extras install, and they are looked for first.
        from airl_mav.training.config import TrainingConfig, check_fields, configured

        loaded = load_profile("training", self.config, TrainingConfig)
        try:
            check_fields(loaded.algorithm)
        except FieldError as error:  # It is the file's, not an option's.
            raise UsageError(f"{self.config}: {error.line(sign=' = ')}") from None
        # Not what a command adds to it.
        asked = TrainRequest.model_fields.keys() - {"config", "out", "name", "resume"}
        changes = self.model_dump(include=asked)
        return configured(loaded, **changes)
