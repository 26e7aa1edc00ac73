"""The figures of a hardware gap: the gaps with their intervals, the flights, the worst seeds."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure, SubFigure

from airl_mav.arena.draw import draw_arena
from airl_mav.arena.generate import generate
from airl_mav.arena.geometry import Arena
from airl_mav.flight.judge import Outcome
from airl_mav.flight.record import EpisodeRecord
from airl_mav.profiles.arena import ArenaSpec
from airl_mav.profiles.loading import load_profile
from airl_mav.profiles.vehicle import VehicleProfile
from airl_mav.report.fan import Panel
from airl_mav.report.figures import OUTCOME_MARKERS, quiet
from airl_mav.report.gap.build import OVERLAID, ArenaGap, Flown, Role
from airl_mav.report.gap.tables import change_of, median_of_gap, paper_gap
from airl_mav.report.intervals import draw_estimate, finish_rows
from airl_mav.report.ladder.tables import MEASURES, Measure
from airl_mav.report.overview import path_points
from airl_mav.report.palette import look
from airl_mav.report.tables import OUTCOME_WORDS
from airl_mav.report.theme import (
    INK,
    MARK,
    MUTED,
    PAPER,
    SERIES,
    Picture,
    new_figure,
    render,
    render_png,
)

_ROW_IN = 0.5
"""Height of a gap in a figure."""

WORST_ROLES: tuple[Role, ...] = ("reference", "target", "mitigated")
"""What is drawn of the worst seeds."""

_SHEET_COLUMNS = 3


def gap_picture(arena: ArenaGap, measure: Measure) -> Picture:
    """Draw all gaps of one measure: a dot with its interval, median and the paper's beside it."""
    figure = new_figure(4.4, 1.05 + _ROW_IN * len(arena.gaps))
    _draw_gaps(figure, arena, measure)
    told = ", ".join(f"{gap.letters} ({gap.short})" for gap in arena.gaps)
    return render(
        figure,
        f"gap-{_name(arena)}-{measure.key.replace('_', '-')}",
        f"Hardware gap in {measure.title} with intervals: {told}",
    )


def gap_sheet(arena: ArenaGap) -> bytes:
    """Draw the gaps of all measures on one sheet; return the PNG."""
    figure = new_figure(8.8, 2.0 * (1.05 + _ROW_IN * len(arena.gaps)))
    parts = np.ravel(figure.subfigures(2, 2, squeeze=False))
    for part, measure in zip(parts, MEASURES, strict=True):
        part.set_facecolor(PAPER)
        _draw_gaps(part, arena, measure)
    return render_png(figure)


def _draw_gaps(figure: Figure | SubFigure, arena: ArenaGap, measure: Measure) -> None:
    """Draw one measure: gaps from top to bottom, no gap as the line of zero."""
    ax = figure.subplots()
    ends: list[float] = []
    for row, gap in enumerate(arena.gaps):
        d, median = change_of(gap.gap, measure).difference, median_of_gap(gap.gap, measure)
        told = f"n = {d.n:,}" if d.value is None else f"{d.value:+.1f}, n = {d.n:,}"
        paper = paper_gap(gap.paper, measure)
        if paper is not None:
            ends.append(paper)
            ax.plot(paper, row, "x", ms=6, mew=1.6, color=MARK, zorder=2)
        if median is not None and median.value is not None:
            ends.append(median.value)
            ax.plot(median.value, row, "D", ms=5, color="none", mec=SERIES, mew=1.1, zorder=3)
        ends += draw_estimate(ax, row, d, told, MUTED)
    unit = "percentage points" if measure.difference_unit == "points" else "%"
    names = [f"{gap.letters}\n{gap.short}" for gap in arena.gaps]
    finish_rows(ax, names, ends, measure.title, f"gap [{unit}]")


