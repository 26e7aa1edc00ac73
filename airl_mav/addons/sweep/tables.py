"""Tables of an arena's networks: their results, or their planned cost."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from rich.console import Console

from airl_mav.addons.sweep.config import SweepConfig
from airl_mav.addons.sweep.store import SweepFolder
from airl_mav.addons.sweep.summary import Computer, NetworkSummary, Sweep, summarize
from airl_mav.report.table import NONE, Column, TableView, print_facts, print_table

Described = tuple[Column, Callable[[NetworkSummary], str]]
"""Column, and the function that formats its cells."""


def count(number: float) -> str:
    """Return a large number in three digits: 40.4 M."""
    for unit, size in ((" G", 1e9), (" M", 1e6), (" k", 1e3)):
        if number >= size:
            return f"{number / size:.3g}{unit}"
    return f"{number:.0f}"


def t2_ms(value: float | None) -> str:
    """Return a latency [ms] in three digits."""
    if value is None:
        return NONE
    return f"{value:.0f}" if value >= 100 else f"{value:.3g}"


def percent(share: float | None) -> str:
    """Return a share as a number of percent."""
    return NONE if share is None else f"{100.0 * share:.1f}"


def interval(cell: NetworkSummary) -> str:
    """Return the interval of a network's success in percent."""
    rate = cell.success_rate
    return NONE if rate.low is None else f"{percent(rate.low)} … {percent(rate.high)}"


def _seeds(cell: NetworkSummary) -> str:
    n = cell.success_rate.n
    return f"{n}" if n == cell.planned else f"{n} of {cell.planned}"


def _mean(field: str, form: str, unit: float = 1.0) -> Callable[[NetworkSummary], str]:
    """Return a formatter of a mean over the seeds, in a given unit."""

    def write(cell: NetworkSummary) -> str:
        value: float | None = getattr(cell, field)
        return NONE if value is None else f"{value / unit:{form}}"

    return write


NETWORK: Described = (Column("network", number=False), lambda cell: cell.network)
MACS: Described = (Column("MACs"), lambda cell: count(cell.macs))
T2: Described = (Column("t2, estimated", "ms"), lambda cell: t2_ms(cell.t2_ms))

RESULTS: tuple[Described, ...] = (
    NETWORK,
    (Column("success", "%"), lambda cell: percent(cell.success_rate.value)),
    (Column("std"), lambda cell: percent(cell.success_std)),
    (Column("95 % interval"), interval),
    (Column("seeds"), _seeds),
    (Column("time", "s"), _mean("flight_time_s", ".2f")),
    (Column("distance", "m", page_only=True), _mean("distance_m", ".1f")),
    (Column("energy", "kJ", page_only=True), _mean("energy_j", ".2f", 1e3)),
    (Column("best after", page_only=True), _mean("decisions", ",.0f")),
    (Column("parameters", page_only=True), lambda cell: count(cell.parameters)),
    MACS,
)


def networks_table(sweep: Sweep, arena: str) -> TableView:
    """Return the networks of an arena, the best first, networks without a result last."""
    cells = sorted(sweep.of(arena), key=lambda c: (-(c.success_rate.value or -1.0), c.macs))
    notes = [
        "Network: layers x filters. Success: mean over the training seeds, each of the same "
        "flights; std: over the seeds. Interval: the wider of Student's t over the seeds and "
        "Wilson's over all flights. Time, distance, energy: means over the flights that reached "
        "the goal. Best after: decisions."
    ]
    if sweep.computer is not None:
        notes.append(
            f"t2 on {sweep.computer.name}: estimated, in proportion to the multiply-accumulates of "
            "the workload nearest in its profile; nothing was measured."
        )
    return _table(sweep, f"networks-{arena}", f"All networks in {arena}", RESULTS, cells, notes)


def print_plan(
    name: str, config: SweepConfig, computer: Computer | None, path: Path, console: Console
) -> None:
    """Print a sweep's plan; UsageError if the folder contains other results."""
    sweep = summarize(SweepFolder(path, config), {}, computer)
    steps, episodes = config.training.steps, config.evaluation.episodes
    most = "at most " if config.training.selection.stop_at is not None else ""
    facts = [
        ("sweep", f"{name}: {config.description}"),
        ("folder", f"{path}"),
        ("trials", f"{sweep.planned}, of which {sweep.ended} have ended"),
        ("decisions", f"{most}{steps:,} each, {most}{steps * sweep.planned:,} in all"),
        ("evaluation", f"{episodes:,} flights each, {episodes * sweep.planned:,} in all"),
    ]
    print_facts(facts, console)
    planned: tuple[Described, ...] = (
        NETWORK,
        (Column("trials"), lambda cell: f"{cell.planned}"),
        (Column("decisions"), lambda cell: f"{steps * cell.planned:,}"),
        (Column("parameters"), lambda cell: count(cell.parameters)),
        MACS,
    )
    for arena in sweep.arenas:
        console.print()
        print_table(_table(sweep, f"plan-{arena}", arena, planned, sweep.of(arena)), console)


def _table(
    sweep: Sweep,
    key: str,
    title: str,
    described: Sequence[Described],
    cells: Sequence[NetworkSummary],
    notes: Sequence[str] = (),
) -> TableView:
    """Return a row for each network, with its latency if a computer was named."""
    shown = (*described, *([T2] if sweep.computer is not None else []))
    rows = tuple(tuple(write(cell) for _, write in shown) for cell in cells)
    return TableView(key, title, tuple(column for column, _ in shown), rows, tuple(notes))
