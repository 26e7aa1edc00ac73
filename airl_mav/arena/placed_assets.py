"""Draws of static obstacles with assets of several parts: asset, heading and scale."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from airl_mav.arena.geometry import Arena, Obstacles, PlacedMesh, Shape, Statics
from airl_mav.arena.placement import Floats, bounding_half
from airl_mav.core import plugins
from airl_mav.core.errors import UsageError
from airl_mav.core.kernels import kernel
from airl_mav.profiles.arena import (
    DEFAULT_APPEARANCE,
    SHAPES,
    SPHERE_OFFSET,
    ArenaSpec,
    StaticObstacles,
)
from airl_mav.profiles.assets import Asset, MeshFile

_BOX, _SPHERE = int(Shape.BOX), int(Shape.SPHERE)

NUMBERS = 5
"""Uniform numbers drawn for each body."""


@dataclass(frozen=True)
class AssetBodies:
    """n primitives without a position. Fields as in Obstacles."""

    shape: NDArray[np.int8]  # (n,)
    half_size: Floats  # (n, 3) [m]
    yaw: Floats  # (n,) [rad]
    center_height: Floats  # (n,) above the floor [m]
    bounding_half: Floats  # (n, 2) half extents north, east [m]

    def __len__(self) -> int:
        """Return n."""
        return len(self.shape)

    def at(self, places: Floats) -> Obstacles:
        """Return obstacles placed at `places` (n, 2) north, east [m]."""
        center = np.empty((len(self), 3))
        center[:, :2], center[:, 2] = places, -self.center_height
        return Obstacles(self.shape, center, self.half_size, self.yaw)


def draw_bodies(
    rng: np.random.Generator, n: int, kind: StaticObstacles, altitude_m: float
) -> AssetBodies:
    """Draw n bodies, widest first as they are hardest to place; spheres cross `altitude_m`."""
    allowed = _shapes(kind.shapes)
    shape = allowed[rng.integers(len(allowed), size=n)]
    # One numpy call is faster than passing a generator to numba.
    bodies = bodies_of(rng.random(NUMBERS * n), shape, kind, altitude_m)
    _widest_first(
        bodies.shape, bodies.half_size, bodies.yaw, bodies.center_height, bodies.bounding_half
    )
    return bodies


def bodies_of(
    numbers: Floats, shape: NDArray[np.int8], kind: StaticObstacles, altitude_m: float
) -> AssetBodies:
    """Return bodies of a shape (n,) scaled from `numbers` (NUMBERS n,); see `_size`."""
    n = len(shape)
    half_size, yaw, center_height = np.empty((n, 3)), np.empty(n), np.empty(n)
    _size(
        numbers, shape, kind.half_width_m, kind.height_m, altitude_m, half_size, yaw, center_height
    )
    half = bounding_half(shape, half_size, yaw)
    return AssetBodies(shape, half_size, yaw, center_height, half)


@kernel
def _size(
    numbers: Floats,
    shape: NDArray[np.int8],
    half_width_m: tuple[float, float],
    height_m: tuple[float, float],
    altitude_m: float,
    half_size: Floats,
    yaw: Floats,
    center_height: Floats,
) -> None:
    """Write `half_size` (n, 3), `yaw` (n,) and `center_height` (n,) of bodies of a shape (n,).

    `numbers` (5 n,) in [0, 1) are n pairs of half widths, n heights, n headings and n offsets of
    spheres from the flight altitude, scaled as `Generator.uniform` does.
    """
    n, (narrow, wide), (flat, tall) = len(shape), half_width_m, height_m
    for i in range(n):
        radius = narrow + (wide - narrow) * numbers[2 * i]
        half_size[i, 0] = half_size[i, 1] = radius
        half_size[i, 2] = (flat + (tall - flat) * numbers[2 * n + i]) / 2.0
        yaw[i], center_height[i] = 0.0, half_size[i, 2]
        if shape[i] == _BOX:
            half_size[i, 1] = narrow + (wide - narrow) * numbers[2 * i + 1]
            yaw[i] = -math.pi + 2.0 * math.pi * numbers[3 * n + i]
        elif shape[i] == _SPHERE:
            offset = -SPHERE_OFFSET + 2.0 * SPHERE_OFFSET * numbers[4 * n + i]
            half_size[i, 2] = radius
            # A sphere near the floor rests on it instead of sinking in.
            center_height[i] = max(radius, altitude_m + offset * radius)


@kernel
def _widest_first(
    shape: NDArray[np.int8], half_size: Floats, yaw: Floats, center_height: Floats, half: Floats
) -> None:
    """Sort the fields of `AssetBodies` stably by their widest side. Insertion sort: few bodies."""
    for i in range(1, len(shape)):
        j = i
        while j > 0 and max(half[j, 0], half[j, 1]) > max(half[j - 1, 0], half[j - 1, 1]):
            k = j - 1
            shape[j], shape[k] = shape[k], shape[j]
            yaw[j], yaw[k] = yaw[k], yaw[j]
            center_height[j], center_height[k] = center_height[k], center_height[j]
            for axis in range(3):
                half_size[j, axis], half_size[k, axis] = half_size[k, axis], half_size[j, axis]
            for axis in range(2):
                half[j, axis], half[k, axis] = half[k, axis], half[j, axis]
            j = k


@lru_cache
def _shapes(names: tuple[str, ...]) -> NDArray[np.int8]:
    """Return the numbers of shapes, cached: looking up enum members by name is slow."""
    return np.array([Shape[name.upper()] for name in names], np.int8)


def generate_own(
    spec: ArenaSpec, seed: int, *, name: str, vehicle_width_m: float, zone: int | None
) -> Arena:
    """Generate an arena with a custom generator; arguments as in `generate`. Raises UsageError."""
    make = plugins.load_part(plugins.GENERATORS, spec.generator)
    told = f"generator {spec.generator!r}, seed {seed}"
    try:
        arena = make(spec, seed, name=name, vehicle_width_m=vehicle_width_m, zone=zone)
    except Exception as error:
        words = " ".join(f"{type(error).__name__}: {error}".split())
        raise UsageError(f"{told}: {words}") from error
    if not isinstance(arena, Arena):
        raise UsageError(f"{told}: makes {type(arena).__name__}; accepted: airl_mav's Arena")
    if (problem := _problem(arena)) is not None:
        raise UsageError(f"{told}: {problem}")
    if (
        arena.appearance == DEFAULT_APPEARANCE
    ):  # The generator set no appearance: use the profile's.
        return replace(arena, appearance=spec.appearance)
    return arena


def _problem(arena: Arena) -> str | None:
    """Return the first error of a custom arena, or None if it can be flown."""
    obstacles, b = arena.obstacles, arena.bounds
    n = len(obstacles)
    shapes = {"center": (n, 3), "half_size": (n, 3), "yaw": (n,)}
    for field, wanted in shapes.items():
        found = np.asarray(getattr(obstacles, field))
        if found.shape != wanted or not np.isfinite(found).all():
            return f"obstacles.{field} {found.shape}; accepted: {wanted} numbers"
    if len(arena.tours) > n:
        return f"{len(arena.tours)} tours; accepted: at most one an obstacle, {n}"
    for mesh in arena.meshes:
        # Meshes must own static obstacles of the arena.
        if not 0 <= mesh.first < mesh.first + mesh.count <= arena.n_static or mesh.scale <= 0.0:
            return f"meshes: accepted: each with obstacles that stand, and a scale > 0; not {mesh}"
    if (ground := arena.ground) is not None:
        heights = np.asarray(ground.heights)
        if heights.ndim != 2 or min(heights.shape) < 2 or not (heights >= 0.0).all():
            return f"ground.heights {heights.shape}; accepted: two or more each way, none below 0"
        if not (np.isfinite(heights).all() and min(ground.step_north, ground.step_east) > 0.0):
            return "ground: accepted: finite heights, and steps > 0"
    for what, place in (("start", (0.0, 0.0)), ("goal", tuple(np.asarray(arena.goal)))):
        inside = len(place) == 2 and (
            b.north_min < place[0] < b.north_max and b.east_min < place[1] < b.east_max
        )
        if not inside:
            return f"the {what} {place} is not between the walls"
    return None


@dataclass(frozen=True)
class _Seen:
    """A mesh that cameras render in place of an asset's primitives."""

    file: MeshFile
    yaw: float
    scale: float


