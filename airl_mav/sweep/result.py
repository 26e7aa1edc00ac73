"""What a trial came to: one small JSON file, written whole."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import TypeAdapter, ValidationError

from airl_mav.core.errors import UsageError
from airl_mav.core.versioned import write_json
from airl_mav.envs.evaluation import OUTCOMES, EpisodeResult
from airl_mav.flight.judge import Outcome
from airl_mav.sweep.trial import Trial

SCHEMA = 1
"""Version of `result.json`; docs/sweep.md describes it."""


@dataclass(frozen=True)
class Trained:
    """How the training went."""

    steps: int
    """Decisions after which it ended."""
    best_steps: int
    """Decisions after which the weights were best; those fly."""
    selection_success: float
    """Success rate of the best weights on the selection seeds, 0 to 1."""
    seconds: float
    """Wall time of the training, evaluations left out [s]."""


@dataclass(frozen=True)
class TrialResult:
    """A trained network in figures. Means are over the flights that reached the goal."""

    trial: Trial
    parameters: int
    macs: int
    trained: Trained
    episodes: int
    successes: int
    outcomes: dict[Outcome, int]
    """Flights by how they ended."""
    flight_time_s: float | None
    """None: no flight reached the goal."""
    distance_m: float | None
    energy_j: float | None

    @property
    def success_rate(self) -> float:
        """Share of the flights that reached the goal, 0 to 1."""
        return self.successes / self.episodes


_RESULT = TypeAdapter(TrialResult)


def judged(
    trial: Trial, parameters: int, macs: int, trained: Trained, flown: Sequence[EpisodeResult]
) -> TrialResult:
    """Return the figures of a trial's flights, at least one."""
    # Flights end in an order of their own: sums must not depend on it.
    flights = sorted(flown, key=lambda flight: flight.seed)
    outcomes = dict.fromkeys(OUTCOMES.values(), 0)
    for flight in flights:
        outcomes[OUTCOMES[flight.verdict]] += 1
    good = [f for f in flights if OUTCOMES[f.verdict] is Outcome.SUCCESS]
    means = {
        name: float(np.mean([getattr(flight, name) for flight in good])) if good else None
        for name in ("flight_time_s", "distance_m", "energy_j")
    }
    return TrialResult(
        trial=trial,
        parameters=parameters,
        macs=macs,
        trained=trained,
        episodes=len(flights),
        successes=len(good),
        outcomes=outcomes,
        flight_time_s=means["flight_time_s"],
        distance_m=means["distance_m"],
        energy_j=means["energy_j"],
    )


def as_data(result: TrialResult) -> dict[str, Any]:
    """Return a result as JSON values."""
    data: dict[str, Any] = _RESULT.dump_python(result, mode="json")
    return data


def write_result(path: Path, result: TrialResult, evaluation: dict[str, Any]) -> None:
    """Write a result so that it is there whole or not at all.

    Args:
        path: The file.
        result: The figures.
        evaluation: On which flights they rest: seeds and number.
    """
    data = {"schema": SCHEMA, "evaluation": evaluation, **as_data(result)}
    write_json(path, data)


def read_result(path: Path, trial: Trial, evaluation: dict[str, Any]) -> TrialResult | None:
    """Return a trial's result; None when it has none.

    Raises:
        UsageError: The file is not what was written, or of another trial or other flights.
    """
    try:
        data = json.loads(path.read_bytes())
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:
        raise UsageError(f"{path}: not a result: {error}") from None
    if not isinstance(data, dict) or data.pop("schema", None) != SCHEMA:
        raise UsageError(f"{path}: schema: accepted: {SCHEMA}")
    flown = data.pop("evaluation", None)
    try:
        result = _RESULT.validate_python(data)
    except ValidationError as error:
        raise UsageError(f"{path}: not a result: {error.errors()[0]['msg']}") from None
    if asdict(result.trial) != asdict(trial) or flown != evaluation:
        raise UsageError(f"{path}: of another trial or of other flights; accepted: another --out")
    return result
