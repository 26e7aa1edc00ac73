"""Small sweeps for tests: a file, and fake results without training."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from airl_mav.addons.sweep.config import SweepConfig, TrainedTrial, Trial, TrialResult, size_of
from airl_mav.flight.judge import Outcome
from airl_mav.profiles.loading import profiles_dir

TINY = (profiles_dir() / "sweeps" / "tiny.toml").read_text(encoding="utf-8")


def write_sweep_file(folder: Path, text: str = TINY) -> Path:
    path = folder / "small.toml"
    path.write_text(text, encoding="utf-8")
    return path


def fake_results(
    config: SweepConfig, trials: Sequence[Trial], successes: Sequence[int], episodes: int = 300
) -> list[TrialResult]:
    """Return results with `successes` successes of each trial."""
    results = []
    for trial, count in zip(trials, successes, strict=True):
        size = size_of(config, trial)
        outcomes = {Outcome.SUCCESS: count, Outcome.COLLISION: episodes - count}
        trained = TrainedTrial(config.training.steps, config.training.steps, 0.5, 60.0)
        results.append(
            TrialResult(
                trial=trial,
                parameters=size.parameters,
                macs=size.macs,
                trained=trained,
                episodes=episodes,
                successes=count,
                outcomes=outcomes,
                flight_time_s=8.0 if count else None,
                distance_m=25.0 if count else None,
                energy_j=3500.0 if count else None,
            )
        )
    return results