@dataclass(frozen=True)
class Things:
    """n obstacles without a position, made of m primitives."""

    parts: AssetBodies
    """m primitives, grouped by obstacle."""
    offset: Floats  # (m, 2) of a primitive from its obstacle's position, north, east [m]
    statics: Statics
    bounding_half: Floats  # (n, 2) half extents north, east about the position [m]
    seen: tuple[_Seen | None, ...]  # (n,) None = cameras render the primitives

    def at(self, places: Floats) -> Obstacles:
        """Return the primitives of obstacles placed at `places` (n, 2) north, east [m]."""
        return self.parts.at(places[self.statics.of] + self.offset)

    def meshes_at(self, places: Floats) -> tuple[PlacedMesh, ...]:
        """Return the meshes of obstacles placed at `places` (n, 2) north, east [m]."""
        ends = np.searchsorted(self.statics.of, np.arange(len(self.seen)), side="right").tolist()
        begins = [0, *ends[:-1]]
        return tuple(
            PlacedMesh(each.file, (north, east), each.yaw, each.scale, begin, end - begin)
            for each, (north, east), begin, end in zip(
                self.seen, places.tolist(), begins, ends, strict=True
            )
            if each is not None
        )


@dataclass(frozen=True)
class _Thing:
    """One obstacle of k primitives."""

    name: str
    parts: AssetBodies
    offset: Floats  # (k, 2)
    materials: tuple[str | None, ...]
    seen: _Seen | None = None

    @property
    # The position is the asset's origin, so parts may extend further to one side.
    def reach(self) -> Floats:
        """Half extents (2,) north, east about its position [m]."""
        reach: Floats = (np.abs(self.offset) + self.parts.bounding_half).max(axis=0)
        return reach


