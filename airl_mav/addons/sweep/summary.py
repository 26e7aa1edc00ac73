"""Cells of a sweep: each network over its training seeds, and the best one of an arena."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scipy
from pydantic import TypeAdapter

from airl_mav.addons.sweep.config import SweepConfig, Trial, TrialResult, size_of, trials
from airl_mav.core import errors, files
from airl_mav.experiments.campaign import Declaration, DeclaredCell
from airl_mav.flight.statistics import CONFIDENCE, Estimate, wilson
from airl_mav.latency.injection import ESTIMATE, choose_injection
from airl_mav.profiles.computer import ComputerProfile, LatencyDistribution
from airl_mav.profiles.loading import load_published

SCHEMA = 1
"""Version of `sweep.json` and of `result.json`; docs/how-to/sweep.md describes them."""

SWEEP_FILE = "sweep.json"
RESULT_FILE = "result.json"

MAY_CHANGE = ("description", "grids", "seeds")
"""Fields that may change when a sweep resumes: they add or postpone trials."""


@dataclass(frozen=True)
class _ResultFile:
    """Contents of `result.json`."""

    evaluation: dict[str, Any]
    """Flights behind the figures."""
    result: TrialResult
    schema: int = SCHEMA


_RESULT_FILE = TypeAdapter(_ResultFile)


@dataclass(frozen=True)
class SweepFolder:
    """Trials of a sweep on disk. Pickled for other processes."""

    path: Path
    config: SweepConfig

    def trial_path(self, trial: Trial) -> Path:
        """Return the folder of a trial."""
        return files.subfolder(self.path, trial.name)

    @property
    def evaluation(self) -> dict[str, Any]:
        """Evaluation flights of the results."""
        return self.config.evaluation.model_dump(mode="json")

    def result(self, trial: Trial) -> TrialResult | None:
        """Return a trial's result, None before its end; UsageError if from another trial."""
        path = self.trial_path(trial) / RESULT_FILE
        if not path.exists():
            return None
        held = files.read_typed(path, _RESULT_FILE, SCHEMA, "result")
        if held.result.trial != trial or held.evaluation != self.evaluation:
            raise errors.UsageError(
                f"{path}: of another trial or of other flights; accepted: another --out"
            )
        return held.result

    def results(self, wanted: Sequence[Trial]) -> list[TrialResult]:
        """Return the existing results, in the order of the trials. Raises UsageError."""
        return [found for trial in wanted if (found := self.result(trial)) is not None]

    def finish(self, result: TrialResult, checkpoints: Path) -> None:
        """End a trial, and remove the files needed only to resume."""
        folder = self.trial_path(result.trial)
        held = _ResultFile(self.evaluation, result)
        files.write_json(folder / RESULT_FILE, _RESULT_FILE.dump_python(held, mode="json"))
        shutil.rmtree(checkpoints, ignore_errors=True)


def as_data(config: SweepConfig) -> dict[str, Any]:
    """Return a sweep with all its defaults as JSON values; it can be read back."""
    data = config.model_dump(mode="json", exclude_none=True)
    for field in ("network", "seed"):
        del data["training"][field]
    del data["training"]["environment"]["arena"]
    return data


def declaration(config: SweepConfig) -> Declaration:
    """Return a sweep as a campaign with trials as cells."""
    return Declaration(
        kind="sweep",
        settings={key: value for key, value in as_data(config).items() if key not in MAY_CHANGE},
        cells={trial.name: DeclaredCell(trial.title, asdict(trial)) for trial in trials(config)},
    )


@dataclass(frozen=True)
class Computer:
    """Computer whose decision latency is estimated for each cell."""

    name: str
    profile: ComputerProfile


@dataclass(frozen=True)
class NetworkSummary:
    """Network in one arena, over its training seeds."""

    arena: str
    layers: int
    filters: int
    parameters: int
    macs: int
    t2_ms: float | None
    """Estimated decision latency on the requested computer [ms]; None: no computer."""
    planned: int
    """Number of training seeds."""
    results: tuple[TrialResult, ...]
    """Results of finished trials, by seed."""
    success_rate: Estimate
    """Mean over the training seeds, 0 to 1, with its 95 % interval; n counts seeds."""
    success_std: float | None
    """Standard deviation over the training seeds (n - 1); None: fewer than two."""
    flight_time_s: float | None
    """Mean over the seeds of their means; None: no flight reached the goal."""
    distance_m: float | None
    energy_j: float | None
    decisions: float | None
    """Mean number of decisions after which the weights were best."""

    @property
    def network(self) -> str:
        """Short name of the template: layers x filters."""
        return f"{self.layers}x{self.filters}"


_NETWORK = TypeAdapter(NetworkSummary)


