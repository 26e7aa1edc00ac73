"""Figures of runs: latency by stage, maps of single flights and of many flights."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection, PathCollection
from matplotlib.colorbar import Colorbar
from matplotlib.colors import Colormap, ListedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Rectangle
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
PATH_SEGMENTS = 500
"""Maximum number of points of a drawn path; more add size without visible benefit."""
PATH_COLOURS = 24
"""Number of colour steps of a path; adjacent segments of one step form one line."""

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
    episode: EpisodeRecord, trajectory: Trajectory | None, arena: Arena | None, top_speed: float
) -> theme.FigureImage:
    """Draw a map of a flight over its arena, if known, in its state at the flight's end."""
    tall = 1.0
    if arena is not None:
        b = arena.bounds
        tall = (b.north_max - b.north_min) / (b.east_max - b.east_min)
    # The map is 4.15 inches wide; axis labels and legend need about one inch of height.
    figure = theme.new_figure(5.2, 1.0 + 4.15 * min(max(tall, 0.5), 1.6))
    ax = figure.add_subplot()
    if arena is not None:
        ended_us = episode.ended_us - episode.started_us
        draw_arena(arena, ax, ended_us, goal_radius_m=episode.goal_radius_m)
    else:
        _draw_goal(ax, episode)
    if trajectory is not None and len(trajectory) > 1:
        _draw_path(figure, ax, episode, trajectory, top_speed)
    theme.plain_axes(ax, grid=False)
    theme.label_axes(ax, "east [m]", "north [m]")
    theme.legend_below(figure, 3, handletextpad=0.4, columnspacing=1.2)
    label = document.OUTCOME_LABELS[episode.outcome]
    alt = f"Flight {episode.index} from above, coloured by speed: {label}, {episode.reason}"
    return theme.render(figure, f"flight-{episode.index:03d}-map", alt)


def _draw_goal(ax: Axes, episode: EpisodeRecord) -> None:
    north, east = episode.goal[:2]
    colour = OUTCOME_COLOURS[Outcome.SUCCESS]
    ax.add_patch(
        Circle((east, north), episode.goal_radius_m, facecolor="none", edgecolor=colour, lw=1.0)
    )
    ax.plot(east, north, marker="*", ms=15, color=colour, ls="none", label="goal")
    ax.plot(
        0.0, 0.0, marker="^", ms=11, color=theme.SERIES, ls="none", label="start, heading north"
    )
    ax.set_aspect("equal", adjustable="datalim")


def _draw_path(
    figure: Figure, ax: Axes, episode: EpisodeRecord, trajectory: Trajectory, top_speed: float
) -> None:
    keep = np.unique(
        np.linspace(0, len(trajectory) - 1, min(len(trajectory), PATH_SEGMENTS)).astype(int)
    )
    points = trajectory.position[keep][:, [1, 0]]
    speed = trajectory.speed()[keep]
    colours = speed_colours()
    scale = Normalize(0.0, top_speed)
    ax.plot(*points.T, color=theme.HALO, lw=4.2, zorder=2.5, solid_capstyle="round")
    pieces, levels = coloured_pieces(points, 0.5 * (speed[1:] + speed[:-1]), top_speed)
    path = LineCollection(
        pieces, cmap=colours, norm=scale, linewidths=2.2, capstyle="round", zorder=2.6
    )
    path.set_array(levels)
    ax.add_collection(path)
    outcome = episode.outcome
    ax.plot(
        *points[-1],
        marker=OUTCOME_MARKERS[outcome],
        ms=9 if outcome is not Outcome.SUCCESS else 7,
        color=OUTCOME_COLOURS[outcome],
        mec="white",
        mew=1.0,
        ls="none",
        zorder=4,
        label=f"end: {document.OUTCOME_LABELS[outcome]}",
    )
    bar = figure.colorbar(ScalarMappable(scale, colours), ax=ax, shrink=0.45, aspect=26, pad=0.015)
    speed_bar(bar)


def speed_bar(bar: Colorbar) -> None:
    """Style the colour scale of a path."""
    if bar.solids is not None:
        # 256 colour steps are smaller as pixels than as shapes.
        bar.solids.set_rasterized(True)
    bar.outline.set_visible(False)
    bar.set_label("speed [m/s]", fontsize=8.5, color=theme.MUTED)
    bar.ax.tick_params(colors=theme.MUTED, labelsize=8, length=0)


def coloured_pieces(
    points: NDArray[np.float64], values: NDArray[np.float64], top: float
) -> tuple[list[NDArray[np.float64]], NDArray[np.float64]]:
    """Split a line (n, 2) at colour changes, by its segments' values (n - 1,)."""
    step = top / PATH_COLOURS
    levels = np.clip((values / step).astype(int), 0, PATH_COLOURS - 1)
    cuts = np.flatnonzero(np.diff(levels)) + 1
    starts, ends = [0, *cuts], [*cuts, len(values)]
    pieces = [points[start : end + 1] for start, end in zip(starts, ends, strict=True)]
    return pieces, (levels[np.array(starts)] + 0.5) * step


PATH_POINTS = 120
"""Maximum number of points of a path; more are not visible among hundreds of paths."""

OPAQUE_FLIGHTS = 25
"""Maximum number of paths drawn at full opacity; with more paths, opacity decreases."""

MARGIN_M = 0.5
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
        draw_arena(panel.arena, ax, goal_radius_m=panel.episodes[0].goal_radius_m)
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
