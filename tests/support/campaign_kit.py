"""Small campaigns at level gym; as a script, one that a test may kill."""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path

from airl_mav.envs.evaluation import Pilots, SinglePilots
from airl_mav.envs.spec import spec_of
from airl_mav.experiments.campaign import Cell, run_cells
from airl_mav.experiments.executors import ExecutorSettings, open_executor
from airl_mav.experiments.gym_flier import GymFlier
from airl_mav.experiments.store import Declaration, DeclaredCell, open_campaign
from airl_mav.flight.setup import Part, Setup
from airl_mav.latency.injection import NOTHING_INJECTED
from airl_mav.policy.registry import load_policy
from airl_mav.rehearsal.evaluation import Evaluation

SEED = 5


def greedy_pilots(hold_s: float) -> Pilots:
    return SinglePilots(partial(load_policy, "greedy", hold_s), 5.0)


def gym_cell(name: str, *, episodes: int = 8, seed: int = SEED, hold_s: float = 0.5) -> Cell:
    environment = spec_of(
        None, {"arena": "no-obstacles", "episode": {"hold_s": hold_s, "time_limit_s": 30.0}}
    )
    setup = Setup(
        level="gym",
        vehicle=Part("quad"),
        arena=Part("no-obstacles"),
        policy=Part("greedy"),
        computer=Part("workstation"),
        computer_watts=0.0,
        injection=NOTHING_INJECTED,
        speed=None,
        between_commands="persist",
    )
    flier = GymFlier(environment, NOTHING_INJECTED, 0.0, partial(greedy_pilots, hold_s), slots=2)
    evaluation = Evaluation(setup, tuple(range(seed, seed + episodes)), {"hold_s": hold_s})
    return Cell(name, f"the cell {name}", evaluation, flier)


def declared(cells: list[Cell], kind: str = "test") -> Declaration:
    return Declaration(
        kind,
        {"policy": "greedy"},
        {cell.name: DeclaredCell(cell.title, dict(cell.evaluation.config)) for cell in cells},
    )


def cells(episodes: int = 8) -> list[Cell]:
    return [gym_cell("a", episodes=episodes), gym_cell("b", episodes=episodes, hold_s=0.3)]


def main(path: Path, episodes: int) -> None:
    flown = cells(episodes)
    with (
        open_campaign(path, declared(flown), command="a test") as store,
        open_executor(ExecutorSettings(workers=2)) as executor,
    ):
        run_cells(store, flown, executor)


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]))
