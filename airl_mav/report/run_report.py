"""Report of a run on a page and in the terminal."""

from __future__ import annotations

import gc
import shlex
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from rich.console import Console

from airl_mav.core.progress import DRAWING, Progress
from airl_mav.flight.requirements import Requirement
from airl_mav.flight.statistics import aggregate
from airl_mav.rehearsal.run_folder import LoadedRun, load
from airl_mav.report import run_tables
from airl_mav.report.arenas import arenas_of, vehicle_of
from airl_mav.report.conduct import conduct_table
from airl_mav.report.document import print_place, print_verdict
from airl_mav.report.measures import summarize_run
from airl_mav.report.run_tables import faults_table
from airl_mav.report.table import count_outcomes, print_facts, print_table
from airl_mav.report.verdict import (
    OverallVerdict,
    judge_run,
    requirements_of,
    save_verdict,
    unchecked,
)

YOUNG_OBJECTS = 50_000
"""Number of new containers that trigger a collection, instead of Python's 700."""


@contextmanager
def seldom_collected() -> Iterator[None]:
    """Reduce garbage collection during work that creates many long-lived objects.

    matplotlib builds figures from hundreds of thousands of objects. With Python's thresholds,
    garbage collection takes a fifth of a report's time; with these, almost no time, for a few MB
    more of memory. The previous thresholds are restored afterwards.
    """
    before = gc.get_threshold()
    gc.set_threshold(max(YOUNG_OBJECTS, before[0]) if before[0] else 0, *before[1:])
    try:
        yield
    finally:
        gc.set_threshold(*before)


MAX_LISTED = 25
"""Maximum number of flights listed in the terminal."""


def verdict_of(run: LoadedRun, requirements: Sequence[Requirement] | None = None) -> OverallVerdict:
    """Return a run's verdict; `requirements` default to the requirements of `verdict.json`."""
    if requirements is None:
        requirements = requirements_of(run.path)
    verdict = judge_run(run.info.setup, aggregate(run.episodes), run.episodes, requirements)
    return replace(verdict, sentences=verdict.sentences + unchecked([run.info]))


@seldom_collected()
def write_report(
    run: LoadedRun | Path, out: Path | None = None, verdict: OverallVerdict | None = None
) -> Path:
    """Write a run's `report.html`, `verdict.json` and PNG files; return the page's path."""
    # Imported here: loading the figures takes as long as flying and judging ten flights.
    from airl_mav.report.forensics.evidence import ranked
    from airl_mav.report.forensics.worst import EXAMINED
    from airl_mav.report.run_page import build_page
    from airl_mav.report.shown_flights import shown

    if isinstance(run, Path):
        run = load(run)
    vehicle = vehicle_of(run.info)
    arenas = arenas_of([*ranked(run)[:EXAMINED], *shown(run)], vehicle)
    verdict = verdict or verdict_of(run)
    page = build_page(run, arenas, out, vehicle=vehicle, verdict=verdict)
    save_verdict(verdict, page.parent)
    return page


def print_report(run: LoadedRun, console: Console, verdict: OverallVerdict) -> None:
    """Print the verdict, the setup and the tables."""
    print_verdict(verdict.lines, console)
    console.print()
    summary, feeds = summarize_run(run), not run.info.setup.computer_on_ground
    flights = count_outcomes([episode.outcome for episode in run.episodes])
    print_facts([*run_tables.setup_rows(run), ("flights", flights)], console)
    views = [
        run_tables.latency_table(summary),
        run_tables.episodes_table(run, MAX_LISTED),
        run_tables.quality_table(summary, computer=feeds),
    ]
    if (conduct := conduct_table(run, summary)) is not None:
        views.append(conduct)
    if (faults := faults_table(run)) is not None:
        views.append(faults)
    if summary.timed:
        views.append(run_tables.real_time_table(run, summary))
    for view in views:
        console.print()
        print_table(view, console)


def show_report(
    run: LoadedRun,
    verdict: OverallVerdict,
    console: Console,
    progress: Progress | None = None,
    *,
    draw: bool = True,
) -> Path | None:
    """Print the report of a run, then draw its page or print the command that draws it."""
    progress = progress or Progress()
    if run.episodes:
        save_verdict(verdict, run.path)
    print_report(run, console, verdict)
    if not run.episodes:
        return None
    if not draw:
        print_place("report", f"airl report {shlex.quote(str(run.path))}", console)
        return None
    progress.status(DRAWING)
    page = write_report(run, verdict=verdict)
    progress.status(None)
    print_place("report", page, console)
    return page
