"""What a sweep is asked for: which one, what changes in it, and who carries it out."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import Field

from airl_mav.core.errors import FieldError
from airl_mav.core.fields import quantity, validated
from airl_mav.experiments.executors import ExecutorSettings
from airl_mav.profiles.arena import ArenaSpec
from airl_mav.profiles.computer import load_computer
from airl_mav.profiles.loading import load_profile
from airl_mav.scenario.model import Workers
from airl_mav.sweep.config import SweepConfig, load_sweep
from airl_mav.sweep.summary import Computer, estimated_ms


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
