"""An arena from above on a matplotlib Axes: x east, y north, metres from the start.

Layers (zorder): floor, hills and grid below 1, zones and tours 1, obstacles 2, start and goal 3;
draw flights at 2.5 or above. The legend has one artist per kind.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LinearSegmentedColormap, to_rgba
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Patch, Polygon, Rectangle
from matplotlib.ticker import MultipleLocator
from numpy.typing import NDArray

from airl_mav.arena import geometry, walls
from airl_mav.core import constants, files

FLOOR_COLOUR = "#f8f7f4"
GRID_COLOUR = "#e4e1da"
TEXT_COLOUR = "#3a3f45"
STATIC_COLOURS = ("#5b6670", "#2f363d")
MOVING_COLOURS = ("#f0932b", "#9c5a0c")
OPENING, OPENING_COLOUR = "opening", "#cfe3f5"
"""Legend label and colour of boxes above and below gate openings, and of lintels above doors."""
LOW_COLOUR, HIGH_COLOUR, CONTOUR_COLOUR = "#f2efe6", "#b39b6d", "#a08a5e"
"""Colours of the lowest and the highest ground, and of contour lines."""
START_COLOUR = "#1f4e8c"
GOAL_COLOUR = "#1b8a3f"
ZONE_COLOUR = "#8d8a83"

WALL_SHARE = 0.012
"""Drawn wall thickness as a share of the longer side. Simulated walls have no thickness."""

ARROW_S = 2.0
"""Prediction time [s] of a moving obstacle's arrow."""


def draw_arena(
    arena: geometry.Arena,
    ax: Axes,
    time_us: int = 0,
    *,
    goal_radius_m: float | None = None,
    zone_radii_m: Sequence[float] = (),
) -> None:
    """Draw the arena `time_us` after the start; set limits, aspect and labels of `ax`."""
    _draw_floor(arena, ax)
    _draw_zones(arena, ax, zone_radii_m)
    for tour in arena.tours:
        north, east = tour.points.T
        ax.plot(east, north, color=MOVING_COLOURS[0], lw=0.7, alpha=0.45, zorder=1)
    _draw_obstacles(arena, ax, time_us)
    for i, tour in enumerate(arena.tours, start=arena.n_static):
        _draw_arrow(ax, arena.centers_at(time_us)[i], tour, time_us)
    _draw_start_and_goal(arena, ax, goal_radius_m)


def add_legend(figure: Figure, ax: Axes) -> None:
    """Add the legend of `ax` below the figure. The figure's layout must be "constrained"."""
    handles, labels = ax.get_legend_handles_labels()
    figure.legend(
        handles,
        labels,
        loc="outside lower center",
        ncols=4 if figure.get_figwidth() >= 6.0 else 2,
        frameon=False,
        fontsize=8.5,
        labelcolor=TEXT_COLOUR,
        handletextpad=0.5,
        columnspacing=1.4,
    )


def save_png(
    arena: geometry.Arena,
    path: Path,
    *,
    time_us: int = 0,
    goal_radius_m: float | None = None,
    zone_radii_m: Sequence[float] = (),
) -> None:
    """Write a picture of the arena; arguments as in `draw_arena`."""
    b = arena.bounds
    tall = (b.north_max - b.north_min) / (b.east_max - b.east_min)
    # Tall arenas get a narrower figure.
    width = 6.4 / max(1.0, tall / 1.4)
    figure = Figure(figsize=(max(width, 4.2), 1.3 + 0.88 * width * tall), layout="constrained")
    ax = figure.add_subplot()
    draw_arena(arena, ax, time_us, goal_radius_m=goal_radius_m, zone_radii_m=zone_radii_m)
    when = f", t = {time_us / constants.US_PER_S:g} s" if arena.tours else ""
    ax.set_title(
        f"{arena.name}, seed {arena.seed}{when}", fontsize=11, color=TEXT_COLOUR, loc="left", pad=8
    )
    add_legend(figure, ax)
    write_png(figure, path)


def write_png(figure: Figure, path: Path, dpi: int = 150) -> None:
    """Write a figure atomically."""
    FigureCanvasAgg(figure)
    with files.replacing(path) as partial:
        figure.savefig(partial, format="png", dpi=dpi)


