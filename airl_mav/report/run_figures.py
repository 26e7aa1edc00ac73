"""Figures of runs: latency by stage, maps of single flights and of many flights."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PathCollection
from matplotlib.colors import Colormap, ListedColormap
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from airl_mav.arena.draw import FLOOR_COLOUR, GOAL_COLOUR, START_COLOUR, draw_arena
from airl_mav.arena.geometry import Arena, Bounds
from airl_mav.core.constants import US_PER_MS
from airl_mav.flight.episode_record import EpisodeRecord
from airl_mav.flight.judge import Outcome
from airl_mav.flight.trajectory import Trajectory
from airl_mav.latency.stages import Samples, Stage, Summary
from airl_mav.rehearsal.run_folder import LoadedRun
from airl_mav.report import document, theme

LONG_TAIL = 30.0
"""Ratio of maximum to median above which the axis is logarithmic."""

OUTCOME_COLOURS = {
    Outcome.SUCCESS: "#1b8a3f",
    Outcome.COLLISION: "#c0261c",
    Outcome.TIMEOUT: "#a86400",
    Outcome.BATTERY: "#7b3fa0",
    Outcome.ABORTED: "#68707a",
}
OUTCOME_MARKERS = {
    Outcome.SUCCESS: "o",
    Outcome.COLLISION: "X",
    Outcome.TIMEOUT: "s",
    Outcome.BATTERY: "D",
    Outcome.ABORTED: "P",
}


def speed_colours() -> Colormap:
    """Return viridis without its pale end, which is invisible on the floor's colour."""
    return ListedColormap(colormaps["viridis"](np.linspace(0.05, 0.9, 256)), name="speed")


def latency_figure(stage: Stage, samples: Samples, summary: Summary) -> theme.FigureImage:
    """Draw a stage's durations [µs]: a histogram, and a cumulative curve with percentiles."""
    margins = theme.Margins(left=0.58, right=0.14, bottom=0.42, top=0.27, between=0.1)
    figure, (top, bottom) = theme.stacked_axes(2, 4.2, 2.6, margins, height_ratios=(1.1, 1.0))
    values = np.sort(samples) / US_PER_MS
    edges = _bin_edges(values)
    top.hist(values, edges, color=theme.SERIES_SOFT, edgecolor=theme.SERIES, linewidth=0.4)
    share = 100.0 * np.arange(1, len(values) + 1) / len(values)
    bottom.step(
        [edges[0], *values, edges[-1]],
        [0.0, *share, 100.0],
        where="post",
        color=theme.SERIES,
        linewidth=1.4,
    )
    marks = []
    for name, level, at_us in (
        ("p50", 50.0, summary.p50),
        ("p90", 90.0, summary.p90),
        ("p99", 99.0, summary.p99),
    ):
        if at_us is not None:
            marks.append(f"{name} {document.ms(at_us)}")
            bottom.plot(
                at_us / US_PER_MS, level, "o", ms=4, color=theme.MARK, clip_on=False, zorder=3
            )
    theme.label_axes(top, y="decisions", title=stage.title)
    told = "   ".join(marks)
    top.set_title(told, loc="right", y=1.0, fontsize=8.5, color=theme.MARK, pad=6)
    top.yaxis.set_major_locator(MaxNLocator(3, integer=True))
    theme.label_axes(bottom, f"ms, n = {summary.n:,}", "share [%]")
    bottom.set_yticks([0, 50, 100])
    bottom.set_ylim(0, 104)
    if long_tail(values):
        theme.logarithmic(bottom, "x")
    else:
        bottom.xaxis.set_major_locator(MaxNLocator(5))
    for ax in (top, bottom):
        theme.plain_axes(ax)
    theme.share_grid((top, bottom))
    alt = f"Histogram and cumulated distribution of {stage.title}: {stage.meaning}"
    return theme.render(figure, f"latency-{stage.key.replace('_', '-')}", alt)


def long_tail(values: NDArray[np.float64]) -> bool:
    """Return True if sorted values require a logarithmic axis."""
    return bool(values[0] > 0.0 and values[-1] > LONG_TAIL * np.median(values))


def _bin_edges(values: NDArray[np.float64]) -> list[float]:
    """Return histogram edges of sorted values: about 2 sqrt(n) bins, always odd."""
    bins = int(np.clip(2.0 * math.sqrt(len(values)), 12, 40)) | 1
    low, high = float(values[0]), float(values[-1])
    if long_tail(values):
        return [float(edge) for edge in np.geomspace(low, high, bins + 1)]
    # A single duration, as in lockstep, requires a non-zero width.
    pad = 0.03 * (high - low) if high > low else max(0.1 * abs(high), 0.001)
    return [float(edge) for edge in np.linspace(low - pad, high + pad, bins + 1)]


