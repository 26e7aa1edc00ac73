"""Concrete arena as plain arrays, shared by plant, camera, training and report.

Frame: local NED, origin at the vehicle's start on the floor, x north. The floor is z = 0; heights
are negative z. The four walls are at the edges of `bounds`. Hills rise above the floor if `ground`
is set.

A camera without global illumination needs the mean irradiance of floor and walls. The balance of
floor, walls and ceiling is solved for a square room with the same height and the same share of
walls (radiosity method: Goral et al., Modeling the interaction of light between diffuse surfaces,
SIGGRAPH 1984). The ceiling reflects nothing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import IntEnum
from functools import cached_property
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from airl_mav.arena.finishes import (
    FLOOR,
    LUMINANCE,
    OBSTACLE,
    SURFACES,
    WALLS,
    Drawn,
    Floats,
    Inside,
    Light,
    Statics,
    draw_appearance,
)
from airl_mav.arena.ground import Ground
from airl_mav.core.constants import US_PER_S
from airl_mav.core.fields import ArrayField
from airl_mav.core.frames import Goal
from airl_mav.profiles.appearance import DEFAULT, Appearance
from airl_mav.profiles.assets import MeshFile


def indoors(look: Drawn, floor_m2: float, walls: tuple[tuple[int, float], ...]) -> Drawn:
    """Return an appearance lit by a ceiling of the sky's colour, without a sun.

    The mean luminance on the floor equals the luminance of a level surface outdoors, including
    interreflections of walls and floor. `walls` are row in the `Finish` and visible area [m²] of
    each wall surface.
    """
    light, albedo = look.light, look.finish.albedo.mean(axis=1)
    areas = np.array([area for _, area in walls])
    of_walls = areas @ albedo[[row for row, _ in walls]] / areas.sum()
    floor, upright = _irradiances(albedo[FLOOR], of_walls, floor_m2, float(areas.sum()))
    luminance = float(LUMINANCE @ light.sky)
    # Without sky light the ceiling is white.
    colour = light.sky / luminance if luminance > 0.0 else np.ones(3)
    # The brightness of the ceiling that gives the floor its outdoor luminance.
    glow = colour * luminance / float(LUMINANCE @ (colour * floor))
    inside = Light(
        to_sun=light.to_sun,
        sun=np.zeros(3),
        zenith=glow,
        horizon=glow,
        extinction=light.extinction,
        inside=Inside(floor * glow, upright * glow),
    )
    return replace(look, light=inside)


def _irradiances(
    floor_albedo: Floats, wall_albedo: Floats, floor_m2: float, walls_m2: float
) -> tuple[Floats, Floats]:
    """Return mean irradiance (3,) of floor and walls for a ceiling of radiosity 1."""
    across = seen_across(4.0 * floor_m2 / walls_m2)
    # Reciprocity of view factors: floor area times factor equals wall area times factor.
    to_floor = (1.0 - across) * floor_m2 / walls_m2
    # A wall sees floor and ceiling alike; the rest of its view is walls.
    among = 1.0 - 2.0 * to_floor
    # floor = across + (1 - across) wall_albedo walls
    # walls = to_floor + to_floor floor_albedo floor + among wall_albedo walls
    gain = to_floor * floor_albedo
    walls = (to_floor + gain * across) / (
        1.0 - among * wall_albedo - gain * (1.0 - across) * wall_albedo
    )
    return across + (1.0 - across) * wall_albedo * walls, walls


def seen_across(x: float) -> float:
    """Return the view factor between two squares, of side / distance `x`, one above the other.

    Howell and Menguc, A catalog of radiation heat transfer configuration factors, C-11.
    """
    square, root = x * x, math.sqrt(1.0 + x * x)
    log = 0.5 * math.log((1.0 + square) ** 2 / (1.0 + 2.0 * square))
    turns = 2.0 * x * root * math.atan(x / root) - 2.0 * x * math.atan(x)
    return 2.0 / (math.pi * square) * (log + turns)


Numbers = Annotated[Floats, ArrayField(np.float64)]
Points = Annotated[Floats, ArrayField(np.float64, 3)]


class Shape(IntEnum):
    """Primitive shapes of obstacles; the numba kernels use the numbers."""

    BOX = 0
    CYLINDER = 1
    SPHERE = 2


@dataclass(frozen=True)
class Bounds:
    """The arena's floor rectangle and wall height."""

    north_min: float
    north_max: float
    east_min: float
    east_max: float
    height: float
    """Wall height above the floor [m], positive."""
    ceiling: bool = False
    """True if there is a ceiling at that height."""

    def as_array(self) -> NDArray[np.float64]:
        """Return all fields (6,) in order for the kernels; the last is 1 with a ceiling, else 0."""
        # By name: `dataclasses.astuple` copies every number and takes longer than a depth image.
        rectangle = (self.north_min, self.north_max, self.east_min, self.east_max)
        return np.array([*rectangle, self.height, self.ceiling], np.float64)


@dataclass(frozen=True)
class Obstacles:
    """n primitives, static ones first."""

    shape: Annotated[NDArray[np.int8], ArrayField(np.int8)]  # (n,) Shape
    center: Points  # (n, 3) NED [m]; for moving ones: at time 0
    half_size: Points  # (n, 3) [m]
    """Box: half extents along its own axes. Cylinder (vertical axis): radius, radius, half height.
    Sphere: radius three times."""
    yaw: Numbers  # (n,) heading of a box's first axis [rad]

    def __len__(self) -> int:
        """Return n."""
        return len(self.shape)