def _draw_floor(arena: geometry.Arena, ax: Axes) -> None:
    b = arena.bounds
    length, width = b.north_max - b.north_min, b.east_max - b.east_min
    thick = WALL_SHARE * max(length, width)
    colour = tuple(channel / 255.0 for channel in arena.wall_colour)
    # Walls are drawn outside the floor.
    outer = (b.east_min - thick, b.north_min - thick), width + 2.0 * thick, length + 2.0 * thick
    ax.add_patch(Rectangle(*outer, facecolor=colour, zorder=0.1))
    ax.add_patch(Rectangle(*_floor(arena), facecolor=FLOOR_COLOUR, zorder=0.2))
    if arena.ground is not None:
        _draw_ground(arena.ground, ax)
    step = _round_step(max(length, width) / 6.0)
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_major_locator(MultipleLocator(step))
    first_north, first_east = math.ceil(b.north_min / step), math.ceil(b.east_min / step)
    grid: dict[str, Any] = {"color": GRID_COLOUR, "lw": 0.6, "zorder": 0.3}
    ax.hlines(np.arange(first_north * step, b.north_max, step), b.east_min, b.east_max, **grid)
    ax.vlines(np.arange(first_east * step, b.east_max, step), b.north_min, b.north_max, **grid)
    ax.set_xlim(b.east_min - 1.5 * thick, b.east_max + 1.5 * thick)
    ax.set_ylim(b.north_min - 1.5 * thick, b.north_max + 1.5 * thick)
    ax.set_aspect("equal")
    ax.set_xlabel("east [m]", color=TEXT_COLOUR)
    ax.set_ylabel("north [m]", color=TEXT_COLOUR)
    ax.tick_params(colors=TEXT_COLOUR, length=0, labelsize=8.5)
    for spine in ax.spines.values():
        spine.set_visible(False)


def _draw_ground(ground: geometry.Ground, ax: Axes) -> None:
    rows, columns = ground.heights.shape
    north = ground.south + ground.step_north * np.arange(rows)
    east = ground.west + ground.step_east * np.arange(columns)
    step = _round_step(ground.top_m / 8.0)
    levels = np.arange(0.0, ground.top_m + step, step)
    tones = LinearSegmentedColormap.from_list("ground", [LOW_COLOUR, HIGH_COLOUR])
    # The lowest tone starts at rising ground: level ground keeps the floor's colour.
    filled = [1e-3, *levels[1:]]
    ax.contourf(east, north, ground.heights, filled, cmap=tones, zorder=0.25)
    lines: dict[str, Any] = {"colors": CONTOUR_COLOUR, "linewidths": 0.6, "zorder": 0.35}
    ax.contour(east, north, ground.heights, levels[1:], **lines)
    label = f"ground, a line every {step:g} m"
    ax.plot([], [], color=CONTOUR_COLOUR, lw=1.2, label=label)


def _floor(arena: geometry.Arena) -> tuple[tuple[float, float], float, float]:
    """Return the floor as matplotlib takes a rectangle: corner (east, north), width, height."""
    b = arena.bounds
    return (b.east_min, b.north_min), b.east_max - b.east_min, b.north_max - b.north_min


def _round_step(target: float) -> float:
    """Return the first of 1, 2, 5, 10, 20, ... at or above `target`."""
    power = 10.0 ** math.floor(math.log10(target))
    return next(power * m for m in (1.0, 2.0, 5.0, 10.0) if power * m >= target)


def _draw_zones(arena: geometry.Arena, ax: Axes, radii_m: Sequence[float]) -> None:
    """Draw zone limits, clipped at the walls, labelled as near to due north as fits."""
    floor = Rectangle(*_floor(arena), transform=ax.transData)
    for k, radius in enumerate(radii_m):
        ring = Circle(
            (0.0, 0.0), radius, fill=False, edgecolor=ZONE_COLOUR, lw=0.9, ls=(0, (5, 4)), zorder=1
        )
        ax.add_patch(ring)
        ring.set_clip_path(floor)
        # The first bearing, clockwise from north, at which the label fits.
        bearing = next((a for a in range(0, 180, 3) if _holds(arena, radius, a)), None)
        if bearing is not None:
            ax.text(
                radius * math.sin(math.radians(bearing)),
                radius * math.cos(math.radians(bearing)),
                f"zone {k}: {radius:g} m",
                ha="center",
                va="center",
                rotation=-bearing,
                fontsize=7.5,
                color=ZONE_COLOUR,
                zorder=1.1,
                bbox={"facecolor": FLOOR_COLOUR, "edgecolor": "none", "pad": 1.2},
            )


