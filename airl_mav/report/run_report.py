"""The report of a run: from its folder to the page, and to the terminal."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console
from rich.text import Text

from airl_mav.rehearsal.run_folder import LoadedRun, load
from airl_mav.report.arenas import arenas_of, vehicle_of
from airl_mav.report.forensics.worst import EXAMINED, ranked
from airl_mav.report.run_page import build_page, pictured
from airl_mav.report.run_summary import summarize_run
from airl_mav.report.run_tables import (
    episodes_table,
    latency_table,
    quality_table,
    real_time_table,
    setup_rows,
)
from airl_mav.report.table import count_outcomes, print_facts, print_table

MAX_LISTED = 25
"""Flights with a line of their own in the terminal."""


def write_report(run: LoadedRun | Path, out: Path | None = None) -> Path:
    """Write a run's `report.html` and the PNG files, each whole or not at all. Nothing is printed.

    Args:
        run: The run, or its folder.
        out: Folder to write into; None: the run's own.

    Returns:
        The path of the page.

    Raises:
        UsageError: The folder holds no run, a file of it is damaged, or a profile of it cannot be
            found or used any more.
    """
    if isinstance(run, Path):
        run = load(run)
    vehicle = vehicle_of(run.info)
    arenas = arenas_of([*ranked(run)[:EXAMINED], *pictured(run)], vehicle)
    return build_page(run, arenas, out, vehicle=vehicle)


def print_report(run: LoadedRun, console: Console, page: Path | None = None) -> None:
    """Print what was flown, the tables, and where the page lies.

    Args:
        run: The run.
        console: Where to.
        page: Path of the HTML page, if there is one.
    """
    summary = summarize_run(run)
    flights = count_outcomes([episode.outcome for episode in run.episodes])
    print_facts([*setup_rows(run), ("flights", flights)], console)
    views = [latency_table(summary), episodes_table(run, MAX_LISTED), quality_table(summary)]
    if summary.timed:
        views.append(real_time_table(run, summary))
    for view in views:
        console.print()
        print_table(view, console)
    if page is not None:
        console.print()
        console.print(Text.assemble(("report  ", "dim"), str(page)), soft_wrap=True)


def show_report(path: Path, console: Console) -> LoadedRun:
    """Write the report of a run folder, where a flight was finished, and print it.

    Returns:
        The run.

    Raises:
        UsageError: See `write_report`.
    """
    run = load(path)
    print_report(run, console, write_report(run) if run.episodes else None)
    return run
