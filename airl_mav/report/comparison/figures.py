"""Figures of a comparison: contrasts, latency distributions, energy, single seeds."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from airl_mav.arena.draw import draw_arena
from airl_mav.core.constants import US_PER_MS
from airl_mav.flight import judge, statistics
from airl_mav.latency.stages import ALL_STAGES, Samples
from airl_mav.rehearsal.run_folder import LoadedRun, arena_of
from airl_mav.report import theme
from airl_mav.report.comparison.build import samples_of, tests_of
from airl_mav.report.comparison.comparison_model import ComparedRun, Comparison, Contrast
from airl_mav.report.comparison.tables import contrast_head, published_change
from airl_mav.report.document import NONE, OUTCOME_LABELS
from airl_mav.report.measures import COMPUTER_ENERGY, DISTANCE, ENERGY, MEASURES, rate_digits
from airl_mav.report.run_figures import LONG_TAIL, OUTCOME_MARKERS, RunFlights, path_points

ROW_IN = 0.5

CDF_STAGES = ("t2", "end_to_end")
"""Stages with a figure of cumulative distributions."""

CDF_POINTS = 400
"""Maximum number of steps of a distribution; more add size without visible benefit."""

NAME_COLUMNS = 26
"""Maximum line length of a name beside an axis [characters]."""

Runs = Mapping[str, LoadedRun]


def contrast_pictures(
    prefix: str, comparison: Comparison, contrasts: Sequence[Contrast]
) -> list[theme.FigureImage]:
    """Draw contrasts with intervals and published values, one picture per measure."""
    names = [contrast_head(comparison, each) for each in contrasts]
    pictures = []
    for measure in MEASURES:
        figure = theme.new_figure(4.4, 1.05 + ROW_IN * len(contrasts))
        ax: Axes = figure.subplots()
        ends: list[float] = [0.0]
        for row, contrast in enumerate(contrasts):
            change = measure.change(contrast.paired)
            if (told := published_change(contrast, measure)) is not None:
                ends.append(told)
                ax.plot(told, row, "x", ms=6, mew=1.6, color=theme.MARK, zorder=2)
            ends += _draw_estimate(ax, row, change.difference)
        _finish_rows(ax, names, ends)
        unit = "percentage points" if measure.difference_unit == "points" else "%"
        theme.label_axes(ax, f"difference [{unit}]", title=measure.title)
        alt = f"Difference in {measure.title} with intervals: {', '.join(names)}"
        pictures.append(theme.render(figure, f"{prefix}-{measure.key.replace('_', '-')}", alt))
    return pictures


def _draw_estimate(ax: Axes, row: int, estimate: statistics.Estimate) -> list[float]:
    """Draw an estimate with its interval and numbers; return the values the axis must include."""
    n = f"n = {estimate.n:,}"
    ax.annotate(
        n if estimate.value is None else f"{estimate.value:+.2f}, {n}",
        (1.0, row - 0.15),
        xycoords=("axes fraction", "data"),
        ha="right",
        va="bottom",
        fontsize=8,
        color=theme.MARK,
    )
    if estimate.value is None:
        return []
    ends = [estimate.value]
    if estimate.low is not None and estimate.high is not None:
        ends += [estimate.low, estimate.high]
        ax.plot(ends[1:], [row, row], color=theme.SERIES, lw=2.2, solid_capstyle="butt")
    ax.plot(estimate.value, row, "o", ms=6, color=theme.SERIES, mec=theme.PAPER, mew=1.0, zorder=4)
    return ends


def _finish_rows(ax: Axes, names: Sequence[str], ends: Sequence[float]) -> None:
    """Set up axes of rows: names from top to bottom, a line at zero, limits around all ends."""
    ax.axvline(0.0, color=theme.MUTED, lw=1.0, zorder=1)
    ax.set_yticks(range(len(names)), names)
    ax.set_ylim(len(names) - 0.5, -0.65)
    # Rows without a difference still require a non-zero axis range.
    room = 0.08 * (max(ends) - min(ends)) or 1.0
    ax.set_xlim(min(ends) - room, max(ends) + room)
    theme.plain_axes(ax)
    ax.grid(False, axis="y")
    ax.tick_params(axis="y", labelsize=8.5, labelcolor=theme.INK)
    ax.spines["bottom"].set_color(theme.RULE)


# --- latency


def latency_pictures(comparison: Comparison, runs: Runs) -> list[theme.FigureImage]:
    """Draw the cumulative distributions of all runs, one picture per stage with samples."""
    pooled = {name: samples_of(run) for name, run in runs.items()}
    pictures = []
    for stage in (stage for stage in ALL_STAGES if stage.key in CDF_STAGES):
        having = [run for run in comparison.runs if pooled[run.name][stage.key].size]
        if not having:
            continue
        figure = theme.new_figure(5.2, 3.2 + 0.2 * len(having))
        ax: Axes = figure.subplots()
        medians, ends = [], []
        for number, run in enumerate(comparison.runs):
            if run not in having:
                continue
            at_ms, share = cumulated(pooled[run.name][stage.key])
            colour, dashes = theme.line_style(number)
            n = run.stages[stage.key].n
            label = f"{run.heading} (n = {n:,})"
            ax.step(at_ms, share, where="post", color=colour, ls=dashes, lw=1.6, label=label)
            medians.append(float(np.median(at_ms)))
            ends += [float(at_ms[0]), float(at_ms[-1])]
        if min(ends) > 0.0 and max(ends) > LONG_TAIL * min(medians):
            theme.logarithmic(ax, "x")
        else:
            ax.set_xlim(left=0.0)
        ax.set_ylim(0.0, 104.0)
        ax.set_yticks([0, 25, 50, 75, 100])
        theme.label_axes(ax, "ms", "decisions that took no longer [%]", stage.title)
        theme.plain_axes(ax)
        theme.legend_below(figure, 1, handlelength=3)
        told = ", ".join(run.heading for run in having)
        alt = f"Cumulated distributions of {stage.title}: {told}"
        name = f"{comparison.kind}-{stage.key.replace('_', '-')}"
        pictures.append(theme.render(figure, name, alt))
    return pictures


def cumulated(samples: Samples) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the cumulative distribution of durations (n,) [µs]: times [ms] and shares [%]."""
    values = np.sort(samples) / US_PER_MS
    count = min(len(values), CDF_POINTS)
    rank = np.unique(np.linspace(0, len(values) - 1, count).astype(int))
    at = values[rank]
    share = 100.0 * (rank + 1) / len(values)
    return np.concatenate([at[:1], at]), np.concatenate([[0.0], share])