def flight_panels(arena: ArenaGap) -> list[Panel]:
    """Return the first flights of every column, to be drawn over each other."""
    panels = []
    for column in arena.columns:
        tests = [e for e in column.episodes if e.outcome is not Outcome.ABORTED][:OVERLAID]
        if not tests:
            continue
        reached = sum(episode.outcome is Outcome.SUCCESS for episode in tests)
        panels.append(
            Panel(
                title=column.name,
                detail=f"{len(tests)} flights, {reached} reached the goal",
                episodes=tests,
                paths={e.index: column.paths[e.seed] for e in tests if e.seed in column.paths},
                arena=arena_of(tests[0], column),
            )
        )
    return panels


def arena_of(episode: EpisodeRecord, column: Flown) -> Arena:
    """Make the arena of a flight again. Raises UsageError when a profile is not there any more."""
    vehicle = load_profile("vehicles", column.setup.vehicle.name, VehicleProfile)
    return generate(
        load_profile("arenas", episode.arena, ArenaSpec),
        episode.arena_seed,
        name=episode.arena,
        vehicle_width_m=vehicle.body.width_m,
    )


def worst_pictures(arena: ArenaGap) -> list[Picture]:
    """Draw the seeds that lost most: the flights of reference, target and mitigated policy."""
    pictures = []
    for seed in arena.worst:
        figure = new_figure(4.2, 4.6)
        _draw_seed(figure, arena, seed)
        alt = f"The flights of seed {seed} from above, on the reference and on the target"
        pictures.append(render(figure, f"worst-{_name(arena)}-{seed}", alt))
    return pictures


def worst_sheet(arena: ArenaGap) -> bytes:
    """Draw the seeds that lost most, one or more, on one sheet; return the PNG."""
    columns = min(_SHEET_COLUMNS, len(arena.worst))
    rows = -(-len(arena.worst) // columns)
    figure = new_figure(4.2 * columns, 4.6 * rows)
    parts = np.ravel(figure.subfigures(rows, columns, squeeze=False))
    for part in parts:
        part.set_facecolor(PAPER)
    for part, seed in zip(parts, arena.worst, strict=False):
        _draw_seed(part, arena, seed)
    return render_png(figure)


def _draw_seed(figure: Figure | SubFigure, arena: ArenaGap, seed: int) -> None:
    """Draw the flights of one seed over their arena, as it was when they began."""
    ax = figure.subplots()
    flights = _flights(arena, seed)
    if flights:
        column, first = flights[0]
        draw_arena(arena_of(first, column), ax, goal_radius_m=first.goal_radius_m)
    handles = []
    for index, (column, flight) in enumerate(flights):
        style, path = look(index), column.paths.get(seed)
        words = OUTCOME_WORDS[flight.outcome]
        if flight.outcome is Outcome.SUCCESS and flight.quality is not None:
            words = f"{flight.quality.flight_time_s:.1f} s"
        label = f"{column.letter}: {words}"
        points = np.zeros((0, 2)) if path is None else path_points(path, flight.ended_us)
        (line,) = ax.plot(
            *points.T, color=style.colour, ls=style.dashes, lw=1.8, zorder=4, label=label
        )
        handles.append(line)
        if len(points):
            marker = OUTCOME_MARKERS[flight.outcome]
            ax.plot(*points[-1], marker, ms=7, color=style.colour, mec=PAPER, mew=0.8, zorder=5)
    quiet(ax, grid=False)
    ax.set_xlabel("east of the start [m]", color=MUTED, fontsize=8.5)
    ax.set_ylabel("north of the start [m]", color=MUTED, fontsize=8.5)
    ax.set_title(f"seed {seed}", loc="left", fontsize=10.5, color=INK, pad=6)
    figure.legend(
        handles=handles,
        loc="outside lower left",
        ncols=3,
        frameon=False,
        fontsize=8,
        labelcolor=INK,
        columnspacing=1.0,
    )


def _flights(arena: ArenaGap, seed: int) -> list[tuple[Flown, EpisodeRecord]]:
    """Return the flights of a seed that are drawn."""
    columns = [arena.column(role) for role in WORST_ROLES]
    return [
        (column, episode)
        for column in columns
        if column is not None
        for episode in column.episodes
        if episode.seed == seed and episode.outcome is not Outcome.ABORTED
    ]


def _name(arena: ArenaGap) -> str:
    return Path(arena.arena).stem
