"""Generalisation: flight quality of a policy outside its training arena.

    python scripts/studies/generalisation.py [--quick] [--episodes N] [--out DIR] [--config FILE]

The paper (V.C) flies its policies of No and of Dynamic Obstacles in its three arenas. This study
flies policies in all arenas on the same seeds, and prints each policy's change from its training
arena, beside the paper's figures.
"""

from __future__ import annotations

from pathlib import Path

from common import StudyConfig, StudyOptions, study
from pydantic import Field, create_model
from rich.console import Console

from airl_mav.cli.options import run_command, scenario_of
from airl_mav.cli.shared_options import fly_and_show
from airl_mav.core.progress import new_console
from airl_mav.experiments.evaluate import matrix
from airl_mav.experiments.experiment import ExperimentRun, entry_of
from airl_mav.flight.statistics import compare_pairs
from airl_mav.profiles.loading import load_published
from airl_mav.report.document import NONE, Column, TableView, print_table, with_interval

OPTIONS = create_model("Options", __base__=StudyOptions, __doc__=__doc__)


class GeneralisationConfig(StudyConfig):
    policies: tuple[str, ...] = Field(min_length=1, description="names, or paths to folders")
    arenas: tuple[str, ...] = Field(min_length=1, description="arena profiles")


def away_from_home(flown: ExperimentRun) -> TableView:
    """Return the success of every policy against its training arena, with the paper's below."""
    at = {(run.cell.label, run.cell.group): run.episodes for run in flown.cells}
    homes = {run.cell.label: entry_of(run.cell, "").trained_in for run in flown.cells}
    arenas = tuple(dict.fromkeys(arena for _, arena in at))
    rows: list[tuple[str, ...]] = []
    for policy, home in homes.items():
        if home is None or (policy, home) not in at:
            continue
        changes = (compare_pairs(at[policy, home], at[policy, a]).success_rate for a in arenas)
        rows.append((policy, home, *(with_interval(c.difference, 1, "+") for c in changes)))
        if published := load_published().generalisation.get(home):
            lost = (published[a] - published[home] if a in published else None for a in arenas)
            rows.append(("  the paper", "", *(NONE if d is None else f"{d:+.0f}" for d in lost)))
    heads = (Column("policy", number=False), Column("trained in", number=False))
    columns = (*heads, *(Column(arena, "points") for arena in arenas))
    notes = ("Difference in success, on the same seeds; 95 % intervals. The paper: section V.C.",)
    table = ("away", "Success against the own arena", columns, tuple(rows), notes)
    return TableView(*table, in_terminal="stacked")


def run(options: StudyOptions, console: Console | None = None) -> int:
    console = console or new_console()
    with study(options, GeneralisationConfig, __file__) as (config, root):
        experiment = matrix(scenario_of(config), config.policies, config.arenas)
        code, flown = fly_and_show(experiment, root, console)
        if code == 0:
            print_table(away_from_home(flown), console, wrap=True)
        return code


if __name__ == "__main__":
    run_command(Path(__file__).name, __name__)