def draw_things(rng: np.random.Generator, n: int, spec: ArenaSpec) -> Things:
    """Draw n obstacles of `spec.static.shapes`, widest first; assets take equally many draws."""
    kinds = spec.static.shapes
    names = [kinds[i] for i in rng.integers(len(kinds), size=n).tolist()]
    numbers = rng.random(NUMBERS * n)
    shape = [Shape[name.upper()] if name in SHAPES else Shape.BOX for name in names]
    plain = bodies_of(numbers, np.array(shape, np.int8), spec.static, spec.flight_altitude_m)
    least, greatest = spec.asset_scale
    things = []
    for i, name in enumerate(names):
        if (asset := spec.asset(name)) is None:
            row = slice(i, i + 1)
            body = AssetBodies(
                plain.shape[row],
                plain.half_size[row],
                plain.yaw[row],
                plain.center_height[row],
                plain.bounding_half[row],
            )
            things.append(_Thing(name, body, np.zeros((1, 2)), (None,)))
        else:
            # The numbers that a primitive uses for heading and offset serve heading and scale here.
            yaw = -math.pi + math.tau * float(numbers[3 * n + i])
            scale = least + (greatest - least) * float(numbers[4 * n + i])
            things.append(_turned(name, asset, yaw, scale))
    # Wide obstacles are hardest to place, so they come first.
    things.sort(key=lambda thing: -float(thing.reach.max()))
    return _joined(things)


def _turned(name: str, asset: Asset, yaw: float, scale: float) -> _Thing:
    parts = asset.parts
    shape = np.array([Shape[part.shape.upper()] for part in parts], np.int8)
    half_size = scale * np.array([part.half_size_m for part in parts])
    bottom = scale * np.array([part.bottom_m for part in parts])
    ahead, right = scale * np.array([(part.forward_m, part.right_m) for part in parts]).T
    cos, sin = math.cos(yaw), math.sin(yaw)
    headings = np.array([yaw + part.yaw_rad if part.shape == "box" else 0.0 for part in parts])
    half = bounding_half(shape, half_size, headings)
    bodies = AssetBodies(shape, half_size, headings, bottom + half_size[:, 2], half)
    offset = np.column_stack([cos * ahead - sin * right, sin * ahead + cos * right])
    seen = None if asset.mesh is None else _Seen(asset.mesh, yaw, scale)
    return _Thing(name, bodies, offset, tuple(part.material for part in parts), seen)


def _joined(things: list[_Thing]) -> Things:
    parts = [thing.parts for thing in things]
    return Things(
        AssetBodies(
            np.concatenate([np.zeros(0, np.int8), *(part.shape for part in parts)]),
            np.concatenate([np.zeros((0, 3)), *(part.half_size for part in parts)]),
            np.concatenate([np.zeros(0), *(part.yaw for part in parts)]),
            np.concatenate([np.zeros(0), *(part.center_height for part in parts)]),
            np.concatenate([np.zeros((0, 2)), *(part.bounding_half for part in parts)]),
        ),
        np.concatenate([np.zeros((0, 2)), *(thing.offset for thing in things)]),
        Statics(
            names=tuple(thing.name for thing in things),
            of=np.repeat(np.arange(len(things)), [len(part) for part in parts]),
            materials=tuple(name for thing in things for name in thing.materials),
        ),
        np.array([thing.reach for thing in things]).reshape(len(things), 2),
        tuple(thing.seen for thing in things),
    )
