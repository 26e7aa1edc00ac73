"""Page of an architecture search: the networks of each arena, and their cost."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from airl_mav.addons.sweep import summary
from airl_mav.addons.sweep.config import SweepConfig, training_of, trials
from airl_mav.core.machine import mixed_code
from airl_mav.report import document, heatmap, theme
from airl_mav.training.training_folder import TrainingFolder

Described = tuple[document.Column, Callable[[summary.NetworkSummary], str]]
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
        return document.NONE
    return f"{value:.0f}" if value >= 100 else f"{value:.3g}"


def percent(share: float | None) -> str:
    """Return a share as a number of percent."""
    return document.NONE if share is None else f"{100.0 * share:.1f}"


def interval(cell: summary.NetworkSummary) -> str:
    """Return the interval of a network's success in percent."""
    rate = cell.success_rate
    return document.NONE if rate.low is None else f"{percent(rate.low)} … {percent(rate.high)}"


def _seeds(cell: summary.NetworkSummary) -> str:
    n = cell.success_rate.n
    return f"{n}" if n == cell.planned else f"{n} of {cell.planned}"


def _mean(field: str, form: str, unit: float = 1.0) -> Callable[[summary.NetworkSummary], str]:
    """Return a formatter of a mean over the seeds, in a given unit."""

    def write(cell: summary.NetworkSummary) -> str:
        value: float | None = getattr(cell, field)
        return document.NONE if value is None else f"{value / unit:{form}}"

    return write


NETWORK: Described = (document.Column("network", number=False), lambda cell: cell.network)
MACS: Described = (document.Column("MACs"), lambda cell: count(cell.macs))
T2: Described = (document.Column("t2, estimated", "ms"), lambda cell: t2_ms(cell.t2_ms))

RESULTS: tuple[Described, ...] = (
    NETWORK,
    (document.Column("success", "%"), lambda cell: percent(cell.success_rate.value)),
    (document.Column("std"), lambda cell: percent(cell.success_std)),
    (document.Column("95 % interval"), interval),
    (document.Column("seeds"), _seeds),
    (document.Column("time", "s"), _mean("flight_time_s", ".2f")),
    (document.Column("distance", "m", page_only=True), _mean("distance_m", ".1f")),
    (document.Column("energy", "kJ", page_only=True), _mean("energy_j", ".2f", 1e3)),
    (document.Column("best after", page_only=True), _mean("decisions", ",.0f")),
    (document.Column("parameters", page_only=True), lambda cell: count(cell.parameters)),
    MACS,
)


def networks_table(sweep: summary.Sweep, arena: str) -> document.TableView:
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
    name: str, config: SweepConfig, computer: summary.Computer | None, path: Path, console: Console
) -> None:
    """Print a sweep's plan; UsageError if the folder contains other results."""
    sweep = summary.summarize(summary.SweepFolder(path, config), {}, computer)
    steps, episodes = config.training.steps, config.evaluation.episodes
    most = "at most " if config.training.selection.stop_at is not None else ""
    facts = [
        ("sweep", f"{name}: {config.description}"),
        ("folder", f"{path}"),
        ("trials", f"{sweep.planned}, of which {sweep.ended} have ended"),
        ("decisions", f"{most}{steps:,} each, {most}{steps * sweep.planned:,} in all"),
        ("evaluation", f"{episodes:,} flights each, {episodes * sweep.planned:,} in all"),
    ]
    document.print_facts(facts, console)
    planned: tuple[Described, ...] = (
        NETWORK,
        (document.Column("trials"), lambda cell: f"{cell.planned}"),
        (document.Column("decisions"), lambda cell: f"{steps * cell.planned:,}"),
        (document.Column("parameters"), lambda cell: count(cell.parameters)),
        MACS,
    )
    for arena in sweep.arenas:
        console.print()
        document.print_table(
            _table(sweep, f"plan-{arena}", arena, planned, sweep.of(arena)), console
        )