# --- energy


def energy_picture(comparison: Comparison) -> theme.FigureImage:
    """Draw the median energy of a successful flight, split into airframe and computer."""
    runs = [run for run in comparison.runs if run.quality.energy_j.value is not None]
    figure = theme.new_figure(6.4, 1.3 + 0.55 * len(runs))
    ax: Axes = figure.subplots()
    airframe, computer = (
        [measure.scale * (measure.of(run.quality).value or 0.0) for run in runs]
        for measure in (ENERGY, COMPUTER_ENERGY)
    )
    rows = np.arange(len(runs))
    ax.barh(rows, airframe, height=0.55, color=theme.SERIES, label="airframe")
    ax.barh(rows, computer, left=airframe, height=0.55, color=theme.SERIES_SOFT, label="computer")
    for row, (a, c) in enumerate(zip(airframe, computer, strict=True)):
        share = 100.0 * c / (a + c) if a + c else 0.0
        ax.annotate(
            f"{a:.2f} + {c:.2f} kJ, computer {share:.1f} %",
            (a + c, row),
            xytext=(4, 0),
            textcoords="offset points",
            va="center",
            fontsize=8,
            color=theme.INK,
        )
    names = ["\n".join(textwrap.wrap(run.heading, NAME_COLUMNS)) for run in runs]
    ax.set_yticks(rows, names)
    ax.set_ylim(len(runs) - 0.5, -0.5)
    widest = max((a + c for a, c in zip(airframe, computer, strict=True)), default=1.0)
    ax.set_xlim(0.0, 1.55 * widest)
    theme.label_axes(ax, "median energy of a flight that reached the goal [kJ]")
    theme.plain_axes(ax)
    ax.grid(False, axis="y")
    ax.tick_params(axis="y", labelsize=8.5, labelcolor=theme.INK)
    ax.spines["bottom"].set_color(theme.RULE)
    theme.legend_below(figure, 2)
    told = ", ".join(run.heading for run in runs)
    return theme.render(
        figure, f"{comparison.kind}-energy", f"Energy of airframe and computer: {told}"
    )


