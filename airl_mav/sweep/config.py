"""A sweep as a TOML file: which networks learn in which arenas, how, and how they are judged."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from airl_mav.core.errors import FieldError
from airl_mav.core.fields import Each, ProfileModel, quantity, validated
from airl_mav.experiments.executors import ExecutorSettings
from airl_mav.profiles.arena import ArenaSpec
from airl_mav.profiles.computer import load_computer
from airl_mav.profiles.loading import load_profile
from airl_mav.scenario.model import Workers
from airl_mav.sweep.summary import Computer, estimated_ms
from airl_mav.training.config import SELECTION_SEED, TrainingConfig

GREATEST_LAYERS, GREATEST_FILTERS = 16, 256
"""As of a template in `training.config.NetworkSpec`."""


class Grid(ProfileModel):
    """The cells of one arena: every number of layers with every number of filters."""

    arena: str = Field(description="arena profile: a shipped name, or a path to a .toml")
    layers: Annotated[tuple[int, ...], Each(1, GREATEST_LAYERS, ascending=True)] = quantity(
        "convolutions, and dense layers, of the template", "1"
    )
    filters: Annotated[tuple[int, ...], Each(1, GREATEST_FILTERS, ascending=True)] = quantity(
        "filters a convolution, and units a dense layer", "1"
    )

    @property
    def name(self) -> str:
        """Name of the arena, as folders carry it."""
        return Path(self.arena).stem

    @model_validator(mode="after")
    def _each_once(self) -> Grid:
        for field in ("layers", "filters"):
            if len(set(values := getattr(self, field))) < len(values):
                raise ValueError(f"{field} = {list(values)}: accepted: each number once")
        return self


class Examination(ProfileModel):
    """The flights by which a trained network is judged, in the whole arena of its training."""

    episodes: int = quantity(
        "flights of each trained network, on the same seeds", "1", ge=1, le=100_000, default=100
    )
    seed: int = quantity(
        "seed of the first flight; flight i has seed + i", "1", ge=0, lt=SELECTION_SEED, default=1
    )

    @model_validator(mode="after")
    def _unseen(self) -> Examination:
        if self.seed + self.episodes > SELECTION_SEED:
            raise ValueError(
                f"seed + episodes = {self.seed + self.episodes}: accepted: <= {SELECTION_SEED}, "
                "from where on seeds have chosen the weights"
            )
        return self


class SweepConfig(ProfileModel):
    """An architecture search."""

    description: str = Field(description="one line for people")
    seeds: Annotated[tuple[int, ...], Each(0, 2**31)] = quantity(
        "of the trainings: each cell is trained once with each", "1"
    )
    grids: tuple[Grid, ...] = Field(description="arenas and their cells", min_length=1)
    training: TrainingConfig = Field(
        description="how each network is trained; arena, network and seed are the sweep's"
    )
    evaluation: Examination = Field(
        default_factory=Examination, description="how each trained network is judged"
    )

    @model_validator(mode="before")
    @classmethod
    def _described(cls, data: Any) -> Any:
        """Give the trainings a description: each trial has its own anyway."""
        if isinstance(data, dict) and isinstance(data.get("training"), dict):
            training = {"description": "a trial of a sweep", **data["training"]}
            return {**data, "training": training}
        return data

    @model_validator(mode="after")
    def _fits(self) -> SweepConfig:
        names = [grid.name for grid in self.grids]
        if len(set(names)) < len(names):
            raise ValueError(f"grids: arenas {', '.join(names)}: accepted: each name once")
        if len(set(self.seeds)) < len(self.seeds):
            raise ValueError(f"seeds = {list(self.seeds)}: accepted: each number once")
        for table, field, what in (
            (self.training, "network", "every template of the grids"),
            (self.training, "seed", "each of seeds"),
            (self.training.environment, "arena", "the arena of each grid"),
        ):
            if field in table.model_fields_set:
                where = "training" if table is self.training else "training.environment"
                raise ValueError(f"{where}.{field}: leave it out: the sweep takes {what}")
        return self


def load_sweep(name: str) -> SweepConfig:
    """Load a sweep, shipped or by path. Raises UsageError; see `load_profile`."""
    return load_profile("sweeps", name, SweepConfig)


class SweepRequest(Workers):
    """An architecture search, and how it is carried out. The methods raise UsageError."""

    sweep: str = Field(
        default="quick",
        description="quick (two cores, an hour), full (the paper's grid), paper (the same on the"
        " paper's image, for GPUs), tiny (seconds, shows nothing), or a path to a .toml",
    )
    out: Path | None = Field(
        default=None, description="folder of the sweep; by default runs/sweep-<name>"
    )
    seeds: int | None = quantity(
        "training seeds of each cell, 1 to N; by default the sweep's",
        "1",
        ge=1,
        le=1000,
        default=None,
    )
    steps: int | None = Field(
        default=None, description="decisions of each training; by default the sweep's"
    )
    episodes: int | None = Field(
        default=None,
        description="flights that judge each trained network; by default the sweep's",
    )
    seed: int | None = Field(
        default=None,
        description="seed of the first of these flights; flight i has seed + i, in every cell; by"
        " default the sweep's",
    )
    computer: str | None = Field(
        default=None,
        description="computer profile: each cell then shows its decision latency t2 there,"
        " estimated from multiply-accumulates; may change when a sweep goes on",
    )
    device: Literal["cpu", "cuda"] = Field(
        default="cpu", description="what trains: cpu, one core a trial, or cuda"
    )
    ray_gpus: float | None = quantity(
        "share of a GPU that Ray keeps for each trial; by default 1 with device cuda, else 0",
        "1",
        ge=0,
        le=8,
        default=None,
    )
    dry_run: bool = Field(
        default=False,
        description="say what would be done: trials, parameters, multiply-accumulates, decisions;"
        " nothing is trained or written",
    )

    @property
    def name(self) -> str:
        """Name of the sweep."""
        return Path(self.sweep).stem

    @property
    def path(self) -> Path:
        """Folder of the sweep, absolute."""
        return (self.out or Path("runs") / f"sweep-{self.name}").absolute()

    def config(self) -> SweepConfig:
        """Load the sweep, put the values that were given into it, and check it."""
        data = load_sweep(self.sweep).model_dump(exclude_unset=True)
        if self.seeds is not None:
            data["seeds"] = range(1, self.seeds + 1)
        for table, field, value in (
            ("training", "steps", self.steps),
            ("evaluation", "episodes", self.episodes),
            ("evaluation", "seed", self.seed),
        ):
            if value is not None:
                data.setdefault(table, {})[field] = value
        for grid in data["grids"]:
            load_profile("arenas", grid["arena"], ArenaSpec)
            if grid["arena"].endswith(".toml"):
                # Workers, and other machines, may have another working directory.
                grid["arena"] = f"{Path(grid['arena']).absolute()}"
        return validated(SweepConfig, data)

    def executor_settings(self) -> ExecutorSettings:
        """Return who carries out the trials, and what share of a GPU each takes."""
        gpus = self.ray_gpus
        if gpus is not None and self.executor != "ray":
            raise FieldError("ray_gpus", gpus, "with executor ray")
        data = {name: getattr(self, name) for name in Workers.model_fields}
        default = 1.0 if self.device == "cuda" else 0.0
        return validated(ExecutorSettings, data | {"ray_gpus": default if gpus is None else gpus})

    def for_computer(self) -> Computer | None:
        """Return the computer whose decision latency each cell shows; None: none."""
        if self.computer is None:
            return None
        computer = Computer(self.computer, load_computer(self.computer))
        estimated_ms(computer.profile, 1)  # Raises for a computer without a workload.
        return computer