def _table(
    sweep: summary.Sweep,
    key: str,
    title: str,
    described: Sequence[Described],
    cells: Sequence[summary.NetworkSummary],
    notes: Sequence[str] = (),
) -> document.TableView:
    """Return a row for each network, with its latency if a computer was named."""
    shown = (*described, *([T2] if sweep.computer is not None else []))
    rows = tuple(tuple(write(cell) for _, write in shown) for cell in cells)
    return document.TableView(key, title, tuple(column for column, _ in shown), rows, tuple(notes))


def success_pictures(sweep: summary.Sweep, arena: str) -> list[theme.FigureImage]:
    """Draw the mean success rate of each network of an arena, with its standard deviation."""
    best = sweep.best(arena)
    known = [cell for cell in sweep.of(arena) if cell.success_rate.value is not None]
    rates = [cell.success_rate.value or 0.0 for cell in known]
    fields = [
        heatmap.Field(100.0 * rate, _success_text(cell), marked=cell is best)
        for cell, rate in zip(known, rates, strict=True)
    ]
    grid = next(grid for grid in sweep.config.grids if grid.name == arena)
    heat = heatmap.HeatMap(
        title=arena,
        rows=grid.layers,
        row_title="layers",
        columns=grid.filters,
        column_title="filters",
        fields={(c.layers, c.filters): field for c, field in zip(known, fields, strict=True)},
        unit="success [%]",
        limits=(min(10.0 * math.floor(10.0 * min(rates, default=0.0)), 90.0), 100.0),
        note="success, mean ± std over training seeds [%]",
    )
    told = ", ".join(f"{cell.network} {percent(cell.success_rate.value)} %" for cell in known)
    alt = f"Success by layers and filters in {arena}: {told}"
    return [heatmap.heat_picture(f"sweep-{arena}", alt, heat)]


def _success_text(cell: summary.NetworkSummary) -> str:
    text = percent(cell.success_rate.value)
    if cell.success_std is not None:
        text += f"\n± {percent(cell.success_std)}"
    elif len(cell.results) < cell.planned:
        text += f"\n{len(cell.results)} of {cell.planned}"
    return text


def curves(sweep: summary.Sweep) -> list[theme.FigureImage]:
    """Draw success and reward of each network over decisions, mean over the training seeds."""
    figure = theme.new_figure(3.2 * len(sweep.arenas), 5.0)
    axes = figure.subplots(2, len(sweep.arenas), sharex=True, sharey="row", squeeze=False)
    for arena, column in zip(sweep.arenas, axes.T, strict=True):
        best = sweep.best(arena)
        for cell in sweep.of(arena):
            folders = [sweep.folder.trial_path(each.trial) for each in cell.results]
            runs = [TrainingFolder(folder).evaluations() for folder in folders]
            if not runs or not all(runs):
                continue
            # Old evaluations have no reward; a seed that ended early has fewer evaluations.
            least = min(len(run) for run in runs)
            seen = [[(e.steps, 100.0 * e.success_rate, e.reward) for e in r[:least]] for r in runs]
            steps, *means = np.array(seen, np.float64).mean(axis=0).T
            style: dict[str, Any] = {"color": theme.SERIES, "alpha": 0.5, "lw": 0.9}
            if cell is best:
                style = {"color": theme.MARK, "lw": 2.0, "zorder": 3, "label": cell.network}
            for ax, values in zip(column, means, strict=True):
                ax.plot(steps / 1e3, values, **style)
        theme.label_axes(column[0], title=arena)
        theme.label_axes(column[1], "decisions, thousands")
        if column[0].lines:
            column[0].legend(frameon=False, fontsize=8, labelcolor=theme.INK, loc="lower right")
    for ax, label in zip(axes[:, 0], ("success on the selection seeds [%]", "reward"), strict=True):
        theme.label_axes(ax, y=label)
    for ax in axes.flat:
        theme.plain_axes(ax)
    alt = "Success and reward of each network over decisions; the best network is highlighted"
    return [theme.render(figure, "sweep-curves", alt)]


