"""Trial of a sweep: one network, one arena, one seed; and its result."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path

from airl_mav.addons.sweep.config import SweepConfig
from airl_mav.core.errors import FieldError
from airl_mav.envs.evaluation import OUTCOMES, EpisodeResult, mean_of_successes
from airl_mav.flight.judge import Outcome
from airl_mav.policy.runtime import outputs_of
from airl_mav.policy.template import NetworkSize, template_size
from airl_mav.profiles.camera_kind import CHANNELS
from airl_mav.profiles.vehicle import load_vehicle
from airl_mav.training.config import NetworkSpec, TrainingConfig


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


def size_of(config: SweepConfig, trial: Trial) -> NetworkSize:
    """Return the size of a trial's network, as it flies."""
    environment = config.training.environment
    if environment.cameras:
        names = ", ".join(environment.cameras)
        raise FieldError("training.environment.cameras", names, "none in a sweep")
    camera = environment.camera.of(load_vehicle(environment.vehicle).camera)
    return template_size(
        trial.layers,
        trial.filters,
        environment.image_height_px,
        environment.image_width_px,
        outputs_of(environment.action_spec),
        CHANNELS[camera.kind] * environment.frames,
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
    )