def map_figure(
    episode: EpisodeRecord, trajectory: Trajectory | None, arena: Arena | None
) -> theme.FigureImage:
    """Draw a map of a flight over its arena, if known, in its state at the flight's end."""
    paths = {} if trajectory is None else {episode.index: trajectory}
    panel = RunFlights("", "", [episode], paths, arena)
    label = document.OUTCOME_LABELS[episode.outcome]
    alt = f"Flight {episode.index} from above: {label}, {episode.reason}"
    name = f"flight-{episode.index:03d}-map"
    return _draw_panel(name, alt, panel, _extent([panel]), width_in=5.2)


PATH_POINTS = 120
"""Maximum number of points of a path; more are not visible among hundreds of paths."""

OPAQUE_FLIGHTS = 25
"""Maximum number of paths drawn at full opacity; with more paths, opacity decreases."""

MARGIN_M = 1.0
"""Margin around walls and paths [m]."""


@dataclass(frozen=True)
class RunFlights:
    """Flights of one run."""

    title: str
    detail: str
    episodes: Sequence[EpisodeRecord]
    paths: Mapping[int, Trajectory]
    """Paths by episode index."""
    arena: Arena | None = None
    """Arena of one flight, for the walls; obstacles are drawn if all flights share the arena."""


@dataclass(frozen=True)
class _Extent:
    """Area shown by all panels [m]."""

    north: tuple[float, float]
    east: tuple[float, float]

    @property
    def tall(self) -> float:
        """Ratio of height to width, limited for the page."""
        tall = (self.north[1] - self.north[0]) / (self.east[1] - self.east[0])
        return min(max(tall, 0.45), 1.6)


def flight_pictures(prefix: str, panels: Sequence[RunFlights]) -> list[theme.FigureImage]:
    """Draw each panel as a picture with common axes; names are the prefix and a number."""
    extent = _extent(panels)
    return [
        _draw_panel(
            f"{prefix}-{number}",
            f"{len(panel.episodes)} flights from above, {panel.title}: {panel.detail}",
            panel,
            extent,
            width_in=4.4,
        )
        for number, panel in enumerate(panels, start=1)
    ]


def overview_picture(run: LoadedRun, arenas: Mapping[int, Arena]) -> theme.FigureImage:
    """Draw all flights of a run by outcome; `arenas` (by episode index) supply the walls."""
    bounds = {arena.bounds for arena in arenas.values()}
    arena = next(iter(arenas.values())) if len(bounds) == 1 else None
    panel = RunFlights("", "", run.episodes, run.trajectories, arena)
    alt = f"The paths of {len(run.episodes)} flights from above, coloured by how they ended"
    return _draw_panel("trajectories", alt, panel, _extent([panel]), width_in=4.6)


def _extent(panels: Sequence[RunFlights]) -> _Extent:
    low, high = np.zeros(2), np.zeros(2)
    for panel in panels:
        points = [np.array([flight.goal[:2] for flight in panel.episodes])]
        if panel.arena is not None:
            b = panel.arena.bounds
            points.append(np.array([(b.north_min, b.east_min), (b.north_max, b.east_max)]))
        points += [
            path_points(panel.paths[flight.index], flight.ended_us)[:, ::-1]
            for flight in panel.episodes
            if flight.index in panel.paths
        ]
        stacked = np.concatenate(points)
        low, high = np.minimum(low, stacked.min(axis=0)), np.maximum(high, stacked.max(axis=0))
    (north_min, east_min), (north_max, east_max) = low - MARGIN_M, high + MARGIN_M
    return _Extent((float(north_min), float(north_max)), (float(east_min), float(east_max)))


