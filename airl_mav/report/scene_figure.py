"""The still picture of one flight in three dimensions: for paper, and where no script runs.

A parallel projection. Things are drawn from far to near by the depth of their middle, which is
right for upright bodies that stand apart, as an arena's obstacles do.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.patches import Circle, Polygon
from numpy.typing import NDArray

from airl_mav.arena.draw import FLOOR_COLOUR, GOAL_COLOUR, GRID_COLOUR, MOVING_COLOURS, START_COLOUR
from airl_mav.arena.geometry import Arena, Bounds, Shape
from airl_mav.report.run_figures import (
    OUTCOME_COLOURS,
    OUTCOME_MARKERS,
    coloured_pieces,
    speed_bar,
    speed_colours,
)
from airl_mav.report.scene import SceneFlight
from airl_mav.report.table import OUTCOME_LABELS
from airl_mav.report.theme import HALO, INK, MUTED, RULE, Picture, new_figure, render

SCENE_NAME = "flight-3d"

LOOKS_DEG = 28.0
"""Heading of the view."""

ABOVE_DEG = 34.0
"""It looks down by this angle."""

GRID_M = 10.0
ROUND = 28
"""Corners of a drawn circle."""
PIECE_POINTS = 6
"""Corners of a piece of the path that has one depth."""
PATH_POINTS = 240

STILL = ("#98a2ab", "#6d7882", "#525d67")
"""Top, lit side, other side."""
MOVES = (MOVING_COLOURS[0], "#d67f1d", "#b0660f")

_FRONT = 3.0
_PER_M = 1e-3

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Projection:
    """A parallel projection of points NED [m]."""

    looks_rad: float
    above_rad: float

    def flat(self, points: Floats) -> Floats:
        """Return where points (n, 3) lie on the picture (n, 2) [m]."""
        cos, sin = math.cos(self.looks_rad), math.sin(self.looks_rad)
        across = cos * points[:, 1] - sin * points[:, 0]
        rise, run = math.cos(self.above_rad), math.sin(self.above_rad)
        return np.stack([across, run * self.depth(points) - rise * points[:, 2]], axis=1)

    def depth(self, points: Floats) -> Floats:
        """Return how far along the view points (n, 3) lie (n,) [m]: greater is farther."""
        depth: Floats = (
            math.cos(self.looks_rad) * points[:, 0] + math.sin(self.looks_rad) * points[:, 1]
        )
        return depth

    def order(self, points: Floats) -> float:
        """Return a matplotlib zorder: nearer things over farther ones."""
        return _FRONT - _PER_M * float(self.depth(points).mean())


def scene_figure(flight: SceneFlight, top_speed: float) -> Picture:
    """Draw one flight, with its arena as it was at the end where that is known.

    Args:
        flight: What to draw.
        top_speed: Upper end of the colour scale [m/s].
    """
    figure = new_figure(8.2, 4.6)
    ax = figure.subplots()
    view = Projection(math.radians(LOOKS_DEG), math.radians(ABOVE_DEG))
    record = flight.record
    if flight.arena is not None:
        _draw_ground(ax, view, flight.arena.bounds)
        _draw_obstacles(ax, view, flight.arena, record.ended_us - record.started_us)
    ring = _ring(np.array([*record.goal, 0.0]), record.goal_radius_m)
    ax.add_patch(
        Polygon(view.flat(ring), facecolor=GOAL_COLOUR, alpha=0.25, edgecolor=GOAL_COLOUR, zorder=2)
    )
    _draw_path(ax, view, flight, top_speed)
    start, goal = view.flat(np.array([[0.0, 0.0, 0.0], [*record.goal, 0.0]]))
    ax.plot(*start, "^", ms=9, color=START_COLOUR, mec="white", mew=0.8, zorder=5, label="start")
    ax.plot(*goal, "*", ms=13, color=GOAL_COLOUR, mec="white", mew=0.8, zorder=5, label="goal")
    ax.plot(
        *view.flat(flight.path.position[-1:])[0],
        marker=OUTCOME_MARKERS[record.outcome],
        ms=8,
        color=OUTCOME_COLOURS[record.outcome],
        mec="white",
        mew=0.9,
        ls="none",
        zorder=6,
        label=f"end: {OUTCOME_LABELS[record.outcome]}",
    )
    ax.set_aspect("equal")
    ax.autoscale_view()
    ax.margins(0.01)
    ax.set_axis_off()
    bar = figure.colorbar(
        ScalarMappable(Normalize(0.0, top_speed), speed_colours()), ax=ax, shrink=0.5, aspect=24,
        pad=0.01,
    )  # fmt: skip
    speed_bar(bar)
    figure.legend(loc="outside lower left", ncols=3, frameon=False, fontsize=8.5, labelcolor=INK)
    words = f"{OUTCOME_LABELS[record.outcome]}, {record.reason}"
    alt = f"Flight {record.index} in its arena, seen from above and behind the start: {words}"
    return render(figure, SCENE_NAME, alt)


def _draw_ground(ax: Axes, view: Projection, b: Bounds) -> None:
    """Draw the floor with its grid, and the edges of the walls."""
    corners = np.array(
        [
            [b.north_min, b.east_min, 0.0],
            [b.north_max, b.east_min, 0.0],
            [b.north_max, b.east_max, 0.0],
            [b.north_min, b.east_max, 0.0],
        ]
    )
    ax.add_patch(Polygon(view.flat(corners), facecolor=FLOOR_COLOUR, edgecolor=MUTED, zorder=0.5))
    for north in np.arange(math.ceil(b.north_min / GRID_M) * GRID_M, b.north_max, GRID_M):
        ends = np.array([[north, b.east_min, 0.0], [north, b.east_max, 0.0]])
        ax.plot(*view.flat(ends).T, color=GRID_COLOUR, lw=0.7, zorder=0.6)
    for east in np.arange(math.ceil(b.east_min / GRID_M) * GRID_M, b.east_max, GRID_M):
        ends = np.array([[b.north_min, east, 0.0], [b.north_max, east, 0.0]])
        ax.plot(*view.flat(ends).T, color=GRID_COLOUR, lw=0.7, zorder=0.6)
    top = corners - [0.0, 0.0, b.height]
    for low, high in zip(corners, top, strict=True):
        ax.plot(*view.flat(np.stack([low, high])).T, color=RULE, lw=0.8, zorder=0.7)
    # The two far walls' upper edges: the near ones would lie over the picture.
    loop = view.flat(np.concatenate([top, top[:1]]))
    ax.plot(*loop.T, color=RULE, lw=0.8, zorder=0.7)


def _ring(center: Floats, radius: float) -> Floats:
    """Return the corners (n, 3) of a level circle."""
    turn = np.linspace(0.0, 2.0 * math.pi, ROUND, endpoint=False)
    level = np.stack([np.cos(turn), np.sin(turn), np.zeros(ROUND)], axis=1)
    return center + radius * level


def _draw_obstacles(ax: Axes, view: Projection, arena: Arena, time_us: int) -> None:
    """Draw all obstacles and the tours of those that move."""
    centers, o = arena.centers_at(time_us), arena.obstacles
    for tour in arena.tours:
        way = np.column_stack([tour.points, np.zeros(len(tour.points))])
        ax.plot(*view.flat(way).T, color=MOVING_COLOURS[0], lw=0.8, alpha=0.7, zorder=1)
    for i, center in enumerate(centers):
        colours = MOVES if i >= arena.n_static else STILL
        order = view.order(center[None, :])
        half = o.half_size[i]
        if o.shape[i] == Shape.SPHERE:
            place = view.flat(center[None, :])[0]
            ax.add_patch(Circle(place, half[0], fc=colours[1], ec=colours[2], lw=0.8, zorder=order))
            lit = place + 0.3 * half[0] * np.array([-1.0, 1.0])
            ax.add_patch(Circle(lit, 0.35 * half[0], fc=colours[0], lw=0.0, zorder=order))
            continue
        if o.shape[i] == Shape.BOX:
            outline = _box_outline(center, half, float(o.yaw[i]))
        else:
            outline = _ring(center, float(half[0]))
        for face, colour in _prism(view, outline, float(half[2]), colours):
            ax.add_patch(
                Polygon(
                    view.flat(face), facecolor=colour, edgecolor=colours[2], lw=0.5, zorder=order
                )
            )


def _box_outline(center: Floats, half: Floats, yaw: float) -> Floats:
    """Return the four corners (4, 3) of a box at the height of its middle."""
    first = np.array([math.cos(yaw), math.sin(yaw), 0.0]) * half[0]
    second = np.array([-math.sin(yaw), math.cos(yaw), 0.0]) * half[1]
    corners = np.stack([first + second, second - first, -first - second, first - second])
    outline: Floats = center + corners
    return outline


def _prism(
    view: Projection, outline: Floats, half_height: float, colours: tuple[str, str, str]
) -> list[tuple[Floats, str]]:
    """Return the visible faces (k, 3) of an upright prism and their colours, the top last."""
    up = np.array([0.0, 0.0, -half_height])
    look = np.array([math.cos(view.looks_rad), math.sin(view.looks_rad), 0.0])
    across = np.array([-look[1], look[0], 0.0])
    faces = []
    middle = outline.mean(axis=0)
    lit = []
    for start, end in zip(outline, np.roll(outline, -1, axis=0), strict=True):
        outward = 0.5 * (start + end) - middle
        if outward @ look < 0.0:
            lit.append((start, end, bool(outward @ across < 0.0)))
    if len(outline) > 4:
        # A round one: its visible sides are one shape, in one colour.
        rim = np.array([start for start, _, _ in lit] + [lit[-1][1]])
        faces.append((np.concatenate([rim + up, (rim - up)[::-1]]), colours[1]))
    else:
        faces += [
            (np.stack([s + up, e + up, e - up, s - up]), colours[1 if left else 2])
            for s, e, left in lit
        ]
    return [*faces, (outline + up, colours[0])]


def _draw_path(ax: Axes, view: Projection, flight: SceneFlight, top_speed: float) -> None:
    """Draw the path, coloured by speed, piece by piece between what is nearer and farther."""
    path = flight.path
    keep = np.unique(np.linspace(0, len(path) - 1, min(len(path), PATH_POINTS)).astype(int))
    points, speed = path.position[keep], path.speed()[keep]
    shadow = points * [1.0, 1.0, 0.0]
    ax.plot(*view.flat(shadow).T, color=MUTED, lw=0.9, alpha=0.5, zorder=1.5)
    colours = speed_colours()
    for first in range(0, len(points) - 1, PIECE_POINTS):
        part = slice(first, first + PIECE_POINTS + 1)
        flat = view.flat(points[part])
        order = view.order(points[part])
        ax.plot(*flat.T, color=HALO, lw=4.0, zorder=order - 1e-6, solid_capstyle="round")
        middle = 0.5 * (speed[part][1:] + speed[part][:-1])
        for piece, level in zip(*coloured_pieces(flat, middle, top_speed), strict=True):
            ax.plot(
                *piece.T, color=colours(level / top_speed), lw=2.2, zorder=order,
                solid_capstyle="round",
            )  # fmt: skip
