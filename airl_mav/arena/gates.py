"""Gates: walls across the arena with an opening that the vehicle has to fly through.

A gate is four boxes around its opening: west and east of it up to the top, below and above it
between these. All other code treats the boxes as obstacles.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from airl_mav.arena.finishes import Statics
from airl_mav.arena.geometry import Arena, Bounds, Obstacles, Shape
from airl_mav.arena.placement import Boxes, Floats
from airl_mav.profiles.arena import GATE, ArenaSpec

PARTS = 4
"""Boxes of a gate, in this order: west and east of the opening, below and above it."""

NUMBERS = 5
"""Uniform numbers drawn for each gate."""


@dataclass(frozen=True)
class Openings:
    """The openings of k gates, the southernmost first."""

    center: Floats  # (k, 3) NED [m]
    half_size: Floats  # (k, 3) half thickness of the wall, half width, half height [m]

    def __len__(self) -> int:
        """Return k."""
        return len(self.center)


def draw_openings(rng: np.random.Generator, spec: ArenaSpec) -> Openings:
    """Draw the openings of the gates, uniform within `spec.gates`; every value fits."""
    gates = spec.gates
    k = int(rng.integers(*gates.count, endpoint=True))
    numbers = rng.random((k, NUMBERS))

    def within(column: int, limits: tuple[float, float]) -> Floats:
        scaled: Floats = limits[0] + (limits[1] - limits[0]) * numbers[:, column]
        return scaled

    step = within(0, gates.spacing_m)
    # The first gate is measured from the start, later ones from the gate before.
    step[:1] = within(0, gates.first_m)[:1]
    east, middle = within(1, gates.lateral_m), within(2, gates.middle_m)
    width, height = within(3, gates.width_m), within(4, gates.height_m)
    center = np.column_stack([np.cumsum(step), east, -middle])
    thickness = np.full(k, gates.thickness_m)
    return Openings(center, 0.5 * np.column_stack([thickness, width, height]))


def frames(openings: Openings, bounds: Bounds) -> Obstacles:
    """Return the boxes of gates, PARTS each, from west to east wall and floor to top."""
    k = len(openings)
    (north, east, down), (thick, wide, tall) = openings.center.T, openings.half_size.T
    west_edge, east_edge, bottom, top = east - wide, east + wide, -down - tall, -down + tall
    low, high = np.full(k, bounds.east_min), np.full(k, bounds.east_max)
    floor, ceiling = np.zeros(k), np.full(k, bounds.height)
    # The parts in the order of PARTS.
    sides = [
        (low, west_edge, floor, ceiling),
        (east_edge, high, floor, ceiling),
        (west_edge, east_edge, floor, bottom),
        (west_edge, east_edge, top, ceiling),
    ]
    center, half_size = np.empty((k, PARTS, 3)), np.empty((k, PARTS, 3))
    for part, (west, last, lower, upper) in enumerate(sides):
        center[:, part] = np.column_stack([north, 0.5 * (west + last), -0.5 * (lower + upper)])
        half_size[:, part] = np.column_stack([thick, 0.5 * (last - west), 0.5 * (upper - lower)])
    return Obstacles(
        shape=np.full(PARTS * k, Shape.BOX, np.int8),
        center=center.reshape(-1, 3),
        half_size=half_size.reshape(-1, 3),
        yaw=np.zeros(PARTS * k),
    )


def with_gates(statics: Statics | None, standing: Obstacles, k: int) -> Statics | None:
    """Return the groups of static primitives with k gates appended; None = no groups."""
    if k == 0:
        return statics
    gates = Statics((GATE,) * k, np.repeat(np.arange(k), PARTS), (None,) * (PARTS * k))
    return with_walls(statics, standing, gates)


def with_walls(statics: Statics | None, standing: Obstacles, walls: Statics) -> Statics:
    """Return the groups of static primitives with groups of walls appended."""
    if statics is None:
        # Without groups every primitive is its own owner.
        names = tuple(Shape(int(shape)).name.lower() for shape in standing.shape)
        statics = Statics(names, np.arange(len(names)), (None,) * len(names))
    return Statics(
        names=statics.names + walls.names,
        of=np.concatenate([statics.of, len(statics.names) + walls.of]),
        materials=statics.materials + walls.materials,
    )


def openings_of(arena: Arena) -> Openings:
    """Return the openings of an arena's gates, from its obstacles."""
    first = np.flatnonzero(_part_of_gate(arena) == 0)
    center, half = arena.obstacles.center, arena.obstacles.half_size
    # Offsets of the parts behind the west box, in the order of PARTS.
    west, below, above = first, first + 2, first + 3
    bottom = center[below, 2] - half[below, 2]
    top = center[above, 2] + half[above, 2]
    found = np.column_stack([center[west, 0], center[below, 1], 0.5 * (bottom + top)])
    size = np.column_stack([half[west, 0], half[below, 1], 0.5 * (bottom - top)])
    order = np.argsort(found[:, 0], kind="stable")
    return Openings(found[order], size[order])


def over_openings(arena: Arena) -> NDArray[np.bool_]:
    """Return a mask (n_static,) of the static primitives above or below a gate's opening."""
    crossing: NDArray[np.bool_] = _part_of_gate(arena) >= 2
    return crossing


def _part_of_gate(arena: Arena) -> NDArray[np.int64]:
    """Return the part of a gate (n_static,) of each primitive, 0 to PARTS - 1; -1 = no gate."""
    parts = np.full(arena.n_static, -1, np.int64)
    # The boxes of gates are the last static obstacles.
    boxes = PARTS * arena.n_gates
    parts[arena.n_static - boxes :] = np.arange(boxes) % PARTS
    return parts


def closed_from_above(frame: Obstacles) -> Obstacles:
    """Return the gates' boxes that block every height: west and east of the opening."""
    keep = np.arange(len(frame)) % PARTS < 2
    return Obstacles(frame.shape[keep], frame.center[keep], frame.half_size[keep], frame.yaw[keep])


def behind(openings: Openings, bounds: Bounds, clearance_m: float) -> Boxes:
    """Return the floor (at most one box) up to `clearance_m` [m] behind the last gate."""
    if not len(openings):
        return Boxes(np.zeros((0, 2)), np.zeros((0, 2)))
    last = float((openings.center[:, 0] + openings.half_size[:, 0]).max()) + clearance_m
    south, middle = bounds.north_min, 0.5 * (bounds.east_min + bounds.east_max)
    wide = 0.5 * (bounds.east_max - bounds.east_min)
    return Boxes(
        np.array([[0.5 * (south + last), middle]]), np.array([[0.5 * (last - south), wide]])
    )
