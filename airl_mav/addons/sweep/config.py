"""Sweep configuration as a TOML file, and the trials that it lists."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, model_validator

from airl_mav.core import errors, fields, machine
from airl_mav.envs.evaluation import OUTCOMES, EpisodeResult, mean_of_successes
from airl_mav.flight.judge import Outcome
from airl_mav.policy import card, card_writing
from airl_mav.profiles import loading, projections, vehicle
from airl_mav.training.config import SELECTION_SEED, NetworkSpec, TrainingConfig, check_seeds

GREATEST_LAYERS, GREATEST_FILTERS = 16, 256
"""Limits of a template in `training.config.NetworkSpec`."""


class Grid(fields.ProfileModel):
    """Cells of one arena: every number of layers with every number of filters."""

    arena: str = Field(description="arena profile: a shipped name, or a path to a .toml")
    layers: Annotated[tuple[int, ...], fields.Each(1, GREATEST_LAYERS, ascending=True)] = (
        fields.quantity("convolutions, and dense layers, of the template", "1")
    )
    filters: Annotated[tuple[int, ...], fields.Each(1, GREATEST_FILTERS, ascending=True)] = (
        fields.quantity("filters a convolution, and units a dense layer", "1")
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


class Examination(fields.ProfileModel):
    """Evaluation flights of a trained network, in the whole arena of its training."""

    episodes: int = fields.quantity(
        "flights of each trained network, on the same seeds", "1", ge=1, le=100_000, default=100
    )
    seed: int = fields.quantity(
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


class SweepConfig(fields.ProfileModel):
    """Configuration of an architecture search."""

    description: str = Field(description="one line for people")
    seeds: Annotated[tuple[int, ...], fields.Each(0, 2**31)] = fields.quantity(
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
        check_seeds(max(self.seeds), field="seeds")
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
    return loading.load_profile("sweeps", name, SweepConfig)


@dataclass(frozen=True, order=True)
class Trial:
    """Network, arena and seed of a training."""

    arena: str
    """Arena profile, as named in the sweep."""
    layers: int
    filters: int
    seed: int
    """Seed of weights, exploration and episodes."""

    @property
    def arena_name(self) -> str:
        """Name of the arena in folder names."""
        return Path(self.arena).stem

    @property
    def network(self) -> str:
        """Short name of the template: layers x filters."""
        return f"{self.layers}x{self.filters}"

    @property
    def name(self) -> str:
        """Name of its folder, unique in a sweep."""
        return f"{self.arena_name}-{self.network}-seed{self.seed}"

    @property
    def title(self) -> str:
        """Title in one line."""
        return f"template {self.network} in {self.arena_name}, seed {self.seed}"


def trials(config: SweepConfig) -> list[Trial]:
    """Return all trials by seed, then cell, so that early results cover every cell."""
    return [
        Trial(grid.arena, layers, filters, seed)
        for seed in config.seeds
        for grid in config.grids
        for layers, filters in product(grid.layers, grid.filters)
    ]


def training_of(config: SweepConfig, trial: Trial) -> TrainingConfig:
    """Return the training configuration of a trial."""
    base = config.training
    network = NetworkSpec(kind="template", layers=trial.layers, filters=trial.filters)
    return base.model_copy(
        update={
            "description": trial.title,
            "seed": trial.seed,
            "environment": base.environment.model_copy(update={"arena": trial.arena}),
            "network": network,
        }
    )


def size_of(config: SweepConfig, trial: Trial) -> card_writing.NetworkSize:
    """Return the size of a trial's network, as it flies."""
    environment = config.training.environment
    if environment.cameras:
        names = ", ".join(environment.cameras)
        raise errors.FieldError("training.environment.cameras", names, "none in a sweep")
    camera = environment.camera.of(vehicle.load_vehicle(environment.vehicle).camera)
    return card_writing.template_size(
        trial.layers,
        trial.filters,
        environment.image_height_px,
        environment.image_width_px,
        card.outputs_of(environment.action_spec),
        projections.CHANNELS[camera.kind] * environment.frames,
    )


@dataclass(frozen=True)
class TrainedTrial:
    """Training result."""

    steps: int
    best_steps: int
    """Decisions after which the weights were best; these weights fly."""
    selection_success: float
    """Success rate of the best weights on the selection seeds, 0 to 1."""
    seconds: float
    """Wall time of the training without evaluations [s]."""


@dataclass(frozen=True)
class TrialResult:
    """Figures of a trained network. Means are over the flights that reached the goal."""

    trial: Trial
    parameters: int
    macs: int
    trained: TrainedTrial
    episodes: int
    successes: int
    outcomes: dict[Outcome, int]
    flight_time_s: float | None
    """Mean flight time; None: no flight reached the goal."""
    distance_m: float | None
    energy_j: float | None
    code: str | None = None
    """Identity of the code that ended the trial (`core.machine.code_of`)."""

    @property
    def success_rate(self) -> float:
        """Share of the flights that reached the goal, 0 to 1."""
        return self.successes / self.episodes


def result_of(
    trial: Trial, parameters: int, macs: int, trained: TrainedTrial, flown: Sequence[EpisodeResult]
) -> TrialResult:
    """Return the figures of a trial's flights, at least one."""
    # Flights end in arbitrary order: sums must not depend on it.
    flights = sorted(flown, key=lambda flight: flight.seed)
    outcomes = dict.fromkeys(OUTCOMES.values(), 0)
    for flight in flights:
        outcomes[OUTCOMES[flight.verdict]] += 1
    return TrialResult(
        trial=trial,
        parameters=parameters,
        macs=macs,
        trained=trained,
        episodes=len(flights),
        successes=outcomes[Outcome.SUCCESS],
        outcomes=outcomes,
        flight_time_s=mean_of_successes(flights, "flight_time_s"),
        distance_m=mean_of_successes(flights, "distance_m"),
        energy_j=mean_of_successes(flights, "energy_j"),
        code=machine.code_now(),
    )
