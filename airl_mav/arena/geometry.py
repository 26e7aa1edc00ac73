"""Concrete arena as plain arrays, shared by plant, camera, training and report.

Frame: local NED, origin at the vehicle's start on the floor, x north. The floor is z = 0; heights
are negative z. The four walls are at the edges of `bounds`. Hills rise above the floor if `ground`
is set: heights on a grid, each cell two triangles split from south-west to north-east. The kernels
of `arena.relief` are imported lazily, for programs without numba.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property
from typing import Annotated, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from airl_mav.core.addons import entries, load, load_entry
from airl_mav.core.constants import US_PER_S
from airl_mav.core.fields import ArrayField
from airl_mav.core.frames import Goal
from airl_mav.profiles import arena, assets

Floats = NDArray[np.float64]

GRID_SIZE = 8
"""Length of a grid description; see `Relief.grid`."""

TOP, STEEPEST, ROWS, COLUMNS = 4, 5, 6, 7


class Relief(NamedTuple):
    """Ground as arrays for kernels."""

    heights: Floats  # (r c,) of the grid's points above the floor, row by row, south to north [m]
    """(0,) = no hills, the ground is the floor."""
    grid: Floats
    """(GRID_SIZE,) north and east of the first point [m], steps north and east [m], maximum height
    [m], maximum slope, r and c."""


def no_relief() -> Relief:
    """Return flat ground at floor level."""
    return Relief(np.zeros(0), np.zeros(GRID_SIZE))


@dataclass(frozen=True, eq=False)
class Ground:
    """Ground of an arena with hills. Compared by identity."""

    heights: Annotated[Floats, ArrayField(np.float64)]
    """(r, c) heights above the floor, not below 0 [m]; r and c are at least 2."""
    south: float
    """North of the first row [m]."""
    west: float
    """East of the first column [m]."""
    step_north: float
    """Distance between rows [m]."""
    step_east: float
    """Distance between columns [m]."""

    @cached_property
    def relief(self) -> Relief:
        """Ground as arrays for kernels."""
        step_n, step_e = self.step_north, self.step_east
        rise_n = np.diff(self.heights, axis=0) / step_n
        rise_e = np.diff(self.heights, axis=1) / step_e
        # Slopes of the triangles north-west, then south-east, of each cell's diagonal.
        steepest = max(
            float(np.hypot(rise_n[:, :-1], rise_e[1:]).max()),
            float(np.hypot(rise_n[:, 1:], rise_e[:-1]).max()),
        )
        grid = [self.south, self.west, step_n, step_e, self.top_m, steepest, *self.heights.shape]
        return Relief(self.heights.flatten(), np.array(grid))

    @property
    def top_m(self) -> float:
        """Maximum height [m]."""
        return float(self.heights.max())

    @property
    def points(self) -> Floats:
        """All points of the grid (r c, 3) NED [m], row by row."""
        r, c = self.heights.shape
        north = self.south + self.step_north * np.arange(r)
        east = self.west + self.step_east * np.arange(c)
        n, e = np.meshgrid(north, east, indexing="ij")
        return np.stack([n.ravel(), e.ravel(), -self.heights.ravel()], axis=1)

    @cached_property
    def faces(self) -> NDArray[np.int32]:
        """Triangles (m, 3) of `points` above the floor, clockwise from above, north to east."""
        r, c = self.heights.shape
        first = (np.arange(r - 1)[:, None] * c + np.arange(c - 1)).ravel()
        # Corner numbers of each cell, counted from its south-west corner.
        north, east, both = first + c, first + 1, first + c + 1
        split = [np.stack([first, north, both], axis=1), np.stack([first, both, east], axis=1)]
        every = np.stack(split, axis=1).reshape(-1, 3).astype(np.int32)
        # Level triangles at the floor belong to the floor.
        rising: NDArray[np.int32] = every[(self.heights.ravel()[every] > 0.0).any(axis=1)]
        return rising

    def height_at(self, north: float, east: float) -> float:
        """Return the height of the ground above the floor at a position [m]; 0 beyond the walls."""
        from airl_mav.arena.relief import plane_at

        return float(plane_at(self.relief, north, east)[0])

    def heights_at(self, places: Floats) -> Floats:
        """Return the heights (n,) [m] below points (n, >= 2) NED [m]."""
        return np.array([self.height_at(float(each[0]), float(each[1])) for each in places])

    def coarser(self, most: int) -> Ground:
        """Return the ground with at most `most` cells, for pictures."""
        rows, columns = (count - 1 for count in self.heights.shape)
        if rows * columns <= most:
            return self
        share = math.sqrt(most / (rows * columns))
        fewer_n, fewer_e = max(1, math.floor(share * rows)), max(1, math.floor(share * columns))
        # The total size stays; only the steps grow.
        step_n, step_e = self.step_north * rows / fewer_n, self.step_east * columns / fewer_e
        north = self.south + step_n * np.arange(fewer_n + 1, dtype=np.float64)
        east = self.west + step_e * np.arange(fewer_e + 1, dtype=np.float64)
        return Ground(self.sampled(north, east), self.south, self.west, step_n, step_e)

    def lowest_within(self, north: float, east: float, radius: float) -> float:
        """Return the ground's minimum height within a radius [m] of a position on the floor."""
        from airl_mav.arena.relief import extreme_within

        # The minimum is the negative maximum of the negative height.
        return -float(extreme_within(self.relief, north, east, radius, -1.0))

    def sampled(self, north: Floats, east: Floats) -> Floats:
        """Return the heights (rows, columns) [m] at positions north (rows,) by east (columns,)."""
        from airl_mav.arena.relief import sample

        heights = np.empty((len(north), len(east)))
        sample(self.relief, north, east, heights)
        return heights


Numbers = Annotated[Floats, ArrayField(np.float64)]
Points = Annotated[Floats, ArrayField(np.float64, 3)]


GREY = (160, 160, 160)
"""sRGB colour of obstacles without an appearance."""


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

    file: assets.MeshFile
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
    appearance: arena.Appearance = arena.DEFAULT_APPEARANCE
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
    def look(self) -> Any:
        """Materials of all surfaces, and the light; drawn on first access."""
        return load_entry("airl_mav", "COLOUR", "look", ("appearance", self.name), "colour")(self)

    @cached_property
    def clear(self) -> NDArray[np.bool_] | None:
        """Mask (n,) of glass obstacles, which depth cameras see through; None = no glass."""
        clear_of = entries("airl_mav", "COLOUR").get("clear")
        return None if clear_of is None else load(clear_of)(self)

    def colour_of(self, i: int) -> tuple[int, int, int]:
        """Return the sRGB colour 0-255 of obstacle i seen from far away; grey without colours."""
        if not entries("airl_mav", "COLOUR"):
            return GREY
        colour: tuple[int, int, int] = self.look.colour_of(i)
        return colour

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


@dataclass(frozen=True)
class Statics:
    """Owners of the static primitives, where some are parts of one asset."""

    names: tuple[str, ...]  # (k,) name of the shape or asset of each owner
    of: Annotated[NDArray[np.int64], ArrayField(np.int64)]
    """(n_static,) index of the owner of each primitive, ascending."""
    materials: tuple[str | None, ...]  # (n_static,) None = the owner's drawn material

    def name_of(self, i: int) -> str:
        """Return the name of the owner of primitive i."""
        return self.names[int(self.of[i])]
