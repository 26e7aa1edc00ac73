"""3D figures of flights for plotly in a page: x east, y north, z up [m]."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Any

import numpy as np
from matplotlib.colors import to_hex
from numpy.typing import NDArray

from airl_mav.arena.draw import GOAL_COLOUR, MOVING_COLOURS, START_COLOUR
from airl_mav.arena.geometry import Arena, Obstacles, Shape
from airl_mav.arena.triangles import drawn, standing
from airl_mav.core import constants, frames
from airl_mav.flight.episode_record import EpisodeRecord
from airl_mav.flight.judge import Outcome
from airl_mav.flight.trajectory import Trajectory
from airl_mav.report import document, run_figures, scene

POINTS = 240
"""Maximum number of points of a path."""

CORNERS = 12
"""Number of corners of a drawn circle."""

MOST_TRIANGLES = 20_000
"""Maximum number of mesh triangles per view; a page contains many views."""

VIEW_M = 6.0

ALL_ROUND_DEG = 360.0

STILL_COLOUR = "#8b97a3"

HILLS_COLOURS = ("#e3dfd0", "#a8946a")

MOST_CELLS = 4_000
"""Maximum number of terrain cells per flight on a page."""

Floats = NDArray[np.float64]
Trace = dict[str, Any]


@dataclass(frozen=True)
class SceneFlight:
    """Flight in the view."""

    record: EpisodeRecord
    path: Trajectory
    """Path up to the verdict, two or more samples."""
    arena: Arena | None


def scene_json(flights: Sequence[SceneFlight], fov_deg: float) -> str:
    """Return the view of each flight as JSON."""
    top = top_speed(flights)
    views = [flight_view(flight, top, fov_deg) for flight in flights]
    text = json.dumps(views, separators=(",", ":"), allow_nan=False)
    return text.replace("<", "\\u003c")


def top_speed(flights: Sequence[SceneFlight]) -> float:
    """Return the upper end of the colour scale of all paths [m/s]."""
    return max((float(flight.path.speed().max()) for flight in flights), default=0.0) or 1.0


@cache
def plotly_script() -> str:
    """Return plotly.js, which draws the figures, as one script."""
    return (files("plotly") / "package_data" / "plotly.min.js").read_text(encoding="utf-8")


def flight_view(flight: SceneFlight, top: float, fov_deg: float) -> dict[str, Any]:
    """Return a flight's figure and slider data; `top` [m/s] is the upper end of the colours."""
    record, arena = flight.record, flight.arena
    path = _thinned(flight.path)
    place, speed = _east_north_up(path.position), path.speed()
    ground = None if arena is None else arena.ground
    below = np.zeros(len(place)) if ground is None else ground.heights_at(path.position)
    shadow = np.column_stack([place[:, :2], below + 0.05])
    seconds = (path.time_us - record.started_us) / constants.US_PER_S
    moving: dict[str, Any] | None = None
    traces = [] if arena is None else _arena_traces(arena)
    if arena is not None and arena.tours:
        centers, count = arena.centers_at(0), arena.n_static
        bodies = [body_mesh(arena.obstacles, i, centers[i]) for i in range(count, len(centers))]
        traces.append(_mesh(bodies, MOVING_COLOURS[0], "moving obstacle"))
        for tour in arena.tours:
            on_floor = np.column_stack([tour.points[:, ::-1], np.full(len(tour.points), 0.05)])
            traces.append(_line(on_floor, MOVING_COLOURS[0], "way of an obstacle", width=2))
        moving = {
            "trace": len(traces) - 1 - len(arena.tours),
            "corners": [len(corners) for corners, _ in bodies],
            "tours": [
                {
                    "time": _rounded(t.times_s),
                    "place": _rounded(t.points[:, ::-1] - t.points[0, ::-1]),
                }
                for t in arena.tours
            ],
        }
    east, north = record.goal[1], record.goal[0]
    base = 0.0 if ground is None else ground.height_at(north, east)
    up = frames.goal_height_m(record.goal) or base + 0.1
    ring = _ring(east, north, record.goal_radius_m) + np.array([0.0, 0.0, base])
    speed_bar = {"title": {"text": "m/s"}, "thickness": 12, "len": 0.5, "x": 1.0}
    scale = [[i / 15.0, to_hex(run_figures.speed_colours()(i / 15.0))] for i in range(16)]
    traces += [
        _line(shadow, "#8d969f", "shadow", width=2),
        {
            **_line(place, "", "path", width=7),
            "line": {
                "color": _rounded(speed),
                "colorscale": scale,
                "cmin": 0.0,
                "cmax": top,
                "width": 7,
                "showscale": True,
                "colorbar": speed_bar,
            },
            "customdata": _rounded(np.stack([seconds, speed], axis=1)),
            "hovertemplate": "%{customdata[0]:.1f} s, %{customdata[1]:.1f} m/s<extra></extra>",
        },
        _line(ring, GOAL_COLOUR, "goal", width=4),
        _marks(np.array([[east, north, up]]), GOAL_COLOUR, "goal", symbol="diamond"),
        _marks(np.zeros((1, 3)), START_COLOUR, "start", symbol="square"),
        _marks(
            place[-1:],
            run_figures.OUTCOME_COLOURS[record.outcome],
            f"end: {document.OUTCOME_LABELS[record.outcome]}",
            symbol="x" if record.outcome is not Outcome.SUCCESS else "circle",
        ),
        # The vehicle with the edges of its field of view; the page's script moves it.
        {
            **_line(place[[-1, -1, -1]], "#2f7fc4", "vehicle", width=3),
            "mode": "lines+markers",
            "marker": {"size": [0, 7, 0], "color": "#2f7fc4"},
        },
    ]
    since_us = record.zero_us - record.started_us
    return {
        "figure": {"data": traces, "layout": _layout()},
        "path": {
            "time": _rounded(seconds),
            "place": _rounded(place),
            "heading": _rounded(np.unwrap(frames.quats_to_euler(path.quaternion)[2])),
            "speed": _rounded(speed),
        },
        "navigation": round(since_us / constants.US_PER_S, 2),
        "vehicle": len(traces) - 1,
        "view": _view(fov_deg),
        "moving": moving,
    }


