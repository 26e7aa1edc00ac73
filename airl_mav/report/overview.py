"""Many flights in one picture: their paths from above, around the common start."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PathCollection
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from airl_mav.arena.draw import FLOOR_COLOUR, GOAL_COLOUR, START_COLOUR, draw_arena
from airl_mav.arena.geometry import Arena, Bounds
from airl_mav.core.files import replace_file
from airl_mav.flight.judge import Outcome
from airl_mav.flight.record import EpisodeRecord
from airl_mav.flight.trajectory import Trajectory
from airl_mav.rehearsal.run_folder import LoadedRun
from airl_mav.report.figures import OUTCOME_COLOURS, OUTCOME_MARKERS, quiet
from airl_mav.report.tables import OUTCOME_WORDS
from airl_mav.report.theme import INK, MUTED, RULE, Picture, new_figure, render

OVERVIEW_NAME = "trajectories"

PATH_POINTS = 120
"""A drawn path has at most this many points: more are not seen where hundreds of paths cross."""

INK_FLIGHTS = 25
"""Up to this many paths are drawn in full strength; more of them get fainter."""


def write_overview(run: LoadedRun, arenas: Mapping[int, Arena]) -> None:
    """Write `trajectories.png` into a run's folder."""
    picture = overview_figure(run, arenas)
    replace_file(run.path / f"{picture.name}.png", picture.png)


def overview_figure(run: LoadedRun, arenas: Mapping[int, Arena]) -> Picture:
    """Draw all flights of a run from above, coloured by how they ended.

    Every seed has its own obstacles, so they are drawn only where all flights have one seed.

    Args:
        run: The run, with one episode or more.
        arenas: Arenas by episode index, of some episodes at least one: for the walls.
    """
    bounds = [arena.bounds for arena in arenas.values()]
    b = bounds[0] if bounds and all(other == bounds[0] for other in bounds) else None
    tall = 1.0 if b is None else (b.north_max - b.north_min) / (b.east_max - b.east_min)
    figure = new_figure(6.4, 1.1 + 5.6 * min(max(tall, 0.5), 1.6))
    ax = figure.add_subplot()
    first = next(iter(arenas.values()), None)
    alone = len({episode.arena_seed for episode in run.episodes}) == 1
    if alone and first is not None:
        draw_arena(first, ax, goal_radius_m=run.episodes[0].goal_radius_m)
    else:
        draw_ground(ax, b)
    # What went wrong lies on top.
    ranked = sorted(run.episodes, key=lambda episode: episode.outcome is not Outcome.SUCCESS)
    for outcome in dict.fromkeys(episode.outcome for episode in ranked):
        flights = [episode for episode in ranked if episode.outcome is outcome]
        draw_paths(ax, outcome, flights, run.trajectories)
    draw_goals(ax, run.episodes)
    quiet(ax, grid=False)
    for label in (ax.xaxis.label, ax.yaxis.label):
        label.set(color=MUTED, fontsize=8.5)
    figure.legend(
        handles=outcome_legend(run.episodes),
        loc="outside lower left",
        ncols=4,
        frameon=False,
        fontsize=8,
        labelcolor=INK,
        handletextpad=0.4,
        columnspacing=1.2,
    )
    alt = f"The paths of {len(ranked)} flights from above, coloured by how they ended"
    return render(figure, OVERVIEW_NAME, alt)


def draw_ground(ax: Axes, bounds: Bounds | None) -> None:
    """Draw floor and start; the walls' place is known where all arenas share it."""
    if bounds is not None:
        b = bounds
        size = b.east_max - b.east_min, b.north_max - b.north_min
        ax.add_patch(
            Rectangle(
                (b.east_min, b.north_min), *size, facecolor=FLOOR_COLOUR, edgecolor=RULE, lw=1.5
            )
        )
        ax.set_xlim(b.east_min - 0.5, b.east_max + 0.5)
        ax.set_ylim(b.north_min - 0.5, b.north_max + 0.5)
    ax.set_aspect("equal", adjustable="box" if bounds is not None else "datalim")
    ax.set_xlabel("east of the start [m]")
    ax.set_ylabel("north of the start [m]")
    ax.plot(0.0, 0.0, marker="^", ms=10, color=START_COLOUR, mec="white", mew=0.8, zorder=5)


def draw_paths(
    ax: Axes,
    outcome: Outcome,
    flights: Sequence[EpisodeRecord],
    paths: Mapping[int, Trajectory],
) -> None:
    """Draw the flights that ended in one way: thin lines, and a mark where they failed."""
    failed = outcome is not Outcome.SUCCESS
    colour = OUTCOME_COLOURS[outcome]
    lines = [
        path_points(paths[flight.index], flight.ended_us)
        for flight in flights
        if flight.index in paths and len(paths[flight.index]) > 1
    ]
    lines = [line for line in lines if len(line) > 1]
    # Hundreds of lines weigh less as pixels than as shapes.
    collection = LineCollection(
        lines,
        colors=colour,
        linewidths=1.2,
        alpha=_strength(len(lines)),
        zorder=2.5 + failed,
        rasterized=True,
    )
    ax.add_collection(collection)
    if failed and lines:
        ends = np.stack([line[-1] for line in lines])
        _mark(ax, ends, marker=OUTCOME_MARKERS[outcome], s=34, color=colour, zorder=4.5)


def draw_goals(ax: Axes, episodes: Sequence[EpisodeRecord]) -> None:
    """Draw where the flights had to go."""
    goals = np.array([(episode.goal[1], episode.goal[0]) for episode in episodes])
    strength = _strength(len(goals))
    _mark(ax, goals, marker="*", s=60.0 * strength + 6.0, color=GOAL_COLOUR, zorder=4, alpha=0.7)


def _strength(count: int) -> float:
    """Return the opacity of one of so many things that lie over each other."""
    return min(0.9, max(0.12, math.sqrt(INK_FLIGHTS / max(1, count))))


def _mark(ax: Axes, points: NDArray[np.float64], **look: Any) -> PathCollection:
    """Draw markers at points (k, 2), east and north."""
    return ax.scatter(*points.T, edgecolors="white", linewidths=0.6, rasterized=True, **look)


def path_points(path: Trajectory, ended_us: int) -> NDArray[np.float64]:
    """Return some points (k, 2), east and north, of a path up to the verdict."""
    inside = np.flatnonzero(path.time_us <= ended_us)
    keep = np.unique(np.linspace(0, len(inside) - 1, min(len(inside), PATH_POINTS)).astype(int))
    points: NDArray[np.float64] = path.position[inside[keep]][:, [1, 0]]
    return points


def outcome_legend(episodes: Sequence[EpisodeRecord]) -> list[Line2D]:
    """Return the legend: how many flights ended how."""
    handles = [
        Line2D([], [], ls="none", marker="^", ms=8, color=START_COLOUR, label="start"),
        Line2D([], [], ls="none", marker="*", ms=9, color=GOAL_COLOUR, label="goal"),
    ]
    for outcome in OUTCOME_COLOURS:
        count = sum(episode.outcome is outcome for episode in episodes)
        if count:
            marker = "" if outcome is Outcome.SUCCESS else OUTCOME_MARKERS[outcome]
            label = f"{OUTCOME_WORDS[outcome]} ({count})"
            handles.append(
                Line2D([], [], color=OUTCOME_COLOURS[outcome], marker=marker, ms=5, label=label)
            )
    return handles
