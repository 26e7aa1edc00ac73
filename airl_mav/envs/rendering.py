"""Images of an episode: top view of the arena, network input, and flight data.

Static parts are drawn once per episode; a frame adds the moving parts.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from gymnasium.error import ResetNeeded
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from numpy.typing import NDArray

from airl_mav.arena.draw import GRID_COLOUR, MOVING_COLOURS, START_COLOUR, TEXT_COLOUR, draw_arena
from airl_mav.arena.geometry import Arena, Obstacles, Shape
from airl_mav.core.errors import UsageError
from airl_mav.envs.fleet import FlightArrays, FlightStatus
from airl_mav.envs.spec import EnvironmentSpec
from airl_mav.profiles.projections import CameraKind

WIDTH_PX, HEIGHT_PX = 960, 540
DPI = 100
VEHICLE_M = 1.4
"""Length of the drawn vehicle, larger than real vehicles for visibility [m]."""

TRAIL_COLOUR = "#c0392b"
CIRCLE = np.linspace(0.0, 2.0 * math.pi, 25)[:-1]


RENDER_MODES = ("rgb_array",)
"""Render modes; a window is Gymnasium's wrapper `HumanRendering`."""


class PictureContent(NamedTuple):
    """Content of a picture."""

    arena: Arena
    flights: FlightArrays
    """Status of one vehicle: arrays (1,)."""
    position: NDArray[np.float64]
    """True position (3,) NED [m]."""
    yaw: float
    """True heading [rad]."""
    scene_us: int
    """Time since the moving obstacles started [µs]."""
    image: NDArray[np.uint8]
    """Network input (h, w), or (h, w, 3) in colour."""


class Pictures:
    """Pictures of an environment's episodes, according to its `render_mode`."""

    def __init__(self, spec: EnvironmentSpec, kind: CameraKind, mode: str | None) -> None:
        """Prepare pictures; `render` draws them.

        Args:
            spec: The environment.
            kind: Camera kind of the network input.
            mode: None or a mode in `RENDER_MODES`.

        Raises:
            UsageError: Unknown mode.
        """
        if mode is not None and mode not in RENDER_MODES:
            accepted = ", ".join(RENDER_MODES)
            raise UsageError(f"render_mode = {mode!r}: accepted: None, {accepted}")
        # One picture per decision: a video at this rate runs in real time.
        self.metadata = {"render_fps": 1.0 / spec.episode.hold_s}
        """Entries for the environment's `metadata`."""
        self.wanted = mode is not None
        """True if pictures will be requested."""
        self._spec, self._kind = spec, kind
        self._renderer: EpisodeRenderer | None = None
        self._trail: list[NDArray[np.float64]] = []
        self._now: PictureContent | None = None

    def begin(self) -> None:
        """Start an episode."""
        self._trail.clear()

    def see(self, now: PictureContent) -> None:
        """Store the state at a decision."""
        self._now = now
        self._trail.append(now.position[:2].copy())

    def render(self) -> NDArray[np.uint8] | None:
        """Return the present picture (540, 960, 3) in mode `rgb_array`, otherwise None.

        Raises:
            ResetNeeded: No episode has started.
        """
        if not self.wanted:
            return None
        if self._now is None:
            raise ResetNeeded("render() before reset()")
        if self._renderer is None:
            self._renderer = EpisodeRenderer(self._spec, self._kind)
        return self._renderer.draw(self._now, self._trail)


