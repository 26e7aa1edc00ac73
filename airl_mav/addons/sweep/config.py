"""Sweep configuration as a TOML file: networks, arenas, training and evaluation."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, model_validator

from airl_mav.core.fields import Each, ProfileModel, quantity
from airl_mav.profiles.loading import load_profile
from airl_mav.training.config import SELECTION_SEED, TrainingConfig

GREATEST_LAYERS, GREATEST_FILTERS = 16, 256
"""Limits of a template in `training.config.NetworkSpec`."""


class Grid(ProfileModel):
    """Cells of one arena: every number of layers with every number of filters."""

    arena: str = Field(description="arena profile: a shipped name, or a path to a .toml")
    layers: Annotated[tuple[int, ...], Each(1, GREATEST_LAYERS, ascending=True)] = quantity(
        "convolutions, and dense layers, of the template", "1"
    )
    filters: Annotated[tuple[int, ...], Each(1, GREATEST_FILTERS, ascending=True)] = quantity(
        "filters a convolution, and units a dense layer", "1"
    )

    @property
    def name(self) -> str:
        """Name of the arena in folder names."""
        return Path(self.arena).stem

    @model_validator(mode="after")
    def _each_once(self) -> Grid:
        for field in ("layers", "filters"):
            if len(set(values := getattr(self, field))) < len(values):
                raise ValueError(f"{field} = {list(values)}: accepted: each number once")
        return self


class Examination(ProfileModel):
    """Evaluation flights of a trained network, in the whole arena of its training."""

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
    """Configuration of an architecture search."""

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
        """Add a default description to the training: each trial replaces it."""
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
    """Load a sweep, built-in or by path. Raises UsageError; see `load_profile`."""
    return load_profile("sweeps", name, SweepConfig)