def _holds(arena: geometry.Arena, radius: float, bearing_deg: int) -> bool:
    """Return whether a label fits on the floor at a distance and bearing from the start."""
    b = arena.bounds
    north = radius * math.cos(math.radians(bearing_deg))
    east = radius * math.sin(math.radians(bearing_deg))
    room = 0.08 * max(b.north_max - b.north_min, b.east_max - b.east_min)
    inside_north = b.north_min + room / 4.0 < north < b.north_max - room / 4.0
    return inside_north and b.east_min + room < east < b.east_max - room


def _draw_obstacles(arena: geometry.Arena, ax: Axes, time_us: int) -> None:
    centers = arena.centers_at(time_us)
    labelled: set[bool | str] = set()
    open_way = np.zeros(len(arena.obstacles), np.bool_)
    open_way[: arena.n_static] = walls.over_openings(arena) | walls.over_doors(arena)
    for i in range(len(arena.obstacles)):
        if open_way[i]:
            patch = _footprint(arena, i, centers[i])
            patch.set(facecolor=OPENING_COLOUR, edgecolor=STATIC_COLOURS[1], lw=0.6, zorder=1.9)
            if OPENING not in labelled:
                patch.set_label("door" if arena.building is not None else "opening of a gate")
                labelled.add(OPENING)
            ax.add_patch(patch)
            continue
        moves = i >= arena.n_static
        face, edge = MOVING_COLOURS if moves else STATIC_COLOURS
        patch = _footprint(arena, i, centers[i])
        patch.set(facecolor=face, edgecolor=edge, lw=1.0, zorder=2.1 if moves else 2)
        if moves not in labelled:
            patch.set_label("moving obstacle" if moves else "static obstacle")
            labelled.add(moves)
        ax.add_patch(patch)
        if arena.obstacles.shape[i] == geometry.Shape.SPHERE:
            radius = 0.62 * arena.obstacles.half_size[i, 0]
            ring: dict[str, Any] = {"edgecolor": "white", "alpha": 0.6, "lw": 0.9, "zorder": 2.2}
            ax.add_patch(Circle((centers[i, 1], centers[i, 0]), radius, fill=False, **ring))


def _footprint(arena: geometry.Arena, i: int, center: NDArray[np.float64]) -> Patch:
    """Return the outline of an obstacle, seen from above, at `center` (3,) NED [m]."""
    along, across = arena.obstacles.half_size[i, :2]
    if arena.obstacles.shape[i] != geometry.Shape.BOX:
        return Circle((center[1], center[0]), along)
    yaw = float(arena.obstacles.yaw[i])
    first = np.array([math.cos(yaw), math.sin(yaw)]) * along
    second = np.array([-math.sin(yaw), math.cos(yaw)]) * across
    corners = np.stack([first + second, second - first, -first - second, first - second])
    return Polygon((center[:2] + corners)[:, ::-1], closed=True)


def _draw_arrow(ax: Axes, center: NDArray[np.float64], tour: geometry.Tour, time_us: int) -> None:
    """Draw the motion of an obstacle over ARROW_S as an arrow."""
    t = (time_us / constants.US_PER_S) % tour.times_s[-1]
    k = int(np.searchsorted(tour.times_s, t, side="right")) - 1
    step = np.diff(tour.points, axis=0)
    # During a stop the arrow shows the next leg.
    k = k if step[k].any() else (k + 1) % len(step)
    velocity = step[k] / (tour.times_s[k + 1] - tour.times_s[k])
    tip = center[:2] + velocity * ARROW_S
    ax.annotate(
        "",
        xy=(tip[1], tip[0]),
        xytext=(center[1], center[0]),
        arrowprops={
            "arrowstyle": "-|>,head_width=0.22,head_length=0.45",
            "color": MOVING_COLOURS[1],
            "lw": 1.3,
            "shrinkA": 0.0,
            "shrinkB": 0.0,
        },
        zorder=2.3,
    )


def _draw_start_and_goal(arena: geometry.Arena, ax: Axes, goal_radius_m: float | None) -> None:
    north, east = arena.goal
    if goal_radius_m is not None:
        disc = Circle((east, north), goal_radius_m, edgecolor=GOAL_COLOUR, lw=1.0, zorder=1.5)
        disc.set_facecolor(to_rgba(GOAL_COLOUR, 0.14))
        ax.add_patch(disc)
    marker: dict[str, Any] = {"ls": "none", "mec": "white", "mew": 0.8, "zorder": 3}
    ax.plot(0.0, 0.0, marker="^", ms=11, color=START_COLOUR, label="start, heading north", **marker)
    ax.plot(east, north, marker="*", ms=15, color=GOAL_COLOUR, label="goal", **marker)