class EpisodeRenderer:
    """Renderer of a flight; pictures are (HEIGHT_PX, WIDTH_PX, 3) uint8."""

    def __init__(self, spec: EnvironmentSpec, kind: CameraKind) -> None:
        """Store the environment, and the camera kind of the network input."""
        self._spec, self._kind = spec, kind
        self._figure = Figure(figsize=(WIDTH_PX / DPI, HEIGHT_PX / DPI), dpi=DPI)
        self._canvas = FigureCanvasAgg(self._figure)
        self._background: Any = None
        self._arena: Arena | None = None
        self._outlines: list[NDArray[np.float64]] = []

    def _begin(self, arena: Arena) -> None:
        """Draw the static parts of an episode."""
        spec = self._spec
        self._arena = arena
        self._figure.clear()
        self._map = self._figure.add_axes((0.06, 0.1, 0.5, 0.84))
        draw_arena(_standing(arena), self._map, goal_radius_m=spec.episode.goal_radius_m)
        self._map.set_title(f"{arena.name}, seed {arena.seed}", fontsize=11, color=TEXT_COLOUR)
        self._eye = self._figure.add_axes((0.62, 0.4, 0.35, 0.54))
        self._eye.set_anchor("N")
        self._eye.set(xticks=[], yticks=[])
        self._eye.spines[:].set_color(GRID_COLOUR)
        title = f"{self._kind} that the network sees"
        self._eye.set_title(title, fontsize=11, color=TEXT_COLOUR)
        movers = range(arena.n_static, len(arena.obstacles))
        self._outlines = [_outline(arena.obstacles, i) for i in movers]
        face, edge = MOVING_COLOURS
        moving: dict[str, Any] = {"animated": True, "facecolor": face, "edgecolor": edge}
        self._moving: Any = self._map.add_collection(PolyCollection([], zorder=2.1, **moving))
        (self._trail,) = self._map.plot(
            [], [], color=TRAIL_COLOUR, lw=1.4, alpha=0.8, zorder=2.5, animated=True
        )
        (self._vehicle,) = self._map.fill(
            [0.0], [0.0], color=START_COLOUR, ec="white", lw=0.8, zorder=3.5, animated=True
        )
        self._image = self._eye.imshow(
            np.zeros((spec.image_height_px, spec.image_width_px), np.uint8),
            cmap="gray",
            vmin=0,
            vmax=255,
            interpolation="nearest",
            animated=True,
        )
        self._text = self._figure.text(
            *(0.62, 0.33, ""),
            va="top",
            family="monospace",
            fontsize=11,
            linespacing=1.5,
            color=TEXT_COLOUR,
            animated=True,
        )
        self._background = None

    def draw(self, now: PictureContent, trail: Sequence[NDArray[np.float64]]) -> NDArray[np.uint8]:
        """Return the picture of a state; `trail` is the path so far, north, east [m]."""
        arena = now.arena
        if arena is not self._arena:
            self._begin(arena)
        # Static parts are drawn once and copied under every picture.
        if self._background is None:
            self._canvas.draw()
            self._background = self._canvas.copy_from_bbox(self._figure.bbox)
        self._canvas.restore_region(self._background)
        self._update(now, np.array(trail))
        for artist in (self._moving, self._trail, self._vehicle):
            self._map.draw_artist(artist)
        self._eye.draw_artist(self._image)
        self._figure.draw_artist(self._text)
        return np.asarray(self._canvas.buffer_rgba())[..., :3].copy()

    def _update(self, moment: PictureContent, trail: NDArray[np.float64]) -> None:
        arena, now, position = moment.arena, moment.flights, moment.position
        # Plots have east to the right: swap north and east.
        centers = arena.centers_at(moment.scene_us)[arena.n_static :, 1::-1]
        self._moving.set_verts(
            [outline + at for outline, at in zip(self._outlines, centers, strict=True)]
        )
        self._trail.set_data(trail[:, 1], trail[:, 0])
        self._vehicle.set_xy(_arrow(moment.yaw) + position[1::-1])
        self._image.set_data(moment.image)
        self._text.set_text(
            f"time   {now.time_s[0]:7.2f} s     {FlightStatus(int(now.verdict[0])).name.lower()}\n"
            f"goal   {now.goal_distance_m[0]:7.2f} m\n"
            f"speed  {now.speed_m_s[0]:7.2f} m/s\n"
            f"height {-position[2]:7.2f} m\n"
            f"energy {now.energy_j[0] / 1000.0:7.2f} kJ"
        )


def _standing(arena: Arena) -> Arena:
    """Return the arena without its moving obstacles."""
    o, n = arena.obstacles, arena.n_static
    standing = Obstacles(o.shape[:n], o.center[:n], o.half_size[:n], o.yaw[:n])
    return replace(arena, obstacles=standing, tours=())


def _outline(obstacles: Obstacles, i: int) -> NDArray[np.float64]:
    """Return the footprint (k, 2) east, north [m] of an obstacle around its centre."""
    along, across = obstacles.half_size[i, :2]
    if obstacles.shape[i] != Shape.BOX:
        circle: NDArray[np.float64] = along * np.stack([np.sin(CIRCLE), np.cos(CIRCLE)], axis=1)
        return circle
    corners = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * (along, across)
    return _turned(corners, float(obstacles.yaw[i]))


def _arrow(yaw: float) -> NDArray[np.float64]:
    """Return the outline (4, 2) east, north [m] of a vehicle at the origin."""
    tip, tail, wing = 0.6 * VEHICLE_M, -0.4 * VEHICLE_M, 0.4 * VEHICLE_M
    return _turned(np.array([[tip, 0.0], [tail, wing], [0.5 * tail, 0.0], [tail, -wing]]), yaw)


def _turned(points: NDArray[np.float64], yaw: float) -> NDArray[np.float64]:
    """Rotate points (k, 2) forward, right by a heading; return them as east, north."""
    c, s = math.cos(yaw), math.sin(yaw)
    north, east = c * points[:, 0] - s * points[:, 1], s * points[:, 0] + c * points[:, 1]
    return np.stack([east, north], axis=1)
