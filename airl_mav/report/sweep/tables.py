"""A sweep in words and text cells: the terminal, the Markdown file and the page show the same."""

from __future__ import annotations

from airl_mav.report.tables import NONE, Column, TableView
from airl_mav.sweep.summary import Cell, Sweep, paper_best
from airl_mav.sweep.trial import training_of, trials


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


def percent(share: float) -> str:
    """Return a share as a number of percent."""
    return f"{100.0 * share:.1f}"


def cells_table(sweep: Sweep, arena: str) -> TableView:
    """Return the cells of an arena, the best first; those without a result last."""
    timed = sweep.computer is not None
    columns = (
        Column("network", number=False),
        Column("success", "%"),
        Column("std"),
        Column("95 % interval"),
        Column("seeds"),
        Column("time", "s"),
        Column("distance", "m", page_only=True),
        Column("energy", "kJ", page_only=True),
        Column("best after", page_only=True),
        Column("parameters", page_only=True),
        Column("MACs"),
        *([Column("t2, estimated", "ms")] if timed else []),
    )
    cells = sorted(sweep.of(arena), key=lambda c: (-(c.success_rate.value or -1.0), c.macs))
    rows = tuple(_row(cell, timed) for cell in cells)
    notes = [
        "Network: layers x filters. Success: mean over the training seeds, each of the same "
        "flights; std: over the seeds. Interval: the wider of Student's t over the seeds and "
        "Wilson's over all flights. Time, distance, energy: means over the flights that reached "
        "the goal. Best after: decisions."
    ]
    if timed:
        notes.append(_estimate_note(sweep))
    return TableView(f"cells-{arena}", f"All networks in {arena}", columns, rows, tuple(notes))


def _row(cell: Cell, timed: bool) -> tuple[str, ...]:
    rate = cell.success_rate
    interval = NONE
    if rate.low is not None and rate.high is not None:
        interval = f"{percent(rate.low)} … {percent(rate.high)}"
    return (
        cell.network,
        NONE if rate.value is None else percent(rate.value),
        NONE if cell.success_std is None else percent(cell.success_std),
        interval,
        f"{rate.n}" if rate.n == cell.planned else f"{rate.n} of {cell.planned}",
        NONE if cell.flight_time_s is None else f"{cell.flight_time_s:.2f}",
        NONE if cell.distance_m is None else f"{cell.distance_m:.1f}",
        NONE if cell.energy_j is None else f"{cell.energy_j / 1e3:.2f}",
        NONE if cell.decisions is None else f"{cell.decisions:,.0f}",
        count(cell.parameters),
        count(cell.macs),
        *([t2_ms(cell.t2_ms)] if timed else []),
    )


def _estimate_note(sweep: Sweep) -> str:
    assert sweep.computer is not None  # noqa: S101 (asked before)
    return (
        f"t2 on {sweep.computer.name}: estimated, in proportion to the multiply-accumulates of the "
        "workload nearest in its profile; nothing was measured."
    )


def best_in_words(sweep: Sweep, arena: str) -> list[str]:
    """Return which network was best in an arena, how sure that is, and the paper's."""
    best, paper = sweep.best(arena), paper_best(arena)
    if best is None:
        return ["No trial has ended yet."]
    rate = best.success_rate
    assert rate.value is not None and rate.low is not None and rate.high is not None  # noqa: S101
    seeds = "1 training seed" if rate.n == 1 else f"{rate.n} training seeds"
    lines = [
        f"Best: {best.network} with {percent(rate.value)} % "
        f"({percent(rate.low)} … {percent(rate.high)} %, {seeds}, "
        f"{sum(r.episodes for r in best.results):,} flights)."
    ]
    known = [cell for cell in sweep.of(arena) if cell.results]
    rivals = sweep.rivals(arena)
    if rivals:
        told = ", ".join(cell.network for cell in rivals)
        lines.append(
            f"Within its interval, too: {told} ({len(rivals)} of {len(known) - 1}). The best of "
            "many is also the luckiest: its own figure flatters it."
        )
    if paper is not None:
        lines.append(f"The paper's best: {paper[0]} with {100.0 * paper[1]:.0f} %.")
    return lines


def fact_rows(sweep: Sweep) -> tuple[tuple[str, str], ...]:
    """Return what was searched and how, as (term, text)."""
    config = sweep.config
    training = training_of(config, trials(config)[0])
    environment, judged = training.environment, config.evaluation
    rows = [
        ("what", config.description),
        ("trials", f"{sweep.ended} of {sweep.planned} ended"),
        (
            "networks",
            "; ".join(
                f"{grid.name}: layers {_listed(grid.layers)}, filters {_listed(grid.filters)}"
                for grid in config.grids
            ),
        ),
        ("training seeds", _listed(config.seeds)),
        ("training", f"{training.algorithm.name}, {training.steps:,} decisions each"),
        (
            "image",
            f"{environment.image_width_px}x{environment.image_height_px} px, "
            f"layout {environment.layout}, actions {environment.actions}",
        ),
        (
            "judged by",
            f"{judged.episodes:,} flights each, seeds {judged.seed} to "
            f"{judged.seed + judged.episodes - 1}, level gym",
        ),
    ]
    if sweep.computer is not None:
        rows.append(("computer", f"{sweep.computer.name} – {sweep.computer.profile.description}"))
    return tuple(rows)


def _listed(numbers: tuple[int, ...]) -> str:
    return ", ".join(f"{number}" for number in numbers)