def document_of(sweep: summary.Sweep) -> document.Document:
    """Return the page of a sweep with at least one finished trial."""
    sections = [
        document.Section(
            arena,
            sentences=best_sentences(sweep, arena),
            tables=(networks_table(sweep, arena),),
            draw=partial(success_pictures, sweep, arena),
        )
        for arena in sweep.arenas
    ]
    sections.append(document.Section("Learning curves", draw=partial(curves, sweep)))
    made = sweep.made
    begun = f"{made['created_utc']}".replace("T", " ").replace("+00:00", " UTC")
    return document.Document(
        name="sweep",
        title=sweep.config.description,
        kicker=f"Architecture search · begun {begun} · {sweep.ended} of {sweep.planned} trials",
        lead="Templates of L convolutions x F filters, and as many dense layers of as many units.",
        headlines=tuple(_headline(sweep, arena) for arena in sweep.arenas),
        sections=tuple(sections),
        facts=sweep_facts(sweep),
        facts_title="What was searched",
        provenance=(
            ("command", f"{made['command']}"),
            *document.provenance_facts(made["machine"], made["git"], made["versions"]),
        ),
        configurations=(
            ("the sweep", json.dumps(summary.as_data(sweep.config), indent=2, ensure_ascii=False)),
        ),
        footer=(
            f"airl-mav {made['versions'].get('airl-mav', '')} · figures as data in "
            f"{summary.SWEEP_FILE} beside this page; a trial's policy flies with airl-sitl "
            "--policy <trial>/policy"
        ),
    )


def best_sentences(sweep: summary.Sweep, arena: str) -> tuple[str, ...]:
    """Return sentences on an arena's best network, its interval, and the published one."""
    best, published = sweep.best(arena), summary.published_best(arena)
    if best is None:
        return ("No trial has ended yet.",)
    n = best.success_rate.n
    seeds = "1 training seed" if n == 1 else f"{n} training seeds"
    lines = [
        f"Best: {best.network} with {percent(best.success_rate.value)} % "
        f"({interval(best)} %, {seeds}, {sum(r.episodes for r in best.results):,} flights)."
    ]
    known = [cell for cell in sweep.of(arena) if cell.results]
    if rivals := sweep.rivals(arena):
        told = ", ".join(cell.network for cell in rivals)
        lines.append(
            f"Within its interval, too: {told} ({len(rivals)} of {len(known) - 1}). The best of "
            "many is also the luckiest: its own figure flatters it."
        )
    if published is not None:
        lines.append(f"The paper's best: {published[0]} with {100.0 * published[1]:.0f} %.")
    return tuple(lines)


def sweep_facts(sweep: summary.Sweep) -> document.Facts:
    """Return the facts of the search."""
    config = sweep.config
    training = training_of(config, trials(config)[0])
    environment, judged = training.environment, config.evaluation
    networks = (
        f"{grid.name}: layers {_listed(grid.layers)}, filters {_listed(grid.filters)}"
        for grid in config.grids
    )
    last = judged.seed + judged.episodes - 1
    rows = [
        ("trials", f"{sweep.ended} of {sweep.planned} ended"),
        ("networks", "; ".join(networks)),
        ("training seeds", _listed(config.seeds)),
        ("training", f"{training.algorithm.name}, {training.steps:,} decisions each"),
        (
            "image",
            f"{environment.image_width_px}x{environment.image_height_px} px, "
            f"layout {environment.layout}, actions {environment.actions}",
        ),
        *(("code", line) for line in mixed_code(r.code for c in sweep.cells for r in c.results)),
        (
            "judged by",
            f"{judged.episodes:,} flights each, seeds {judged.seed} to {last}, level gym",
        ),
    ]
    if sweep.computer is not None:
        rows.append(("computer", f"{sweep.computer.name} – {sweep.computer.profile.description}"))
    return tuple(rows)


def _listed(numbers: Sequence[int]) -> str:
    return ", ".join(f"{number}" for number in numbers)


def _headline(sweep: summary.Sweep, arena: str) -> document.Headline:
    best, published = sweep.best(arena), summary.published_best(arena)
    theirs = ""
    if published is not None:
        theirs = f"; the paper: {published[0]}, {100.0 * published[1]:.0f} %"
    if best is None:
        return document.Headline(arena, document.NONE, "", f"no trial has ended{theirs}")
    detail = f"{percent(best.success_rate.value)} % ({interval(best)}){theirs}"
    return document.Headline(arena, best.network, "", detail)
