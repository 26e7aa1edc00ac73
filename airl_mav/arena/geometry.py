"""Concrete arena as plain arrays, shared by plant, camera, training and report.

Frame: local NED, origin at the vehicle's start on the floor, x north. The floor is z = 0; heights
are negative z. The four walls are at the edges of `bounds`. Hills rise above the floor if `ground`
is set.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from airl_mav.arena.ground import Ground
from airl_mav.core.addons import entries, load, load_entry
from airl_mav.core.constants import US_PER_S
from airl_mav.core.fields import ArrayField
from airl_mav.core.frames import Goal
from airl_mav.profiles.arena import DEFAULT_APPEARANCE, Appearance
from airl_mav.profiles.assets import MeshFile

Floats = NDArray[np.float64]
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
    appearance: Appearance = DEFAULT_APPEARANCE
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