@dataclass(frozen=True)
class PlacedMesh:
    """A mesh that cameras render in place of obstacles; collisions use the obstacles."""

    file: MeshFile
    """Triangles: forward, right and down from the mesh's position."""
    place: tuple[float, float]
    """Position of the origin on the floor: north, east [m]."""
    yaw: float
    """Heading of the forward axis [rad]."""
    scale: float
    first: int
    """First obstacle of the mesh; the mesh has the obstacle's number and material."""
    count: int
    """Number of consecutive obstacles of the mesh."""
    base_m: float = 0.0
    """Height of the origin above the floor [m]."""


@dataclass(frozen=True)
class Tour:
    """Periodic path of one moving obstacle: way-points with times."""

    times_s: Numbers  # (k,) from 0 to the tour's period, increasing
    points: Annotated[
        Floats, ArrayField(np.float64, 2)
    ]  # (k, 2) north, east [m]; the last equals the first


@dataclass(frozen=True)
class Building:
    """Summary of the rooms in an arena (`arena.room_plan`)."""

    rooms: int
    """Number of rooms, including a corridor."""
    doors: int
    boxes: int
    """Number of interior wall boxes, stored after all other static obstacles."""


@dataclass(frozen=True)
class Arena:
    """A concrete arena, the source of bodies, depth images, episodes and pictures."""

    name: str
    seed: int
    bounds: Bounds
    wall_colour: tuple[int, int, int]
    """sRGB, 0-255."""
    obstacles: Obstacles
    """All obstacles; the last `len(tours)` of them move."""
    tours: tuple[Tour, ...]
    goal: Numbers  # (2,) north, east [m] from the start
    appearance: Appearance = DEFAULT
    """Distribution of the appearance. Geometry is independent of it, and depth except for glass."""
    statics: Statics | None = None
    """Groups of static primitives; None = every primitive is separate."""
    meshes: tuple[PlacedMesh, ...] = ()
    """Meshes for cameras, in the order of their obstacles; all are static."""
    goal_height_m: float | None = None
    """Height of the goal above the floor [m]; None = reached at any height."""
    n_gates: int = 0
    """Number of gates; their boxes are stored after all other static obstacles (`arena.gates`)."""
    building: Building | None = None
    """Rooms; None = no rooms."""
    ground: Ground | None = None
    """Hills; None = flat floor."""

    @property
    def goal_point(self) -> Goal:
        """Goal as reported to flights: north, east [m], and down [m] if the goal has a height."""
        north, east = self.goal.tolist()
        return (north, east) if self.goal_height_m is None else (north, east, -self.goal_height_m)

    @cached_property
    def look(self) -> Drawn:
        """Materials of all surfaces, and the light; drawn on first access."""
        look = draw_appearance(
            self.appearance,
            self.seed,
            self.n_static,
            len(self.tours),
            self.wall_colour,
            self.statics,
        )
        return self._indoors(look) if self.bounds.ceiling else look

    @cached_property
    def clear(self) -> NDArray[np.bool_] | None:
        """Mask (n,) of glass obstacles, which depth cameras see through; None = no glass."""
        parts = () if self.statics is None else self.statics.materials
        # The appearance is drawn only if a material can be glass.
        if not self.appearance.may_have("glass", (name for name in parts if name is not None)):
            return None
        glass = self.look.finish.surface[OBSTACLE:] == SURFACES.index("glass")
        return glass if glass.any() else None

    def _indoors(self, look: Drawn) -> Drawn:
        """Return an appearance with the light below the ceiling."""
        b, n = self.bounds, self.n_static
        length, width = b.north_max - b.north_min, b.east_max - b.east_min
        walls = [(WALLS, 2.0 * (length + width) * b.height)]
        boxes = 0 if self.building is None else self.building.boxes
        for i in range(n - boxes, n):
            # Both sides are visible.
            half = self.obstacles.half_size[i]
            walls.append((OBSTACLE + i, float(8.0 * half[:2].max() * half[2])))
        return indoors(look, length * width, tuple(walls))

    def mesh_of(self, i: int) -> PlacedMesh | None:
        """Return the mesh that cameras render in place of obstacle i, or None."""
        owners = (each for each in self.meshes if each.first <= i < each.first + each.count)
        return next(owners, None)

    @property
    def n_static(self) -> int:
        """Number of static obstacles."""
        return len(self.obstacles) - len(self.tours)

    def name_of(self, i: int) -> str:
        """Return the name of obstacle i in collision reports: "static-box-3", "static-tree-7"."""
        shape = Shape(int(self.obstacles.shape[i])).name.lower()
        if i >= self.n_static:
            return f"moving-{shape}-{i}"
        return f"static-{shape if self.statics is None else self.statics.name_of(i)}-{i}"

    def centers_at(self, time_us: int) -> NDArray[np.float64]:
        """Return all obstacle centres (n, 3) NED [m], `time_us` [us] after the episode's start."""
        centers = self.obstacles.center.copy()
        for i, tour in enumerate(self.tours, start=self.n_static):
            # Tours are cyclic.
            t = (time_us / US_PER_S) % tour.times_s[-1]
            centers[i, 0] = np.interp(t, tour.times_s, tour.points[:, 0])
            centers[i, 1] = np.interp(t, tour.times_s, tour.points[:, 1])
        return centers
