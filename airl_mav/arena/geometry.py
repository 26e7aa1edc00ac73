"""A concrete arena as plain arrays: what the plant, the camera, training and the report share.

Frame: local NED, origin at the vehicle's start on the floor, x north. The floor is z = 0; heights
are negative z. The four walls stand on the edges of `bounds`. Hills rise above the floor where
there is a `ground`.

A camera without global illumination needs to know what the floor and the walls get of it in the
mean. That is a balance of three surfaces, floor, walls and ceiling, of a square room with the same
height and the same share of walls (radiosity method: Goral et al., Modeling the interaction of
light between diffuse surfaces, SIGGRAPH 1984). The ceiling reflects nothing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import IntEnum
from functools import cached_property
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from airl_mav.arena.appearance import (
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
from airl_mav.core.goals import Goal
from airl_mav.profiles.appearance import DEFAULT, Appearance
from airl_mav.profiles.asset_files import MeshFile


def indoors(look: Drawn, floor_m2: float, walls: tuple[tuple[int, float], ...]) -> Drawn:
    """Return a look with the sky's light from the ceiling and no sun.

    The mean luminance on the floor equals that of a level surface outdoors, interreflections of
    walls and floor included. `walls` are row in the `Finish` and visible area [m²] of each wall
    surface.
    """
    light, albedo = look.light, look.finish.albedo.mean(axis=1)
    areas = np.array([area for _, area in walls])
    of_walls = areas @ albedo[[row for row, _ in walls]] / areas.sum()
    floor, upright = _irradiances(albedo[FLOOR], of_walls, floor_m2, float(areas.sum()))
    luminance = float(LUMINANCE @ light.sky)
    colour = light.sky / luminance if luminance > 0.0 else np.ones(3)
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
    to_floor = (1.0 - across) * floor_m2 / walls_m2
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
    """Primitive kinds of an obstacle; the numbers are what the numba kernels see."""

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
    """Whether there is one, at that height."""

    def as_array(self) -> NDArray[np.float64]:
        """Return (6,) all fields in their order for the kernels; 1: there is a ceiling, 0: none."""
        # By name: `dataclasses.astuple` copies every number, which takes longer than a depth image.
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
    """A mesh that cameras see in place of obstacles, which stay what is hit."""

    file: MeshFile
    """Its triangles: forward, right and down from its place."""
    place: tuple[float, float]
    """Of its origin on the floor: north, east [m]."""
    yaw: float
    """Heading of its forward axis [rad]."""
    scale: float
    first: int
    """The first of the obstacles that stand for it. It has the number and the material of this."""
    count: int
    """Number of these obstacles, one after the other."""
    base_m: float = 0.0
    """Height of its place above the floor [m]."""


@dataclass(frozen=True)
class Tour:
    """The closed way of one moving obstacle: way-points passed at given times, over and over."""

    times_s: Numbers  # (k,) from 0 to the tour's period, increasing
    points: Annotated[
        Floats, ArrayField(np.float64, 2)
    ]  # (k, 2) north, east [m]; the last equals the first


@dataclass(frozen=True)
class Building:
    """What there is of rooms in an arena (`arena.rooms`)."""

    rooms: int
    """Of which one may be a corridor."""
    doors: int
    boxes: int
    """So many boxes of walls between rooms are the last of those obstacles that stand."""


@dataclass(frozen=True)
class Arena:
    """One concrete arena. The same object makes bodies, depth images, episodes and pictures."""

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
    """What the look is drawn from; geometry knows none of it, and depth nothing but glass."""
    statics: Statics | None = None
    """None: every primitive that stands is a thing of its own."""
    meshes: tuple[PlacedMesh, ...] = ()
    """Those that cameras see, in the order of their obstacles, all of which stand still."""
    goal_height_m: float | None = None
    """Of the goal, above the floor; None: it has none, and is reached at any height."""
    n_gates: int = 0
    """The boxes of so many gates are the last of those obstacles that stand (`arena.gates`)."""
    building: Building | None = None
    """Of its rooms; None: it is not divided into any."""
    ground: Ground | None = None
    """Where it rises above the floor; None: nowhere."""

    @property
    def goal_point(self) -> Goal:
        """The goal as flights are told of it."""
        north, east = self.goal.tolist()
        return (north, east) if self.goal_height_m is None else (north, east, -self.goal_height_m)

    @cached_property
    def look(self) -> Drawn:
        """Materials of all surfaces, and the light; drawn when it is first asked for."""
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
        """Which obstacles (n,) are of glass, that depth passes through; None: there are none."""
        parts = () if self.statics is None else self.statics.materials
        if not self.appearance.may_have("glass", (name for name in parts if name is not None)):
            return None
        glass = self.look.finish.surface[OBSTACLE:] == SURFACES.index("glass")
        return glass if glass.any() else None

    def _indoors(self, look: Drawn) -> Drawn:
        """Return a look with the light that there is below the ceiling."""
        b, n = self.bounds, self.n_static
        length, width = b.north_max - b.north_min, b.east_max - b.east_min
        walls = [(WALLS, 2.0 * (length + width) * b.height)]
        boxes = 0 if self.building is None else self.building.boxes
        for i in range(n - boxes, n):
            # Both sides of it are seen.
            half = self.obstacles.half_size[i]
            walls.append((OBSTACLE + i, float(8.0 * half[:2].max() * half[2])))
        return indoors(look, length * width, tuple(walls))

    def mesh_of(self, i: int) -> PlacedMesh | None:
        """Return the mesh that cameras see in place of obstacle i; None: they see the obstacle."""
        owners = (each for each in self.meshes if each.first <= i < each.first + each.count)
        return next(owners, None)

    @property
    def n_static(self) -> int:
        """Number of obstacles that stand still."""
        return len(self.obstacles) - len(self.tours)

    def name_of(self, i: int) -> str:
        """Return what obstacle i is called where it is hit: "static-box-3", "static-tree-7"."""
        shape = Shape(int(self.obstacles.shape[i])).name.lower()
        if i >= self.n_static:
            return f"moving-{shape}-{i}"
        return f"static-{shape if self.statics is None else self.statics.name_of(i)}-{i}"

    def centers_at(self, time_us: int) -> NDArray[np.float64]:
        """Return all obstacle centres (n, 3) NED [m], `time_us` after the episode's start."""
        centers = self.obstacles.center.copy()
        for i, tour in enumerate(self.tours, start=self.n_static):
            t = (time_us / US_PER_S) % tour.times_s[-1]
            centers[i, 0] = np.interp(t, tour.times_s, tour.points[:, 0])
            centers[i, 1] = np.interp(t, tour.times_s, tour.points[:, 1])
        return centers
