"""One trial of a sweep: one network, one arena, one seed."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from airl_mav.policy.runtime import outputs_of
from airl_mav.policy.template import Size, template_size
from airl_mav.sweep.config import SweepConfig
from airl_mav.training.config import NetworkSpec, TrainingConfig


@dataclass(frozen=True, order=True)
class Trial:
    """Which network learns where, from which seed."""

    arena: str
    """Arena profile, as the sweep names it."""
    layers: int
    filters: int
    seed: int
    """Of weights, exploration and episodes."""

    @property
    def arena_name(self) -> str:
        """Name of the arena, as folders carry it."""
        return Path(self.arena).stem

    @property
    def network(self) -> str:
        """The template in short: layers x filters."""
        return f"{self.layers}x{self.filters}"

    @property
    def name(self) -> str:
        """Name of its folder, unique in a sweep."""
        return f"{self.arena_name}-{self.network}-seed{self.seed}"


def trials(config: SweepConfig) -> list[Trial]:
    """Return all trials: the first seed of all cells, then the second, and so on.

    So that a sweep that is looked at early has something to show in every cell.
    """
    return list(_trials(config))


def _trials(config: SweepConfig) -> Iterator[Trial]:
    for seed in config.seeds:
        for grid in config.grids:
            for layers in grid.layers:
                for filters in grid.filters:
                    yield Trial(grid.arena, layers, filters, seed)


def training_of(config: SweepConfig, trial: Trial) -> TrainingConfig:
    """Return how a trial is trained."""
    base = config.training
    network = NetworkSpec(kind="template", layers=trial.layers, filters=trial.filters)
    return base.model_copy(
        update={
            "description": f"template {trial.network} in {trial.arena_name}, seed {trial.seed}",
            "seed": trial.seed,
            "environment": base.environment.model_copy(update={"arena": trial.arena}),
            "network": network,
        }
    )


def size_of(config: SweepConfig, trial: Trial) -> Size:
    """Return the size of a trial's network, as it flies."""
    environment = config.training.environment
    return template_size(
        trial.layers,
        trial.filters,
        environment.image_height_px,
        environment.image_width_px,
        outputs_of(environment.action_spec),
    )
