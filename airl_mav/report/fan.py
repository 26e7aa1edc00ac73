"""The flights of several runs from above, side by side: one panel a run, all on the same axes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure

from airl_mav.arena.draw import draw_arena
from airl_mav.arena.geometry import Arena, Bounds
from airl_mav.flight.judge import Outcome
from airl_mav.flight.record import EpisodeRecord
from airl_mav.flight.trajectory import Trajectory
from airl_mav.report.figures import quiet
from airl_mav.report.overview import (
    draw_goals,
    draw_ground,
    draw_paths,
    outcome_legend,
    path_points,
)
from airl_mav.report.theme import (
    INK,
    MUTED,
    PAPER,
    Picture,
    new_figure,
    render,
    render_png,
)

SHEET_COLUMNS = 3
MARKS = 2
"""Start and goal lead the legend: all panels have them."""

MARGIN_M = 0.5
"""Left free around walls and paths."""


@dataclass(frozen=True)
class Panel:
    """The flights of one run."""

    title: str
    detail: str
    """A second, smaller line."""
    episodes: Sequence[EpisodeRecord]
    paths: Mapping[int, Trajectory]
    """By episode index."""
    arena: Arena | None = None
    """Of any of the flights: for the walls. Its obstacles are drawn where all flights have it."""


@dataclass(frozen=True)
class _Frame:
    """The part of the world that all panels show."""

    north: tuple[float, float]
    east: tuple[float, float]

    @property
    def tall(self) -> float:
        """Height by width, within what a page bears."""
        tall = (self.north[1] - self.north[0]) / (self.east[1] - self.east[0])
        return min(max(tall, 0.45), 1.6)


def fan_pictures(prefix: str, panels: Sequence[Panel]) -> list[Picture]:
    """Draw every panel by itself, for a page; their axes are the same.

    Args:
        prefix: What the pictures' names begin with; their number follows.
        panels: One or more, each with one flight or more.
    """
    frame, pictures = _frame(panels), []
    for number, panel in enumerate(panels, start=1):
        figure = new_figure(4.4, 1.05 + 3.95 * frame.tall)
        _draw(figure, panel, frame)
        alt = f"{len(panel.episodes)} flights from above, {panel.title}: {panel.detail}"
        pictures.append(render(figure, f"{prefix}-{number}", alt))
    return pictures


def fan_sheet(panels: Sequence[Panel]) -> bytes:
    """Draw all panels on one sheet; return the PNG."""
    frame = _frame(panels)
    columns = min(SHEET_COLUMNS if len(panels) != 4 else 2, len(panels))
    rows = math.ceil(len(panels) / columns)
    figure = new_figure(4.4 * columns, rows * (1.05 + 3.95 * frame.tall))
    parts = np.ravel(figure.subfigures(rows, columns, squeeze=False))
    for part in parts:
        part.set_facecolor(PAPER)
    for part, panel in zip(parts, panels, strict=False):
        _draw(part, panel, frame)
    return render_png(figure)


def _frame(panels: Sequence[Panel]) -> _Frame:
    """Return the least frame that holds all walls, paths and goals."""
    low, high = np.zeros(2), np.zeros(2)
    for panel in panels:
        points = [np.array([flight.goal for flight in panel.episodes])]
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
    return _Frame((float(north_min), float(north_max)), (float(east_min), float(east_max)))


def _draw(figure: Figure | SubFigure, panel: Panel, frame: _Frame) -> None:
    """Draw one panel."""
    ax: Axes = figure.subplots()
    first = panel.episodes[0]
    if panel.arena is not None and {flight.arena_seed for flight in panel.episodes} == {
        panel.arena.seed
    }:
        draw_arena(panel.arena, ax, goal_radius_m=first.goal_radius_m)
    else:
        draw_ground(ax, _bounds(panel))
        draw_goals(ax, panel.episodes)
    # What went wrong lies on top.
    ranked = sorted(panel.episodes, key=lambda flight: flight.outcome is not Outcome.SUCCESS)
    for outcome in dict.fromkeys(flight.outcome for flight in ranked):
        flights = [flight for flight in ranked if flight.outcome is outcome]
        draw_paths(ax, outcome, flights, panel.paths)
    ax.set_aspect("equal", adjustable="box")
    ax.set_anchor("N")
    ax.set_xlim(frame.east)
    ax.set_ylim(frame.north)
    quiet(ax, grid=False)
    ax.set_xlabel("east of the start [m]", color=MUTED, fontsize=8.5)
    ax.set_ylabel("north of the start [m]", color=MUTED, fontsize=8.5)
    ax.tick_params(colors=MUTED, labelsize=8)
    figure.suptitle(panel.title, x=0.02, ha="left", fontsize=10.5, color=INK)
    ax.set_title(panel.detail, loc="left", fontsize=8.5, color=MUTED, pad=6)
    figure.legend(
        handles=outcome_legend(panel.episodes)[MARKS:],
        loc="outside lower left",
        ncols=4,
        frameon=False,
        fontsize=7.5,
        labelcolor=INK,
        handletextpad=0.3,
        columnspacing=0.9,
    )


def _bounds(panel: Panel) -> Bounds | None:
    return None if panel.arena is None else panel.arena.bounds