# --- flights


def flight_panels(
    compared: Sequence[ComparedRun], runs: Runs, most: int | None = None
) -> list[RunFlights]:
    """Return map panels with the first `most` flights of each run; None = all flights."""
    panels = []
    for figures in compared:
        run = runs[figures.name]
        tests = tests_of(run)[:most]
        if not tests:
            continue
        rate, path = figures.quality.success_rate, figures.quality.distance_m
        if len(tests) < rate.n:
            reached = sum(episode.outcome is judge.Outcome.SUCCESS for episode in tests)
            detail = f"{len(tests)} flights, {reached} reached the goal"
        else:
            success = NONE if rate.value is None else f"{100 * rate.value:.{rate_digits(rate)}f} %"
            told = f"{path.value:.1f} m" if path.value is not None else NONE
            detail = f"{success} of {rate.n:,} reached the goal, median {DISTANCE.title} {told}"
        arena = arena_of(run, tests[0])
        panels.append(RunFlights(figures.heading, detail, tests, run.trajectories, arena))
    return panels


def seed_picture(
    name: str, compared: Sequence[ComparedRun], runs: Runs, seed: int
) -> theme.FigureImage:
    """Draw a map of several runs' flights of a seed."""
    figure = theme.new_figure(4.2, 4.6)
    ax: Axes = figure.subplots()
    flights = [
        (number, figures, flight)
        for number, figures in enumerate(compared)
        for flight in tests_of(runs[figures.name])
        if flight.seed == seed
    ]
    handles: list[Line2D] = []
    for number, figures, flight in flights:
        run = runs[figures.name]
        if not handles and (arena := arena_of(run, flight)) is not None:
            draw_arena(arena, ax, goal_radius_m=flight.goal_radius_m)
        style, path = theme.line_style(number), run.trajectories.get(flight.index)
        told = OUTCOME_LABELS[flight.outcome]
        if flight.outcome is judge.Outcome.SUCCESS and flight.quality is not None:
            told = f"{flight.quality.flight_time_s:.1f} s"
        points = np.zeros((0, 2)) if path is None else path_points(path, flight.ended_us)
        (line,) = ax.plot(
            *points.T,
            color=style.colour,
            ls=style.dashes,
            lw=1.8,
            zorder=4,
            label=f"{figures.mark}: {told}",
        )
        handles.append(line)
        if len(points):
            marker = OUTCOME_MARKERS[flight.outcome]
            ax.plot(
                *points[-1], marker, ms=7, color=style.colour, mec=theme.PAPER, mew=0.8, zorder=5
            )
    theme.plain_axes(ax, grid=False)
    theme.label_axes(ax, "east of the start [m]", "north of the start [m]", f"seed {seed}")
    theme.legend_below(figure, 3, handles=handles, columnspacing=1.0)
    told = ", ".join(figures.label for _, figures, _ in flights)
    return theme.render(figure, name, f"The flights of seed {seed} from above: {told}")
