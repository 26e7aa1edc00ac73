"""A sweep in the terminal: what it would do, and what came out."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console
from rich.table import Table
from rich.text import Text

from airl_mav.report.sweep.tables import best_in_words, cells_table, count, fact_rows, t2_ms
from airl_mav.report.tables import Column, TableView
from airl_mav.report.terminal import print_table
from airl_mav.sweep.config import SweepConfig
from airl_mav.sweep.store import SweepFolder
from airl_mav.sweep.summary import Computer, Sweep, estimated_ms
from airl_mav.sweep.trial import Trial, size_of, trials


def print_sweep(sweep: Sweep, console: Console, page: Path) -> None:
    """Print what was searched, the cells, the best ones, and where the page lies."""
    _print_facts(fact_rows(sweep), console)
    for arena in sweep.arenas:
        console.print()
        print_table(cells_table(sweep, arena), console, wrap=True)
        for line in best_in_words(sweep, arena):
            console.print(Text(line))
    console.print()
    console.print(Text.assemble(("sweep  ", "dim"), str(page)), soft_wrap=True)


def print_plan(
    name: str, config: SweepConfig, computer: Computer | None, path: Path, console: Console
) -> None:
    """Print what a sweep would do; nothing is written.

    Raises:
        UsageError: The folder holds results of something else.
    """
    folder, wanted = SweepFolder(path, config), trials(config)
    ended = sum(folder.result(trial) is not None for trial in wanted)
    steps = config.training.steps
    most = "at most " if config.training.selection.stop_at is not None else ""
    facts = [
        ("sweep", f"{name}: {config.description}"),
        ("folder", f"{path}"),
        ("trials", f"{len(wanted)}, of which {ended} have ended"),
        ("decisions", f"{most}{steps:,} each, {most}{steps * len(wanted):,} in all"),
        (
            "evaluation",
            f"{config.evaluation.episodes:,} flights each, "
            f"{config.evaluation.episodes * len(wanted):,} in all",
        ),
    ]
    _print_facts(tuple(facts), console)
    for grid in config.grids:
        first = [t for t in wanted if t.arena == grid.arena and t.seed == config.seeds[0]]
        console.print()
        print_table(_plan_table(config, grid.name, first, computer), console)


def _plan_table(
    config: SweepConfig, arena: str, cells: list[Trial], computer: Computer | None
) -> TableView:
    columns = (
        Column("network", number=False),
        Column("trials"),
        Column("decisions"),
        Column("parameters"),
        Column("MACs"),
        *([Column("t2, estimated", "ms")] if computer is not None else []),
    )
    rows = []
    for trial in cells:
        size = size_of(config, trial)
        late = [] if computer is None else [t2_ms(estimated_ms(computer.profile, size.macs))]
        rows.append(
            (
                trial.network,
                f"{len(config.seeds)}",
                f"{config.training.steps * len(config.seeds):,}",
                count(size.parameters),
                count(size.macs),
                *late,
            )
        )
    return TableView(f"plan-{arena}", arena, columns, tuple(rows))


def _print_facts(rows: tuple[tuple[str, str], ...], console: Console) -> None:
    facts = Table.grid(padding=(0, 2))
    facts.add_column(style="dim", no_wrap=True)
    facts.add_column(overflow="fold")
    for term, text in rows:
        facts.add_row(term, Text(text))
    console.print()
    console.print(facts)
