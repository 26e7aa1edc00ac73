"""Walls within an arena: rooms with doors, and gates with an opening to fly through.

The floor is halved until there are enough rooms; or a corridor runs along it, with a row of rooms
on either side. Doors join rooms along a random spanning tree, and some other neighbours. Every room
is reachable from every other. A gate is four boxes around its opening: west and east of it up to
the top, below and above it between these. All other code treats the boxes of walls, lintels and
gates as obstacles.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from airl_mav.arena.geometry import Arena, Bounds, Obstacles, Shape, Statics
from airl_mav.arena.placement import Boxes, Floats
from airl_mav.core.errors import UsageError
from airl_mav.profiles.arena import ArenaSpec
from airl_mav.profiles.walls import EDGE_M, GATE, ROOM_WALL, Rooms

TRIES = 500
"""Plans drawn before generation fails."""

MIDDLE = (0.35, 0.65)
"""Range of the cut as a share of a part's length, if rooms fit on both sides."""

_LEAST_M = 1e-9
"""Minimum length of a wall piece [m]."""


@dataclass(frozen=True)
class Rect:
    """A part of the floor with sides along north and east."""

    low: tuple[float, float]
    """South-west corner: north, east [m]."""
    high: tuple[float, float]
    """North-east corner [m]."""

    def side(self, axis: int) -> float:
        """Return the length along north, 0, or east, 1 [m]."""
        return self.high[axis] - self.low[axis]

    def between(self, axis: int, low: float, high: float) -> Rect:
        """Return the part between two positions on an axis [m]."""
        corners = [list(self.low), list(self.high)]
        corners[0][axis], corners[1][axis] = low, high
        (a, b), (c, d) = corners
        return Rect((a, b), (c, d))


@dataclass(frozen=True)
class Door:
    """An opening in a wall, from the floor up."""

    wall: int
    rooms: tuple[int, int]
    """Numbers of the two joined rooms."""
    low: float
    """Start of the door along the wall [m]."""
    high: float
    height: float
    """Height of the door [m]."""


@dataclass(frozen=True)
class Plan:
    """Rooms, the walls between them, and their doors."""

    rooms: tuple[Rect, ...]
    """Rooms, a corridor first."""
    walls: tuple[tuple[int, Rect], ...]
    """Walls with the axis across: 0 for a wall from west to east, 1 from south to north."""
    doors: tuple[Door, ...]

    def passages(self) -> Boxes:
        """Return the floor under the doors, as thick as their walls."""
        rects = []
        for door in self.doors:
            axis, wall = self.walls[door.wall]
            rects.append(wall.between(1 - axis, door.low, door.high))
        return _boxes(rects)

    def grown_passages(self, clearance_m: float) -> Boxes:
        """Return the passages extended by `clearance_m` [m] before and behind each door."""
        passages = self.passages()
        across = [self.walls[door.wall][0] for door in self.doors]
        margin = np.zeros((len(across), 2))
        margin[np.arange(len(across)), across] = clearance_m
        return Boxes(passages.center, passages.half + margin)


def draw_plan(
    rng: np.random.Generator, spec: ArenaSpec, bounds: Bounds, keep_off: Boxes, name: str
) -> Plan:
    """Draw rooms within bounds, without walls in `keep_off`. Raises UsageError if none fits."""
    rooms, width_m = spec.rooms, spec.rooms.corridor_width_m
    count = int(rng.integers(*rooms.count, endpoint=True))
    floor = Rect((bounds.north_min, bounds.east_min), (bounds.north_max, bounds.east_max))
    for _ in range(TRIES):
        found = (
            _divided(rng, rooms, floor, count)
            if width_m is None
            else _on_a_corridor(rng, rooms, floor, count, width_m)
        )
        if not _any_overlap(_boxes([wall for _, wall in found[1]]), keep_off):
            return Plan(*found, _draw_doors(rng, rooms, *found))
    raise UsageError(
        f"arena {name!r}: in {TRIES} draws of {count} rooms a wall was always within "
        f"start.clearance_m {spec.start.clearance_m:g} of the start, or as near to a fixed goal as"
        f" goal.clearance_m {spec.goal.clearance_m:g}"
    )


_Found = tuple[tuple[Rect, ...], tuple[tuple[int, Rect], ...]]


def _divided(rng: np.random.Generator, rooms: Rooms, floor: Rect, count: int) -> _Found:
    """Divide the floor into rooms recursively, mostly across the longer side."""
    done: list[Rect] = []
    walls: list[tuple[int, Rect]] = []
    todo = [(floor, count)]
    while todo:
        part, n = todo.pop()
        if n == 1:
            done.append(part)
            continue
        # Cut across the longer side, unless only the shorter one has room for two.
        axis = 0 if part.side(0) > part.side(1) else 1
        if rooms.slots(part.side(axis)) < 2:
            axis = 1 - axis
        at, first = _cut(rng, rooms, part, axis, n)
        low, high, after = part.low[axis], part.high[axis], at + rooms.thickness_m
        walls.append((axis, part.between(axis, at, after)))
        todo.append((part.between(axis, after, high), n - first))
        todo.append((part.between(axis, low, at), first))
    return tuple(done), tuple(walls)


