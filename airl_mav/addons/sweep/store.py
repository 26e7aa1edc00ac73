"""Folder of a sweep: a campaign (`experiments.store`) with trials as cells.

    campaign.json           the search space
    sweep.json              current results and networks
    sweep.md, .html, .png   the results for people
    <trial>/                a training folder (`training.store`), with a file of the sweep:
        result.json         the result, which marks a finished trial

Any process on any machine with access to the folder can run or resume a trial.
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from airl_mav.addons.sweep.config import SweepConfig
from airl_mav.addons.sweep.trial import Trial, TrialResult, trials
from airl_mav.core.errors import UsageError
from airl_mav.core.files import read_typed, write_json
from airl_mav.experiments.store import Declaration, DeclaredCell

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
        return self.path / trial.name

    @property
    def evaluation(self) -> dict[str, Any]:
        """Evaluation flights of the results."""
        return self.config.evaluation.model_dump(mode="json")

    def result(self, trial: Trial) -> TrialResult | None:
        """Return a trial's result, None before its end; UsageError if from another trial."""
        path = self.trial_path(trial) / RESULT_FILE
        if not path.exists():
            return None
        held = read_typed(path, _RESULT_FILE, SCHEMA, "result")
        if held.result.trial != trial or held.evaluation != self.evaluation:
            raise UsageError(
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
        write_json(folder / RESULT_FILE, _RESULT_FILE.dump_python(held, mode="json"))
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
