"""Learning curves: several configurations and seeds, in one picture and one table.

    python scripts/learning_curves.py [--configs NAME ...] [--seeds N] [--steps N] [--out DIR]

Defaults to the paper's algorithm exploration (DQN and PPO, with and without curriculum), and the
training of `static-obstacles`. Each run is a separate `airl train` that survives a kill: start the
script again to resume. The picture shows success and reward on the selection seeds, mean over the
training seeds with a 95 % interval (Student's t). The table shows the decisions until each
configuration reached 97 %, not the time, which depends on the machine's load. Writes curves.png,
curves.md and table.json.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy import stats

from airl_mav.core.errors import UsageError
from airl_mav.core.files import read_json, replace_file
from airl_mav.report.document import NONE, Column, TableView, markdown_table, write_table
from airl_mav.training.training_folder import CONFIG_FILE, SCHEMA, Evaluation, TrainingFolder

CONFIGS = (
    *("paper-dqn", "paper-dqn-curriculum", "paper-ppo", "paper-ppo-curriculum"),
    "static-obstacles",
)
"""The paper's exploration, and the training of `static-obstacles`."""

REACHED = 0.97


@dataclass(frozen=True)
class Command:
    """Train, collect results and draw."""

    configs: tuple[str, ...] = CONFIGS
    """Training configurations: built-in names or paths."""

    seeds: int = 5
    """Training seeds of each, 1 to N."""

    steps: int | None = None
    """Decisions of each run; None = the configuration's."""

    jobs: int = 1
    """Number of parallel runs; each takes one core."""

    out: Path = Path("runs/learning-curves")
    """Folder of the runs, curves.png, curves.md and table.json."""


def main() -> None:
    command = tyro.cli(Command, description=__doc__)
    runs = [(name, seed) for name in command.configs for seed in range(1, command.seeds + 1)]
    with ThreadPoolExecutor(command.jobs) as pool:
        codes = list(pool.map(lambda run: train(command, *run), runs))
    if any(codes):
        sys.exit("a run did not finish; start again to go on")
    curves = {name: collect(command, name) for name in command.configs}
    draw(curves, command.out / "curves.png")
    view = table(curves)
    made = made_with(folder(command, *run) for run in runs)
    write_table(view, command.out, made)
    text = markdown_table(view)
    replace_file(command.out / "curves.md", f"{text}\n".encode())
    print(text)


def folder(command: Command, name: str, seed: int) -> Path:
    return command.out / f"{Path(name).stem}-{seed}"


def train(command: Command, name: str, seed: int) -> int:
    out = folder(command, name, seed)
    if (out / "policy" / "card.json").exists():
        return 0
    words = [sys.executable, "-m", "airl_mav.cli.main", "train", name]
    words += ["--seed", f"{seed}", "--out", f"{out}", "--resume"]
    if command.steps is not None:
        words += ["--steps", f"{command.steps}"]
    print(f"{name}, seed {seed}", flush=True)
    command.out.mkdir(parents=True, exist_ok=True)
    with (command.out / f"{out.name}.log").open("ab") as log:
        return subprocess.run(words, stdout=log, stderr=log, check=False).returncode


def collect(command: Command, name: str) -> list[list[Evaluation]]:
    seeds = range(1, command.seeds + 1)
    return [TrainingFolder(folder(command, name, seed)).evaluations() for seed in seeds]


def grid(runs: Sequence[Sequence[Evaluation]]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return steps (k,), and success [%] and reward (2, seeds, k), where all runs have them."""
    k = min(len(run) for run in runs)
    steps = np.array([each.steps for each in runs[0][:k]], np.float64)
    rates = [[100.0 * each.success_rate for each in run[:k]] for run in runs]
    return steps, np.array([rates, [[each.reward for each in run[:k]] for run in runs]], np.float64)


def draw(curves: dict[str, list[list[Evaluation]]], path: Path) -> None:
    figure = Figure(figsize=(9.6, 4.2), layout="constrained")
    axes = figure.subplots(1, 2)
    for name, runs in curves.items():
        steps, both = grid(runs)
        for ax, values, most in zip(axes, both, (100.0, np.inf), strict=True):
            mean, n = values.mean(axis=0), len(values)
            half = stats.t.ppf(0.975, n - 1) * stats.sem(values, axis=0) if n > 1 else 0
            (line,) = ax.plot(steps / 1e3, mean, label=f"{Path(name).stem} (n = {n})")
            low, high = np.clip([mean - half, mean + half], 100.0 - most, most)
            ax.fill_between(steps / 1e3, low, high, alpha=0.15, color=line.get_color())
    for ax, label in zip(axes, ("success on the selection seeds, %", "reward"), strict=True):
        ax.set_xlabel("decisions of all vehicles, thousands")
        ax.set_ylabel(label)
        ax.grid(alpha=0.25)
    axes[0].set_ylim(0, 101)
    axes[0].legend(frameon=False, fontsize=8.5, loc="lower right")
    FigureCanvasAgg(figure)
    figure.savefig(path, dpi=150)


def table(curves: dict[str, list[list[Evaluation]]]) -> TableView:
    """Return the results of each configuration, over its training seeds."""
    rows = []
    for name, runs in curves.items():
        best = [100.0 * max(each.success_rate for each in run) for run in runs]
        last = [100.0 * run[-1].success_rate for run in runs]
        first = [
            next((each.steps for each in run if each.success_rate >= REACHED), None) for run in runs
        ]
        reached = [steps / 1e3 for steps in first if steps is not None]
        when = f"{np.median(reached):.0f} ({max(reached):.0f})" if reached else NONE
        rows.append(
            (
                Path(name).stem,
                f"{len(runs)}",
                f"{np.mean(best):.1f} ({min(best):.1f})",
                f"{np.mean(last):.1f}",
                f"{len(reached)} of {len(runs)}",
                when,
            )
        )
    columns = (
        Column("configuration", number=False),
        Column("seeds"),
        Column("best, mean (least)", "%"),
        Column("last, mean", "%"),
        Column("97 % reached"),
        Column("after, median (latest)", "thousand decisions"),
    )
    return TableView("learning-curves", "Learning curves", columns, tuple(rows))


def made_with(folders: Iterable[Path]) -> dict[str, Any]:
    """Return the provenance of the latest training. Raises UsageError for different commits."""
    made = [read_json(each / CONFIG_FILE, SCHEMA, "training run") for each in folders]
    commits = {None if each["git"] is None else each["git"]["commit"] for each in made}
    if len(commits) > 1:
        raise UsageError(f"trained by {len(commits)} commits; accepted: one")
    last = max(made, key=lambda each: str(each["created_utc"]))
    return {key: last[key] for key in ("created_utc", "versions", "machine", "git")}


if __name__ == "__main__":
    main()