@dataclass(frozen=True)
class Sweep:
    """All networks of a sweep with their current results."""

    folder: SweepFolder
    made: dict[str, Any]
    computer: Computer | None
    cells: tuple[NetworkSummary, ...]

    @property
    def config(self) -> SweepConfig:
        """Sweep configuration."""
        return self.folder.config

    @property
    def arenas(self) -> tuple[str, ...]:
        """Names of the arenas, in the order of the grids."""
        return tuple(grid.name for grid in self.config.grids)

    def of(self, arena: str) -> tuple[NetworkSummary, ...]:
        """Return the cells of an arena."""
        return tuple(cell for cell in self.cells if cell.arena == arena)

    def best(self, arena: str) -> NetworkSummary | None:
        """Return the cell with the highest mean success, then the fewest MACs; None if empty."""
        known = [cell for cell in self.of(arena) if cell.results]
        return max(known, key=lambda cell: (_rate(cell), -cell.macs), default=None)

    def rivals(self, arena: str) -> tuple[NetworkSummary, ...]:
        """Return the other cells whose mean lies within the interval of the best one."""
        best = self.best(arena)
        if best is None or best.success_rate.low is None:
            return ()
        low = best.success_rate.low
        known = [cell for cell in self.of(arena) if cell.results and cell is not best]
        return tuple(cell for cell in known if _rate(cell) >= low)

    @property
    def ended(self) -> int:
        """Number of finished trials."""
        return sum(len(cell.results) for cell in self.cells)

    @property
    def planned(self) -> int:
        """Total number of trials."""
        return sum(cell.planned for cell in self.cells)


def published_best(arena: str) -> tuple[str, float] | None:
    """Return network and success rate, 0 to 1, of the published best network in an arena."""
    best = load_published().best_networks.get(arena)
    return None if best is None else (best.network, best.success_percent / 100.0)


def _rate(cell: NetworkSummary) -> float:
    value = cell.success_rate.value
    return -1.0 if value is None else value


def over_seeds(results: Sequence[TrialResult]) -> Estimate:
    """Return the mean success rate over training seeds with a 95 % interval.

    The interval covers Student's t over the seeds, for differences between trainings, and Wilson's
    over all flights, which has a width even without such differences. One seed has only the latter.
    """
    rates = np.array([result.success_rate for result in results])
    if not rates.size:
        return Estimate(None, None, None, 0)
    flights = wilson(sum(r.successes for r in results), sum(r.episodes for r in results))
    assert flights.low is not None and flights.high is not None  # noqa: S101 (n > 0)
    mean, low, high = float(rates.mean()), flights.low, flights.high
    if rates.size > 1:
        quantile = scipy.stats.t.ppf((1.0 + CONFIDENCE) / 2.0, rates.size - 1)
        reach = float(quantile * scipy.stats.sem(rates))
        low, high = min(low, max(mean - reach, 0.0)), max(high, min(mean + reach, 1.0))
    return Estimate(mean, low, high, rates.size)


def summarize(folder: SweepFolder, made: dict[str, Any], computer: Computer | None = None) -> Sweep:
    """Return all cells from the existing results; UsageError if one is damaged or foreign."""
    by_cell: dict[tuple[str, int, int], list[Trial]] = {}
    for trial in trials(folder.config):
        by_cell.setdefault((trial.arena, trial.layers, trial.filters), []).append(trial)
    cells = tuple(_summarized(folder, wanted, computer) for wanted in by_cell.values())
    return Sweep(folder, made, computer, cells)


def _summarized(
    folder: SweepFolder, wanted: Sequence[Trial], computer: Computer | None
) -> NetworkSummary:
    first = wanted[0]
    size = size_of(folder.config, first)
    results = tuple(folder.results(wanted))
    rates = [result.success_rate for result in results]
    return NetworkSummary(
        arena=first.arena_name,
        layers=first.layers,
        filters=first.filters,
        parameters=size.parameters,
        macs=size.macs,
        t2_ms=None if computer is None else estimated_ms(computer.profile, size.macs),
        planned=len(wanted),
        results=results,
        success_rate=over_seeds(results),
        success_std=float(np.std(rates, ddof=1)) if len(rates) > 1 else None,
        flight_time_s=_mean([r.flight_time_s for r in results]),
        distance_m=_mean([r.distance_m for r in results]),
        energy_j=_mean([r.energy_j for r in results]),
        decisions=_mean([float(r.trained.best_steps) for r in results]),
    )


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


def estimated_ms(computer: ComputerProfile, macs: int) -> float:
    """Return a network's mean t2 [ms] by MACs. Raises UsageError without workload."""
    latency = choose_injection(computer, ESTIMATE, macs=macs).latency
    if not isinstance(latency, LatencyDistribution):
        raise errors.UsageError("--computer: has no workload to estimate from")
    if latency.samples_ms is not None:
        return float(np.mean(latency.samples_ms))
    assert latency.mean_ms is not None  # noqa: S101 (every other distribution has one)
    return latency.mean_ms


def write_sweep(sweep: Sweep) -> None:
    """Write `sweep.json` atomically."""
    data = {
        "schema": SCHEMA,
        "made": sweep.made,
        "config": as_data(sweep.config),
        "computer": None if sweep.computer is None else sweep.computer.name,
        "trials_planned": sweep.planned,
        "trials_ended": sweep.ended,
        "best": {arena: _best(sweep, arena) for arena in sweep.arenas},
        "cells": [_network_data(cell) for cell in sweep.cells],
    }
    files.write_json(sweep.folder.path / SWEEP_FILE, data)


def _best(sweep: Sweep, arena: str) -> dict[str, Any] | None:
    best, paper = sweep.best(arena), published_best(arena)
    if best is None:
        return None
    return {
        "layers": best.layers,
        "filters": best.filters,
        "success_rate": asdict(best.success_rate),
        "within_its_interval": [cell.network for cell in sweep.rivals(arena)],
        "paper": None if paper is None else {"network": paper[0], "success_rate": paper[1]},
    }


def _network_data(cell: NetworkSummary) -> dict[str, Any]:
    data: dict[str, Any] = _NETWORK.dump_python(cell, mode="json")
    data["trials"] = data.pop("results")
    return data