def _draw_panel(
    name: str, alt: str, panel: RunFlights, extent: _Extent, *, width_in: float
) -> theme.FigureImage:
    """Draw one panel, with obstacles only if all its flights share an arena seed."""
    figure = theme.new_figure(width_in, 1.05 + 0.9 * width_in * extent.tall)
    ax: Axes = figure.subplots()
    seeds = {flight.arena_seed for flight in panel.episodes}
    if panel.arena is not None and seeds == {panel.arena.seed}:
        first, *others = panel.episodes
        # Moving obstacles of several flights are drawn at their start.
        ended_us = 0 if others else first.ended_us - first.started_us
        draw_arena(panel.arena, ax, ended_us, goal_radius_m=first.goal_radius_m)
    else:
        _draw_ground(ax, None if panel.arena is None else panel.arena.bounds)
        goals = np.array([(flight.goal[1], flight.goal[0]) for flight in panel.episodes])
        opacity = _opacity(len(goals))
        look = {"s": 60.0 * opacity + 6.0, "color": GOAL_COLOUR, "zorder": 4, "alpha": 0.7}
        _mark(ax, goals, marker="*", **look)
    # Failed flights are drawn on top.
    ranked = sorted(panel.episodes, key=lambda flight: flight.outcome is not Outcome.SUCCESS)
    for outcome in dict.fromkeys(flight.outcome for flight in ranked):
        flights = [flight for flight in ranked if flight.outcome is outcome]
        _draw_paths(ax, outcome, flights, panel.paths)
    ax.set_aspect("equal", adjustable="box")
    ax.set_anchor("N")
    ax.set_xlim(extent.east)
    ax.set_ylim(extent.north)
    theme.plain_axes(ax, grid=False)
    theme.label_axes(ax, "east of the start [m]", "north of the start [m]")
    if panel.title:
        figure.suptitle(panel.title, x=0.02, ha="left", fontsize=10.5, color=theme.INK)
        ax.set_title(panel.detail, loc="left", fontsize=8.5, color=theme.MUTED, pad=6)
    theme.legend_below(
        figure,
        4,
        handles=_legend(panel.episodes),
        fontsize=7.5,
        handletextpad=0.3,
        columnspacing=0.9,
    )
    return theme.render(figure, name, alt)


def _draw_ground(ax: Axes, bounds: Bounds | None) -> None:
    if bounds is not None:
        b = bounds
        size = b.east_max - b.east_min, b.north_max - b.north_min
        corner = (b.east_min, b.north_min)
        ax.add_patch(Rectangle(corner, *size, facecolor=FLOOR_COLOUR, edgecolor=theme.RULE, lw=1.5))
    ax.plot(0.0, 0.0, marker="^", ms=10, color=START_COLOUR, mec="white", mew=0.8, zorder=5)


def _draw_paths(
    ax: Axes, outcome: Outcome, flights: Sequence[EpisodeRecord], paths: Mapping[int, Trajectory]
) -> None:
    """Draw flights with one outcome as thin lines; failed flights end with a mark."""
    failed = outcome is not Outcome.SUCCESS
    colour = OUTCOME_COLOURS[outcome]
    lines = [
        path_points(paths[flight.index], flight.ended_us)
        for flight in flights
        if flight.index in paths and len(paths[flight.index]) > 1
    ]
    lines = [line for line in lines if len(line) > 1]
    # Hundreds of lines are smaller as pixels than as shapes.
    collection = LineCollection(
        lines,
        colors=colour,
        linewidths=1.2,
        alpha=_opacity(len(lines)),
        zorder=2.5 + failed,
        rasterized=True,
    )
    ax.add_collection(collection)
    if failed and lines:
        ends = np.stack([line[-1] for line in lines])
        _mark(ax, ends, marker=OUTCOME_MARKERS[outcome], s=34, color=colour, zorder=4.5)


def _opacity(count: int) -> float:
    """Return the opacity of each of `count` overlapping elements."""
    return min(0.9, max(0.12, math.sqrt(OPAQUE_FLIGHTS / max(1, count))))


def _mark(ax: Axes, points: NDArray[np.float64], **look: Any) -> PathCollection:
    return ax.scatter(*points.T, edgecolors="white", linewidths=0.6, rasterized=True, **look)


def path_points(path: Trajectory, ended_us: int) -> NDArray[np.float64]:
    """Return up to `PATH_POINTS` points (k, 2), east and north, of a path until the verdict."""
    inside = np.flatnonzero(path.time_us <= ended_us)
    keep = np.unique(np.linspace(0, len(inside) - 1, min(len(inside), PATH_POINTS)).astype(int))
    points: NDArray[np.float64] = path.position[inside[keep]][:, [1, 0]]
    return points


def _legend(episodes: Sequence[EpisodeRecord]) -> list[Line2D]:
    handles = [
        Line2D([], [], ls="none", marker="^", ms=8, color=START_COLOUR, label="start"),
        Line2D([], [], ls="none", marker="*", ms=9, color=GOAL_COLOUR, label="goal"),
    ]
    for outcome in OUTCOME_COLOURS:
        count = sum(episode.outcome is outcome for episode in episodes)
        if count:
            marker = "" if outcome is Outcome.SUCCESS else OUTCOME_MARKERS[outcome]
            label = f"{document.OUTCOME_LABELS[outcome]} ({count})"
            handles.append(
                Line2D([], [], color=OUTCOME_COLOURS[outcome], marker=marker, ms=5, label=label)
            )
    return handles
