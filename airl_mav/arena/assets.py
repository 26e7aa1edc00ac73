"""Draw what stands where some of it is made of parts: which asset, its heading and its scale."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from airl_mav.arena.appearance import Statics
from airl_mav.arena.bodies import NUMBERS, Bodies, bodies_of
from airl_mav.arena.footprints import Floats, bounding_half
from airl_mav.arena.geometry import Obstacles, PlacedMesh, Shape
from airl_mav.profiles.arena import SHAPES, ArenaSpec
from airl_mav.profiles.assets import Asset
from airl_mav.profiles.mesh_file import MeshFile


@dataclass(frozen=True)
class _Seen:
    """A mesh that cameras see of a thing."""

    file: MeshFile
    yaw: float
    scale: float


@dataclass(frozen=True)
class Things:
    """n things that have no place yet, made of m primitives."""

    parts: Bodies
    """m primitives, those of a thing one after the other."""
    offset: Floats  # (m, 2) of a primitive from its thing's place, north, east [m]
    statics: Statics
    bounding_half: Floats  # (n, 2) half extents north, east about the thing's place [m]
    seen: tuple[_Seen | None, ...]  # (n,) None: cameras see the primitives

    def at(self, places: Floats) -> Obstacles:
        """Return the primitives of things that stand at `places` (n, 2) north, east [m]."""
        return self.parts.at(places[self.statics.of] + self.offset)

    def meshes_at(self, places: Floats) -> tuple[PlacedMesh, ...]:
        """Return the meshes of things that stand at `places` (n, 2) north, east [m]."""
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
    """One thing, of k primitives."""

    name: str
    parts: Bodies
    offset: Floats  # (k, 2)
    materials: tuple[str | None, ...]
    seen: _Seen | None = None

    @property
    def reach(self) -> Floats:
        """Half extents (2,) north, east about its place [m]."""
        reach: Floats = (np.abs(self.offset) + self.parts.bounding_half).max(axis=0)
        return reach


def draw_things(rng: np.random.Generator, n: int, spec: ArenaSpec) -> Things:
    """Draw n things of the kinds of `spec.static.shapes`, the widest first.

    As many numbers are drawn for an asset as for a shape: what one thing is changes no other.
    """
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
            body = Bodies(
                plain.shape[row],
                plain.half_size[row],
                plain.yaw[row],
                plain.center_height[row],
                plain.bounding_half[row],
            )
            things.append(_Thing(name, body, np.zeros((1, 2)), (None,)))
        else:
            yaw = -math.pi + math.tau * float(numbers[3 * n + i])
            scale = least + (greatest - least) * float(numbers[4 * n + i])
            things.append(_turned(name, asset, yaw, scale))
    things.sort(key=lambda thing: -float(thing.reach.max()))
    return _joined(things)


def _turned(name: str, asset: Asset, yaw: float, scale: float) -> _Thing:
    """Return an asset of a heading [rad] and a scale."""
    parts = asset.parts
    shape = np.array([Shape[part.shape.upper()] for part in parts], np.int8)
    half_size = scale * np.array([part.half_size_m for part in parts])
    bottom = scale * np.array([part.bottom_m for part in parts])
    ahead, right = scale * np.array([(part.forward_m, part.right_m) for part in parts]).T
    cos, sin = math.cos(yaw), math.sin(yaw)
    headings = np.array([yaw + part.yaw_rad if part.shape == "box" else 0.0 for part in parts])
    half = bounding_half(shape, half_size, headings)
    bodies = Bodies(shape, half_size, headings, bottom + half_size[:, 2], half)
    offset = np.column_stack([cos * ahead - sin * right, sin * ahead + cos * right])
    seen = None if asset.mesh is None else _Seen(asset.mesh, yaw, scale)
    return _Thing(name, bodies, offset, tuple(part.material for part in parts), seen)


def _joined(things: list[_Thing]) -> Things:
    """Return things in their order."""
    parts = [thing.parts for thing in things]
    return Things(
        Bodies(
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
