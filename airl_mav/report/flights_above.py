"""Maps of many flights: one panel per run, several panels on the same axes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PathCollection
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from airl_mav.arena.draw import FLOOR_COLOUR, GOAL_COLOUR, START_COLOUR, draw_arena
from airl_mav.arena.geometry import Arena, Bounds
from airl_mav.flight.episode_record import EpisodeRecord
from airl_mav.flight.judge import Outcome
from airl_mav.flight.trajectory import Trajectory
from airl_mav.rehearsal.run_folder import LoadedRun
from airl_mav.report import theme
from airl_mav.report.run_figures import OUTCOME_COLOURS, OUTCOME_MARKERS
from airl_mav.report.table import OUTCOME_LABELS

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
    ax: Axes,
    outcome: Outcome,
    flights: Sequence[EpisodeRecord],
    paths: Mapping[int, Trajectory],
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
            label = f"{OUTCOME_LABELS[outcome]} ({count})"
            handles.append(
                Line2D([], [], color=OUTCOME_COLOURS[outcome], marker=marker, ms=5, label=label)
            )
    return handles