def _cut(
    rng: np.random.Generator, rooms: Rooms, part: Rect, axis: int, n: int
) -> tuple[float, int]:
    """Return the position of the cut [m], and the number of the n rooms before it."""
    length, low = part.side(axis), part.low[axis]
    rows = rooms.slots(part.side(1 - axis))
    share = MIDDLE[0] + (MIDDLE[1] - MIDDLE[0]) * float(rng.random())
    # At least one room fits on each side.
    cut = min(
        max(share * (length - rooms.thickness_m), rooms.least_side_m),
        length - rooms.thickness_m - rooms.least_side_m,
    )
    before = rows * rooms.slots(cut)
    behind = rows * rooms.slots(length - rooms.thickness_m - cut)
    if before + behind < n:
        # Put all slack on one side, so that no row of rooms is lost.
        fit = rooms.slots(length)
        step = rooms.least_side_m + rooms.thickness_m
        slack = length + rooms.thickness_m - fit * step
        cut = fit // 2 * step - rooms.thickness_m + share * slack
        before, behind = rows * (fit // 2), rows * (fit - fit // 2)
    # Rooms in proportion to the area, within what fits on either side.
    wanted = round(n * cut / (length - rooms.thickness_m))
    return low + cut, min(max(wanted, n - behind, 1), before, n - 1)


def _on_a_corridor(
    rng: np.random.Generator, rooms: Rooms, floor: Rect, count: int, width_m: float
) -> _Found:
    """Lay a corridor along the floor, and a row of rooms on either side."""
    along = 0 if floor.side(0) >= floor.side(1) else 1
    across, thick = 1 - along, rooms.thickness_m
    free = floor.side(across) - width_m - 2.0 * thick
    depth = rooms.least_side_m + (free - 2.0 * rooms.least_side_m) * float(rng.random())
    begin = floor.low[across] + depth + thick
    end = begin + width_m
    slots = rooms.slots(floor.side(along))
    # Each side has at least one room and at most `slots`.
    least, most = max(1, count - slots), min(slots, count - 1)
    first = int(rng.integers(least, most, endpoint=True))
    done = [floor.between(across, begin, end)]
    walls = [
        (across, floor.between(across, begin - thick, begin)),
        (across, floor.between(across, end, end + thick)),
    ]
    sides = (floor.low[across], begin - thick), (end + thick, floor.high[across])
    for (low, high), n in zip(sides, (first, count - first), strict=True):
        row = floor.between(across, low, high)
        for begins, ends, last in _row(rng, rooms, row.low[along], row.side(along), n):
            done.append(row.between(along, begins, ends))
            if not last:
                walls.append((along, row.between(along, ends, ends + thick)))
    return tuple(done), tuple(walls)


def _row(
    rng: np.random.Generator, rooms: Rooms, low: float, length: float, n: int
) -> list[tuple[float, float, bool]]:
    """Return begin and end [m] of n rooms in a row, and whether each is the last."""
    slack = length - n * rooms.least_side_m - (n - 1) * rooms.thickness_m
    # Random marks divide the slack between the rooms.
    marks = np.concatenate([[0.0], np.sort(rng.random(n - 1)), [1.0]])
    sides = rooms.least_side_m + max(slack, 0.0) * np.diff(marks)
    ends = low + np.cumsum(sides) + rooms.thickness_m * np.arange(n)
    # Rounding must not leave a gap at the last wall.
    ends[-1] = low + length
    begins = np.concatenate([[low], ends[:-1] + rooms.thickness_m])
    return [
        (float(begin), float(end), k == n - 1)
        for k, (begin, end) in enumerate(zip(begins, ends, strict=True))
    ]


def _draw_doors(
    rng: np.random.Generator,
    rooms: Rooms,
    parts: tuple[Rect, ...],
    walls: tuple[tuple[int, Rect], ...],
) -> tuple[Door, ...]:
    """Draw doors of a random spanning tree (Kruskal) of the rooms, corridors first, and more."""
    pairs = [pair for k in range(len(walls)) for pair in _neighbours(rooms, parts, walls, k)]
    order = [pairs[i] for i in rng.permutation(len(pairs)).tolist()]
    # Rooms along a corridor get their door to it first; the sort is stable.
    if rooms.corridor_width_m is not None:
        order.sort(key=lambda pair: 0 not in pair[1])
    tree, others = [], []
    group = list(range(len(parts)))
    for pair in order:
        one, other = (group[room] for room in pair[1])
        # Both rooms are already connected.
        if one == other:
            others.append(pair)
            continue
        tree.append(pair)
        group = [one if each == other else each for each in group]
    chosen = tree + others[: round(rooms.extra_doors * len(others))]
    doors = []
    # Three numbers per door, used or not, so that settings do not change other draws.
    for (wall, joined, low, high), numbers in zip(
        chosen, rng.random((len(chosen), 3)), strict=True
    ):
        narrow, wide = rooms.door_width_m
        wide = min(wide, high - low - 2.0 * EDGE_M)
        width = narrow + (wide - narrow) * float(numbers[0])
        begin = low + EDGE_M + (high - low - 2.0 * EDGE_M - width) * float(numbers[1])
        least, greatest = rooms.door_height_m
        height = least + (greatest - least) * float(numbers[2])
        doors.append(Door(wall, joined, begin, begin + width, height))
    return tuple(doors)


_Pair = tuple[int, tuple[int, int], float, float]


def _neighbours(
    rooms: Rooms, parts: tuple[Rect, ...], walls: tuple[tuple[int, Rect], ...], k: int
) -> list[_Pair]:
    """Return the pairs of rooms that share enough of wall k for a door: wall, rooms, range."""
    axis, wall = walls[k]
    along = 1 - axis
    before = [i for i, p in enumerate(parts) if _adjoins(p, wall, axis, p.high, wall.low)]
    behind = [i for i, p in enumerate(parts) if _adjoins(p, wall, axis, p.low, wall.high)]
    found = []
    for i in before:
        for j in behind:
            low = max(parts[i].low[along], parts[j].low[along])
            high = min(parts[i].high[along], parts[j].high[along])
            # A door needs space for its width and both edges.
            if high - low >= rooms.door_width_m[0] + 2.0 * EDGE_M - _LEAST_M:
                found.append((k, (i, j), low, high))
    return found


def _adjoins(
    part: Rect, wall: Rect, axis: int, edge: tuple[float, float], face: tuple[float, float]
) -> bool:
    """Return whether an edge of a room touches a face of a wall."""
    along = 1 - axis
    overlap = min(part.high[along], wall.high[along]) - max(part.low[along], wall.low[along])
    return abs(edge[axis] - face[axis]) < _LEAST_M and overlap > _LEAST_M


def room_walls(plan: Plan, bounds: Bounds) -> tuple[Obstacles, Statics]:
    """Return the boxes of a plan's walls, grouped by wall with the lintels above lower doors."""
    parts: list[tuple[int, Rect, float]] = []
    for k, (axis, wall) in enumerate(plan.walls):
        along, here = 1 - axis, wall.low[1 - axis]
        for door in sorted((d for d in plan.doors if d.wall == k), key=lambda door: door.low):
            parts.append((k, wall.between(along, here, door.low), 0.0))
            if bounds.height - door.height > _LEAST_M:
                parts.append((k, wall.between(along, door.low, door.high), door.height))
            here = door.high
        parts.append((k, wall.between(along, here, wall.high[along]), 0.0))
    # Doors at the end of a wall leave pieces of length 0.
    parts = [part for part in parts if part[1].side(1 - plan.walls[part[0]][0]) > _LEAST_M]
    statics = Statics(
        names=(ROOM_WALL,) * len(plan.walls),
        of=np.array([k for k, _, _ in parts], np.int64),
        materials=(None,) * len(parts),
    )
    return _solid(parts, bounds.height), statics


def _solid(parts: list[tuple[int, Rect, float]], top_m: float) -> Obstacles:
    boxes = _boxes([rect for _, rect, _ in parts])
    bottom = np.array([low for _, _, low in parts], np.float64)
    tall = 0.5 * (top_m - bottom)
    return Obstacles(
        shape=np.full(len(parts), Shape.BOX, np.int8),
        center=np.column_stack([boxes.center, -(bottom + tall)]),
        half_size=np.column_stack([boxes.half, tall]),
        yaw=np.zeros(len(parts)),
    )


def over_doors(arena: Arena) -> NDArray[np.bool_]:
    """Return a mask (n_static,) of the primitives above a door."""
    n, boxes = arena.n_static, 0 if arena.building is None else arena.building.boxes
    over: NDArray[np.bool_] = _hang(arena.obstacles)[:n] & (np.arange(n) >= n - boxes)
    return over


def standing_on_the_floor(walls: Obstacles) -> Obstacles:
    """Return the wall boxes without lintels."""
    keep = ~_hang(walls)
    return Obstacles(walls.shape[keep], walls.center[keep], walls.half_size[keep], walls.yaw[keep])


def _hang(obstacles: Obstacles) -> NDArray[np.bool_]:
    """Return a mask (n,) of the obstacles that do not reach the floor."""
    hang: NDArray[np.bool_] = obstacles.center[:, 2] + obstacles.half_size[:, 2] < -_LEAST_M
    return hang


def _boxes(rects: list[Rect]) -> Boxes:
    low = np.array([rect.low for rect in rects], np.float64).reshape(-1, 2)
    high = np.array([rect.high for rect in rects], np.float64).reshape(-1, 2)
    return Boxes(0.5 * (low + high), 0.5 * (high - low))


def _any_overlap(boxes: Boxes, others: Boxes) -> bool:
    apart: Floats = np.abs(boxes.center[:, None] - others.center)
    return bool((apart < boxes.half[:, None] + others.half).all(axis=2).any())


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
