"""Small campaigns at level gym; as a script, a campaign that a test may kill."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from airl_mav.core.files import Arrays
from airl_mav.experiments.campaign import Cell, Declaration, DeclaredCell, open_campaign, run_cells
from airl_mav.experiments.executors import ExecutorSettings, open_executor
from airl_mav.experiments.experiment import make_cell
from airl_mav.rehearsal.run_folder import LoadedRun
from airl_mav.scenario.model import Scenario

SEED = 5


def gym_cell(name: str, *, episodes: int = 8, **changes: Any) -> Cell:
    asked: dict[str, Any] = {
        "policy": "greedy",
        "arena": "no-obstacles",
        "seed": SEED,
        "hold_s": 0.5,
        "time_limit_s": 30.0,
        "slots": 2,
    }
    scenario = Scenario(level="gym", episodes=episodes, **(asked | changes))
    return make_cell(name, f"the cell {name}", scenario)


def declared(cells: list[Cell], kind: str = "test") -> Declaration:
    return Declaration(
        kind,
        {"policy": "greedy"},
        {cell.name: DeclaredCell(cell.title, cell.scenario.config) for cell in cells},
    )


def cells(episodes: int = 8) -> list[Cell]:
    return [gym_cell("a", episodes=episodes), gym_cell("b", episodes=episodes, hold_s=0.3)]


def same_runs(one: LoadedRun, other: LoadedRun) -> bool:
    """Return whether two runs hold the same episodes, to the last bit."""

    def equal(mine: Mapping[int, Arrays], theirs: Mapping[int, Arrays]) -> bool:
        return mine.keys() == theirs.keys() and all(
            np.array_equal(array, theirs[i][name])
            for i, arrays in mine.items()
            for name, array in arrays.items()
        )

    paths = [{i: path.arrays() for i, path in run.trajectories.items()} for run in (one, other)]
    same_paths, same_stamps = equal(*paths), equal(one.latency, other.latency)
    return one.episodes == other.episodes and same_paths and same_stamps


def main(path: Path, episodes: int) -> None:
    flown = cells(episodes)
    with (
        open_campaign(path, declared(flown), command="a test"),
        open_executor(ExecutorSettings(workers=2)) as executor,
    ):
        run_cells(path, flown, executor)


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]))