def _view(fov_deg: float) -> list[float]:
    """Return length [m] and half angle [rad] of the drawn field of view; a line for 360°."""
    if fov_deg >= ALL_ROUND_DEG:
        return [VIEW_M, 0.0]
    return [VIEW_M if fov_deg else 0.0, round(math.radians(fov_deg) / 2.0, 3)]


def body_mesh(obstacles: Obstacles, i: int, center: Floats) -> tuple[Floats, NDArray[np.int64]]:
    """Return obstacle i at a centre NED [m] as a closed mesh: corners ENU [m] and triangles."""
    half, yaw = obstacles.half_size[i], float(obstacles.yaw[i])
    if obstacles.shape[i] == Shape.BOX:
        outline = np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]]) * half[:2]
        cos, sin = math.cos(yaw), math.sin(yaw)
        rings = [(outline @ np.array([[cos, sin], [-sin, cos]]), z) for z in (-half[2], half[2])]
    else:
        turn = np.linspace(0.0, 2.0 * math.pi, CORNERS, endpoint=False)
        circle = np.stack([np.cos(turn), np.sin(turn)], axis=1)
        if obstacles.shape[i] == Shape.SPHERE:
            tilt = np.linspace(-0.5 * math.pi, 0.5 * math.pi, CORNERS // 2 + 1)[1:-1]
            rings = [(half[0] * math.cos(t) * circle, half[0] * math.sin(t)) for t in tilt]
        else:
            rings = [(half[0] * circle, z) for z in (-half[2], half[2])]
    n, last = len(rings[0][0]), len(rings) * len(rings[0][0])
    top = float(half[2])
    corners = np.concatenate(
        [
            *(np.column_stack([ring, np.full(n, z)]) for ring, z in rings),
            [[0.0, 0.0, -top], [0.0, 0.0, top]],
        ]
    )
    triangles = []
    for k in range(n):
        after = (k + 1) % n
        triangles += [(last, after, k), (last + 1, last - n + k, last - n + after)]
        for below in range(0, last - n, n):
            a, b = below + k, below + after
            triangles += [(a, b, b + n), (a, b + n, a + n)]
    placed = corners * [1.0, 1.0, -1.0] + center
    return _east_north_up(placed), np.array(triangles)


def _arena_traces(arena: Arena) -> list[Trace]:
    b = arena.bounds
    corners = [
        (b.east_min, b.north_min),
        (b.east_max, b.north_min),
        (b.east_max, b.north_max),
        (b.east_min, b.north_max),
    ]
    floor = np.array([(*corner, 0.0) for corner in corners])
    walls = np.concatenate([floor, floor + np.array([0.0, 0.0, b.height])])
    faces = [
        face
        for k in range(4)
        for face in ((k, (k + 1) % 4, k + 4), (k + 4, (k + 1) % 4, (k + 1) % 4 + 4))
    ]
    red, green, blue = arena.wall_colour
    traces = [
        _mesh([(floor, np.array([(0, 1, 2), (0, 2, 3)]))], "#c9cdd2", "floor", opacity=0.45),
        _mesh([(walls, np.array(faces))], f"rgb({red},{green},{blue})", "wall", opacity=0.12),
    ]
    if arena.ground is not None:
        hills = arena.ground.coarser(MOST_CELLS)
        body = (_east_north_up(hills.points), hills.faces.astype(np.int64))
        low, high = HILLS_COLOURS
        shades = {
            "intensity": _rounded(-hills.points[:, 2]),
            "colorscale": [[0.0, low], [1.0, high]],
            "showscale": False,
            "flatshading": False,
        }
        traces.append(_mesh([body], low, "ground") | shades)
    if arena.n_static:
        shown = drawn(arena.meshes, MOST_TRIANGLES)
        bodies = {
            i: body_mesh(arena.obstacles, i, arena.obstacles.center[i])
            for i in range(arena.n_static)
            if arena.mesh_of(i) not in shown
        }
        glass = [] if arena.clear is None else np.flatnonzero(arena.clear).tolist()
        panes = [bodies.pop(i) for i in glass if i in bodies]
        still = list(bodies.values())
        for each in shown:
            places, triangles = standing(each)
            still.append((_east_north_up(places), triangles.astype(np.int64)))
        if still:
            traces.append(_mesh(still, STILL_COLOUR, "obstacle"))
        if panes:
            traces.append(_mesh(panes, STILL_COLOUR, "glass", opacity=scene.GLASS_OPACITY))
    return traces


def _mesh(
    bodies: Sequence[tuple[Floats, NDArray[np.int64]]], colour: str, name: str, opacity: float = 1.0
) -> Trace:
    starts = np.cumsum([0, *(len(corners) for corners, _ in bodies)])
    corners = np.concatenate([corners for corners, _ in bodies])
    faces = np.concatenate(
        [faces + start for (_, faces), start in zip(bodies, starts[:-1], strict=True)]
    )
    return {
        "type": "mesh3d",
        **dict(zip("xyz", _rounded(corners.T), strict=True)),
        **dict(zip("ijk", faces.T.tolist(), strict=True)),
        "color": colour,
        "opacity": opacity,
        "flatshading": True,
        "name": name,
        "hoverinfo": "name",
    }


def _line(points: Floats, colour: str, name: str, *, width: float) -> Trace:
    return {
        "type": "scatter3d",
        "mode": "lines",
        **dict(zip("xyz", _rounded(points.T), strict=True)),
        "line": {"color": colour, "width": width},
        "name": name,
        "hoverinfo": "name",
    }


def _marks(points: Floats, colour: str, name: str, *, symbol: str) -> Trace:
    return {
        **_line(points, colour, name, width=1),
        "mode": "markers",
        "marker": {"size": 6, "color": colour, "symbol": symbol},
    }


def _layout() -> dict[str, Any]:
    eyes = {
        "From the start": (0.0, -1.75, 1.2),
        "From above": (0.0, -0.05, 2.6),
        "From the side": (1.7, 0.0, 0.7),
    }
    buttons = [
        {"label": label, "method": "relayout", "args": [{"scene.camera": _camera(eye)}]}
        for label, eye in eyes.items()
    ]
    axes: dict[str, dict[str, Any]] = {
        "xaxis": {"title": {"text": "east [m]"}},
        "yaxis": {"title": {"text": "north [m]"}},
        "zaxis": {"title": {"text": "up [m]"}, "rangemode": "tozero"},
    }
    return {
        "margin": {"l": 0, "r": 0, "t": 0, "b": 0},
        "paper_bgcolor": "rgba(0,0,0,0)",
        "showlegend": False,
        "modebar": {"bgcolor": "rgba(0,0,0,0)", "color": "#5c646e", "activecolor": "#2f7fc4"},
        "scene": {
            **axes,
            "aspectmode": "data",
            "camera": _camera(next(iter(eyes.values()))),
        },
        "updatemenus": [
            {"type": "buttons", "direction": "right", "x": 0, "y": 1, "yanchor": "top",
             "xanchor": "left", "bgcolor": "#eef0f2",
             "font": {"color": "#21262d", "size": 11}, "buttons": buttons}
        ],
    }  # fmt: skip


def _camera(eye: tuple[float, float, float]) -> dict[str, dict[str, float]]:
    places = {"eye": eye, "center": (0.0, 0.0, -0.2)}
    return {name: dict(zip("xyz", place, strict=True)) for name, place in places.items()}


def _thinned(path: Trajectory) -> Trajectory:
    """Return up to `POINTS` samples, evenly spaced, including the first and the last."""
    keep = np.unique(np.linspace(0, len(path) - 1, min(len(path), POINTS)).round().astype(int))
    return Trajectory.from_arrays({name: array[keep] for name, array in path.arrays().items()})


def _ring(east: float, north: float, radius: float) -> Floats:
    turn = np.linspace(0.0, 2.0 * math.pi, 4 * CORNERS + 1)
    level = [east + radius * np.cos(turn), north + radius * np.sin(turn), np.full(len(turn), 0.05)]
    return np.stack(level, axis=1)


def _east_north_up(points: Floats) -> Floats:
    turned: Floats = points[:, [1, 0, 2]] * [1.0, 1.0, -1.0]
    return turned


def _rounded(values: Floats) -> list[Any]:
    rounded: list[Any] = (np.round(values, 2) + 0.0).tolist()
    return rounded
