"""The report in the terminal."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from airl_mav.flight.judge import Outcome
from airl_mav.rehearsal.run_folder import LoadedRun
from airl_mav.report.summary import summarize_run
from airl_mav.report.tables import (
    NONE,
    OUTCOME_WORDS,
    TOO_FEW_CELL,
    TableView,
    episodes_table,
    latency_table,
    outcomes_in_words,
    quality_table,
    real_time_table,
    setup_rows,
)

MAX_LISTED = 25
"""Flights with a line of their own."""

STYLES = {
    OUTCOME_WORDS[Outcome.SUCCESS]: "green",
    OUTCOME_WORDS[Outcome.COLLISION]: "red",
    OUTCOME_WORDS[Outcome.TIMEOUT]: "yellow",
    OUTCOME_WORDS[Outcome.BATTERY]: "magenta",
    OUTCOME_WORDS[Outcome.ABORTED]: "dim",
    TOO_FEW_CELL: "dim",
    NONE: "dim",
}


def print_report(run: LoadedRun, console: Console, report: Path | None = None) -> None:
    """Print what was flown, the tables, and where the page lies.

    Args:
        run: The run.
        console: Where to.
        report: Path of the HTML page, if there is one.
    """
    summary = summarize_run(run)
    facts = Table.grid(padding=(0, 2))
    facts.add_column(style="dim", no_wrap=True)
    facts.add_column(overflow="fold")
    for term, text in setup_rows(run):
        facts.add_row(term, Text(text))
    facts.add_row("flights", Text(outcomes_in_words(summary)))
    console.print()
    console.print(facts)
    views = [latency_table(summary), episodes_table(run, MAX_LISTED), quality_table(summary)]
    if summary.timed:
        views.append(real_time_table(run, summary))
    for view in views:
        console.print()
        print_table(view, console)
    if report is not None:
        console.print()
        console.print(Text.assemble(("report  ", "dim"), str(report)), soft_wrap=True)


def print_table(view: TableView, console: Console, *, wrap: bool = False) -> None:
    """Print a table and its notes; its cells are broken into lines or kept whole."""
    console.print(rich_table(view, wrap=wrap))
    for note in view.notes:
        console.print(Text(note, style="dim"))


def rich_table(view: TableView, *, wrap: bool = False) -> Table:
    """Return a table for the terminal, without the columns meant for a page."""
    table = Table(
        title=view.title,
        title_justify="left",
        title_style="bold",
        box=box.SIMPLE_HEAD,
        padding=(0, 1, 0, 0),
        pad_edge=False,
    )
    shown = [i for i, column in enumerate(view.columns) if not column.page_only]
    for i in shown:
        column = view.columns[i]
        title = f"{column.title} [{column.unit}]" if column.unit else column.title
        side: Literal["left", "right"] = "right" if column.number else "left"
        table.add_column(Text(title), justify=side, no_wrap=not wrap)
    for row in view.rows:
        table.add_row(*(Text(row[i], style=STYLES.get(row[i], "")) for i in shown))
    return table
