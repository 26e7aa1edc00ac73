"""Rooms and ceilings against rasters, closed forms and pybullet."""

from __future__ import annotations

import hashlib
import io
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from numpy.typing import NDArray
from pydantic import TypeAdapter, ValidationError
from rich.console import Console
from scipy import ndimage, stats

from airl_mav.addons.colour.appearance import seen_across, srgb_of
from airl_mav.addons.colour.picture import render_picture
from airl_mav.addons.colour.pictures import ROOM, coloured_segmentation
from airl_mav.arena.draw import OPENING_COLOUR, draw_arena
from airl_mav.arena.generate import generate, local_bounds
from airl_mav.arena.geometry import Arena, Bounds, Obstacles, Shape
from airl_mav.arena.placement import bounding_boxes
from airl_mav.arena.walls import Plan, draw_plan, over_doors
from airl_mav.camera import primitives
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.cli.arena_command import arena_table
from airl_mav.core.errors import UsageError
from airl_mav.envs.arena_batch import CEILING, FLOOR, NOTHING, WALL, batch_of, clearance, touches
from airl_mav.profiles.arena import ArenaSpec
from airl_mav.profiles.loading import load_profile, profile_digest

WIDTH_M = 0.55
SEEDS = range(60)
CELL_M = 0.1


@pytest.fixture(scope="module")
def spec() -> ArenaSpec:
    return load_profile("arenas", "rooms", ArenaSpec)


def made(spec: ArenaSpec, seed: int, width_m: float = WIDTH_M) -> Arena:
    return generate(spec, seed, name="rooms", vehicle_width_m=width_m)


def changed(spec: ArenaSpec, **tables: Any) -> ArenaSpec:
    """Return a profile with some fields of its tables changed."""
    whole = {"gates": {}} | spec.model_dump()
    for table, fields in tables.items():
        whole[table] = (whole[table] | fields) if isinstance(fields, dict) else fields
    return ArenaSpec.model_validate(whole)


def with_corridor(spec: ArenaSpec) -> ArenaSpec:
    return changed(
        spec,
        rooms={"corridor_width_m": 3.5, "count": [4, 8]},
    )


@pytest.fixture(scope="module")
def arenas(spec: ArenaSpec) -> list[Arena]:
    return [made(spec, seed) for seed in SEEDS]


@pytest.fixture(scope="module")
def corridors(spec: ArenaSpec) -> list[Arena]:
    return [made(with_corridor(spec), seed) for seed in SEEDS]


# --- the floor plan, on a raster that shares no code with the generator


def raster(arena: Arena, height_m: float, *, whole: bool = False) -> NDArray[np.bool_]:
    """Return which cells of the floor are free at a height, of walls alone or of all that stands.

    Cell by cell, whether its middle is in a box: rows go north, columns east.
    """
    b, o = arena.bounds, arena.obstacles
    assert arena.building is not None
    north = np.arange(b.north_min + 0.5 * CELL_M, b.north_max, CELL_M)
    east = np.arange(b.east_min + 0.5 * CELL_M, b.east_max, CELL_M)
    free = np.ones((len(north), len(east)), np.bool_)
    first = 0 if whole else arena.n_static - arena.building.boxes
    for i in range(first, arena.n_static):
        if abs(-height_m - o.center[i, 2]) >= o.half_size[i, 2]:
            continue
        dn, de = north[:, None] - o.center[i, 0], east[None, :] - o.center[i, 1]
        c, s = math.cos(o.yaw[i]), math.sin(o.yaw[i])
        if o.shape[i] == Shape.BOX:
            inside = (np.abs(c * dn + s * de) < o.half_size[i, 0]) & (
                np.abs(c * de - s * dn) < o.half_size[i, 1]
            )
        else:
            inside = np.hypot(dn, de) < o.half_size[i, 0]
        free &= ~inside
    return free


def at(arena: Arena, place: Any) -> tuple[int, int]:
    b = arena.bounds
    return int((place[0] - b.north_min) / CELL_M), int((place[1] - b.east_min) / CELL_M)


@pytest.mark.parametrize("kind", ["arenas", "corridors"])
def test_every_room_can_be_reached_through_doors_alone(
    kind: str, request: pytest.FixtureRequest
) -> None:
    for arena in request.getfixturevalue(kind):
        building = arena.building
        # Below the lintels all rooms are one; at their height they are as many as there are.
        _, below = ndimage.label(raster(arena, 1.0))
        closed, count = ndimage.label(raster(arena, arena.bounds.height - 0.01))
        assert below == 1
        assert count == building.rooms
        # In no room is the start, or the goal, in a wall.
        assert closed[at(arena, (0.0, 0.0))] != 0
        assert closed[at(arena, arena.goal)] != 0
        _, doors = ndimage.label(raster(arena, 1.0) & (closed == 0))
        assert doors == building.doors
        least = building.rooms - 1
        assert doors >= least


@pytest.mark.parametrize("kind", ["arenas", "corridors"])
def test_a_vehicle_has_a_way_from_the_start_to_the_goal(
    kind: str, request: pytest.FixtureRequest
) -> None:
    """Past all that stands: an erosion of a fine raster by a distance transform."""
    for arena in request.getfixturevalue(kind)[:25]:
        free = raster(arena, 2.5, whole=True)
        room = CELL_M * ndimage.distance_transform_edt(np.pad(free, 1))[1:-1, 1:-1]
        label, _ = ndimage.label(room > 0.5 * WIDTH_M + CELL_M)
        start, goal = label[at(arena, (0.0, 0.0))], label[at(arena, arena.goal)]
        assert start == goal != 0
        assert np.hypot(*arena.goal) >= 10.0


def test_rooms_are_as_many_and_as_wide_as_asked_for(spec: ArenaSpec, arenas: list[Arena]) -> None:
    counts = np.array([arena.building.rooms for arena in arenas if arena.building])
    assert set(counts.tolist()) == {4, 5, 6, 7}
    expected = np.full(4, len(arenas) / 4)
    assert stats.chisquare(np.bincount(counts)[4:], expected).pvalue > 1e-3
    for arena in arenas:
        closed, count = ndimage.label(raster(arena, arena.bounds.height - 0.01))
        for part in ndimage.find_objects(closed):
            sides = [CELL_M * (each.stop - each.start) for each in part]
            assert min(sides) >= spec.rooms.least_side_m - 2.0 * CELL_M
        # Each is a whole rectangle.
        for number, part in enumerate(ndimage.find_objects(closed), start=1):
            assert (closed[part] == number).all()
        assert count == len(ndimage.find_objects(closed))


def test_every_room_opens_on_the_corridor(corridors: list[Arena]) -> None:
    for arena in corridors:
        closed, _ = ndimage.label(raster(arena, arena.bounds.height - 0.01))
        sides = {
            k: [CELL_M * (each.stop - each.start) for each in part]
            for k, part in enumerate(ndimage.find_objects(closed), start=1)
        }
        length = arena.bounds.north_max - arena.bounds.north_min
        (corridor,) = (
            k for k, (n, e) in sides.items() if n > length - 0.15 and abs(e - 3.5) < 0.21
        )
        open_ = raster(arena, 1.0)
        doors, count = ndimage.label(open_ & (closed == 0))
        touching = set()
        for door in range(1, count + 1):
            beside = set(np.unique(closed[ndimage.binary_dilation(doors == door)])) - {0}
            assert len(beside) == 2
            if corridor in beside:
                touching |= beside
        assert touching == set(sides)


@pytest.mark.parametrize(("share", "corridor"), [(0.0, False), (1.0, False), (1.0, True)])
def test_the_share_of_doors_is_kept(spec: ArenaSpec, share: float, corridor: bool) -> None:
    """No doors beyond a tree, or doors between all neighbours that share enough wall."""
    base = with_corridor(spec) if corridor else spec
    asked = changed(base, rooms={"extra_doors": share}, static={"count": [0, 0]})
    for seed in range(12):
        arena = made(asked, seed)
        assert arena.building is not None
        if share == 0.0:
            assert arena.building.doors == arena.building.rooms - 1
            continue
        closed, count = ndimage.label(raster(arena, arena.bounds.height - 0.01))
        pairs = 0
        for one in range(1, count + 1):
            for other in range(one + 1, count + 1):
                # Grown by a little more than the wall, as far as they see each other across it.
                shared = [
                    int(
                        (
                            _moved(closed == one, axis, by) & (closed == other)
                        ).any(axis=axis).sum()
                    )
                    for axis in (0, 1)
                    for by in (3, -3)
                ]  # fmt: skip
                pairs += CELL_M * max(shared) >= asked.rooms.door_width_m[0] + 0.2
        assert abs(arena.building.doors - pairs) <= 1  # A door may nearly fit, by a cell.


def _moved(cells: NDArray[np.bool_], axis: int, by: int) -> NDArray[np.bool_]:
    moved = np.roll(cells, by, axis)
    edge: list[Any] = [slice(None)] * 2
    edge[axis] = slice(0, by) if by > 0 else slice(by, None)
    moved[tuple(edge)] = False
    return moved


def plan_of(spec: ArenaSpec, seed: int) -> tuple[Plan, Bounds]:
    bounds = local_bounds(spec)
    start = bounding_boxes(
        Obstacles(np.zeros(1, np.int8), np.zeros((1, 3)), np.full((1, 3), 1.5), np.zeros(1))
    )
    rng = np.random.default_rng(seed)
    return draw_plan(rng, spec, bounds, start, "rooms"), bounds


def test_doors_are_within_their_ranges_and_use_them(spec: ArenaSpec) -> None:
    widths, heights = [], []
    for seed in range(200):
        plan, _ = plan_of(spec, seed)
        widths += [door.high - door.low for door in plan.doors]
        heights += [door.height for door in plan.doors]
    for values, (low, high) in ((widths, spec.rooms.door_width_m), (heights, (3.2, 3.8))):
        assert low - 1e-9 <= min(values) < low + 0.05 * (high - low)
        assert high - 0.05 * (high - low) < max(values) <= high + 1e-9
    assert stats.kstest(heights, stats.uniform(3.2, 0.6).cdf).pvalue > 1e-3


@pytest.mark.parametrize("seed", range(6))
def test_walls_fill_what_is_no_room_and_no_door(
    spec: ArenaSpec, arenas: list[Arena], seed: int
) -> None:
    """The boxes have the volume of the walls minus the doors: no part is counted twice."""
    plan, bounds = plan_of(spec, seed)
    floor = (bounds.north_max - bounds.north_min) * (bounds.east_max - bounds.east_min)
    rooms = sum(room.side(0) * room.side(1) for room in plan.rooms)
    doors = sum(door.height * (door.high - door.low) for door in plan.doors)
    from airl_mav.arena.walls import room_walls

    boxes, things = room_walls(plan, bounds)
    volume = np.prod(2.0 * boxes.half_size, axis=1).sum()
    assert volume == pytest.approx((floor - rooms) * bounds.height - 0.2 * doors)
    assert (np.diff(things.of) >= 0).all()
    names = {arenas[seed].name_of(i).rsplit("-", 1)[0] for i in range(arenas[seed].n_static)}
    assert "static-room-wall" in names


def test_a_door_as_high_as_the_walls_has_no_lintel(spec: ArenaSpec) -> None:
    high = changed(spec, rooms={"door_height_m": [4.0, 4.0]})
    for seed in range(5):
        arena = made(high, seed)
        assert not over_doors(arena).any()
        assert ndimage.label(raster(arena, 3.99))[1] == 1


def test_obstacles_stand_clear_of_doors_and_walls(spec: ArenaSpec) -> None:
    crowd = changed(
        spec,
        moving={"count": [1, 2], "half_width_m": [0.2, 0.4], "height_m": [1.0, 2.0],
                "shapes": ["box", "cylinder"]},
    )  # fmt: skip
    for seed in range(15):
        arena = made(crowd, seed)
        assert arena.building is not None
        boxes, n = bounding_boxes(arena.obstacles), arena.n_static
        first = n - arena.building.boxes
        plan = draw_plan_again(crowd, seed)
        doors = plan.passages()
        across = [plan.walls[door.wall][0] for door in plan.doors]
        for i in range(first):
            apart = np.abs(boxes.center[i] - boxes.center[first:n])
            gap = (apart - boxes.half[i] - boxes.half[first:n]).max(axis=1)
            assert gap.min() >= crowd.min_clearance_m - 1e-9
            apart = np.abs(boxes.center[i] - doors.center) - boxes.half[i] - doors.half
            for k, axis in enumerate(across):
                assert apart[k, axis] >= 1.5 - 1e-9 or apart[k, 1 - axis] >= -1e-9
        closed, _ = ndimage.label(raster(arena, arena.bounds.height - 0.01))
        for tour in arena.tours:  # In one room for ever.
            assert len({int(closed[at(arena, point)]) for point in tour.points}) == 1


def draw_plan_again(spec: ArenaSpec, seed: int) -> Plan:
    from airl_mav.arena import generate as module

    plan = module._draw_rooms(spec, seed, local_bounds(spec), "rooms", WIDTH_M)
    assert plan is not None
    return plan


def test_the_same_seed_is_the_same_building_and_others_differ(spec: ArenaSpec) -> None:
    one, again, other = made(spec, 3), made(spec, 3), made(spec, 4)
    np.testing.assert_array_equal(one.obstacles.center, again.obstacles.center)
    np.testing.assert_array_equal(one.goal, again.goal)
    assert not np.array_equal(one.goal, other.goal)
    fewer = made(changed(spec, static={"count": [0, 0]}), 3)
    assert one.building is not None
    n = one.building.boxes
    np.testing.assert_array_equal(one.obstacles.center[-n:], fewer.obstacles.center[-n:])


def test_a_fixed_goal_is_in_no_wall(spec: ArenaSpec) -> None:
    fixed = changed(spec, goal={"north_m": 12.0, "east_m": 0.0})
    for seed in range(20):
        arena = made(fixed, seed)
        room = raster(arena, 1.0)
        row, column = at(arena, (12.0, 0.0))
        assert room[row - 13 : row + 13, column - 13 : column + 13].all()


# --- the ceiling in the vectorized simulator


def hit(arena: Arena, place: tuple[float, float, float]) -> tuple[int, float]:
    batch = batch_of([arena])
    radius, half_height = 0.275, 0.055
    found = touches(
        *(place, radius, half_height, batch.bounds[0], len(arena.obstacles)),
        *(batch.shape[0], batch.center[0], batch.half_size[0], batch.yaw[0]),
    )
    room = clearance(
        *(place, radius, half_height, batch.bounds[0], len(arena.obstacles)),
        *(batch.center[0], batch.half_size[0]),
    )
    return found, room


def test_the_twin_touches_floor_walls_doors_and_ceiling_as_closed_forms_say(
    arenas: list[Arena],
) -> None:
    """A level disc among upright boxes that are not turned."""
    radius, half_height, kinds = 0.275, 0.055, set()
    rng = np.random.default_rng(2)
    for arena in arenas[:8]:
        b, o, n = arena.bounds, arena.obstacles, arena.n_static
        assert arena.building is not None
        first = n - arena.building.boxes
        bare = replace(
            arena,
            obstacles=Obstacles(*(each[first:] for each in vars(o).values())),
            statics=None,
        )  # fmt: skip
        boxes = bare.obstacles
        for _ in range(400):
            place = rng.uniform(
                [b.north_min, b.east_min, -b.height], [b.north_max, b.east_max, 0.0]
            )
            if rng.random() < 0.5:  # At a wall or a lintel.
                i = rng.integers(len(boxes))
                place = boxes.center[i] + rng.uniform(-1.2, 1.2, 3) * (boxes.half_size[i] + 0.2)
                place[2] = np.clip(place[2], -b.height, 0.0)
            found, room = hit(bare, (float(place[0]), float(place[1]), float(place[2])))
            gap = np.maximum(np.abs(place - boxes.center) - boxes.half_size, 0.0)
            at_boxes = (np.hypot(gap[:, 0], gap[:, 1]) < radius) & (gap[:, 2] <= half_height)
            gap_z = np.abs(place[2] - boxes.center[:, 2]) - half_height - boxes.half_size[:, 2]
            at_boxes = (np.hypot(gap[:, 0], gap[:, 1]) < radius) & (gap_z <= 0.0)
            at_walls = bool(
                min(place[0] - b.north_min, b.north_max - place[0]) < radius
                or min(place[1] - b.east_min, b.east_max - place[1]) < radius
            )
            at_floor, at_ceiling = place[2] + half_height > 0.0, place[2] - half_height < -b.height
            anything = bool(at_boxes.any() or at_walls or at_floor or at_ceiling)
            assert (found == NOTHING) is not anything
            if found == CEILING:
                assert at_ceiling
            elif found == FLOOR:
                assert at_floor
            elif found == WALL:
                assert at_walls
            elif found != NOTHING:
                assert at_boxes[found]
            if found != NOTHING:
                assert room <= 1e-12
            else:
                assert room <= b.height + place[2] - half_height + 1e-12
            kinds.add(min(found, 0))
    assert kinds == {CEILING, FLOOR, WALL, NOTHING, 0}


def test_without_a_ceiling_one_flies_over_walls(spec: ArenaSpec) -> None:
    open_ = changed(spec, size={"ceiling": False}, static={"count": [0, 0]})
    arena, covered = made(open_, 2), made(changed(spec, static={"count": [0, 0]}), 2)
    assert arena.building is not None
    wall = arena.obstacles.center[-1]
    over = (float(wall[0]), float(wall[1]), -4.5)
    assert hit(arena, over)[0] == NOTHING
    assert hit(covered, over)[0] == CEILING
    np.testing.assert_array_equal(arena.obstacles.center, covered.obstacles.center)


def test_over_a_gate_there_is_a_ceiling(spec: ArenaSpec) -> None:
    gates = load_profile("arenas", "gates", ArenaSpec)
    for ceiling, wanted in ((False, NOTHING), (True, CEILING)):
        arena = made(changed(gates, size={"ceiling": ceiling}), 1)
        wall = arena.obstacles.center[arena.n_static - 4]
        assert hit(arena, (float(wall[0]), float(wall[1]), -6.2))[0] == wanted


# --- arenas without rooms are unchanged


def digest(name: str) -> str:
    """Return a digest of a shipped arena's profile and its draws for twenty seeds."""
    spec, told = load_profile("arenas", name, ArenaSpec), hashlib.sha256()
    told.update(profile_digest(spec).encode())
    for seed in range(20):
        arena = made(spec, seed)
        b, o = arena.bounds, arena.obstacles
        told.update(
            np.array([b.north_min, b.north_max, b.east_min, b.east_max, b.height]).tobytes()
        )
        for array in (o.shape, o.center, o.half_size, o.yaw, arena.goal):
            told.update(np.ascontiguousarray(array).tobytes())
        for tour in arena.tours:
            told.update(tour.points.tobytes())
        look, f = arena.look, arena.look.finish
        assert not f.images
        drawn = (f.texture, f.albedo, f.size_m, f.offset)
        for array in (*drawn, look.light.sun, look.light.zenith):
            told.update(np.ascontiguousarray(array).tobytes())
    return told.hexdigest()[:16]


BEFORE = {
    "crowded": "82432176489be527",
    "dense-obstacles": "8a438123b43a4867",
    "dynamic-obstacles": "69ef4891829faffd",
    "gates": "fc90bc9b602825ea",
    "no-obstacles": "b3bd1c1e80ca09d1",
    "open-field": "816a1fd462d4410a",
    "park": "0455810b97515a5a",
    "static-obstacles": "fb0b627b2f6b3f57",
    "varied-looks": "ab7d97e5851cfe13",
}
"""Digests from the version before rooms were added."""


@pytest.mark.parametrize("name", BEFORE)
def test_arenas_without_rooms_are_what_they_were(name: str) -> None:
    assert digest(name) == BEFORE[name]


def test_profiles_without_them_say_nothing_of_them() -> None:
    dumped = load_profile("arenas", "static-obstacles", ArenaSpec).model_dump()
    assert "rooms" not in dumped
    assert "ceiling" not in dumped["size"]


# --- views and pictures


def test_what_a_view_is_told_is_the_arena(arenas: list[Arena]) -> None:
    shown = TypeAdapter(Arena).validate_json(TypeAdapter(Arena).dump_json(arenas[1]))
    assert shown.building == arenas[1].building
    assert shown.bounds == arenas[1].bounds
    np.testing.assert_array_equal(over_doors(shown), over_doors(arenas[1]))
    np.testing.assert_array_equal(shown.look.light.zenith, arenas[1].look.light.zenith)


def test_pictures_show_doors(arenas: list[Arena]) -> None:
    arena = arenas[1]
    assert arena.building is not None
    ax = Figure().add_subplot()
    draw_arena(arena, ax)
    drawn = [patch for patch in ax.patches if patch.get_facecolor() == to_rgba(OPENING_COLOUR)]
    assert len(drawn) == arena.building.doors
    assert ax.get_legend_handles_labels()[1].count("door") == 1


def test_the_table_tells_of_them(spec: ArenaSpec, arenas: list[Arena]) -> None:
    arena, console = arenas[0], Console(width=120, file=io.StringIO())
    console.print(arena_table(arena, spec))
    assert isinstance(console.file, io.StringIO)
    told = console.file.getvalue()
    assert arena.building is not None
    assert f"{arena.building.rooms}, {arena.building.doors} doors" in told
    assert "4 m high" in told


def test_a_camera_sees_the_ceiling_where_it_is(arenas: list[Arena]) -> None:
    """Height and colour of the ceiling, and its grey in a segmentation picture."""
    camera = Intrinsics.from_fov(48, 32, 1.6)
    arena, place = arenas[2], np.array([0.0, 0.0, -2.5])
    seen = render_picture(arena, arena.centers_at(0), camera, place, np.array([1.0, 0, 0, 0]))
    overhead = seen.seen == primitives.CEILING
    assert overhead.sum() > 200
    assert (seen.seen != primitives.SKY).all()
    v = np.mgrid[:32, :48][0]
    up = (camera.cy - v) / camera.focal * seen.depth_m
    np.testing.assert_allclose(up[overhead], arena.bounds.height - 2.5, atol=1e-3)
    glow = np.rint(255.0 * srgb_of(arena.look.light.zenith))
    assert np.abs(seen.rgb[overhead].astype(float) - glow).max() <= 1.0
    coloured = coloured_segmentation(seen.seen)
    for number, colour in ROOM.items():
        assert (coloured[seen.seen == number] == colour).all()
    assert arena.look.light.sun.sum() == 0.0


def test_the_ceilings_view_factor_is_that_of_rays() -> None:
    """Two squares: share of cosine-weighted rays from the first that meet the second."""
    rng = np.random.default_rng(5)
    for x in (0.7, 2.0, 9.0):
        n = 200_000
        begin = rng.uniform(0.0, x, (n, 2))
        sine, turn = np.sqrt(rng.random(n)), rng.uniform(0.0, 2.0 * np.pi, n)
        run = sine / np.sqrt(1.0 - sine**2)
        end = begin + run[:, None] * np.stack([np.cos(turn), np.sin(turn)], 1)
        share = ((end >= 0.0) & (end <= x)).all(axis=1).mean()
        assert seen_across(x) == pytest.approx(share, abs=5.0 * math.sqrt(0.25 / n))


# --- rejected input


@pytest.mark.parametrize(
    ("tables", "message"),
    [
        ({"rooms": {"count": [4, 40]}}, "rooms.count = [4, 40]: accepted: value <= 15, as many of"),
        ({"rooms": {"count": [0, 4]}}, "rooms.count = [0, 4]: accepted: 1 <= value, or [0, 0]"),
        ({"rooms": {"door_height_m": [2.6, 3.5]}}, "rooms.door_height_m = [2.6, 3.5]: accepted: 3"),
        ({"rooms": {"door_height_m": [3.2, 4.5]}}, "rooms.door_height_m = [3.2, 4.5]: accepted: 3"),
        ({"rooms": {"door_width_m": [2.0, 7.0]}}, "rooms.door_width_m = [2.0, 7.0]: accepted: val"),
        ({"rooms": {"corridor_width_m": 14.0}}, "rooms.count = [4, 7]: accepted: value <= 0"),
        (
            {"rooms": {"corridor_width_m": 3.0, "count": [1, 4]}},
            "rooms.count = [1, 4]: accepted: 2 <= value, one on each side of the corridor",
        ),
        ({"rooms": {"extra_doors": 1.5}}, "extra_doors"),
        ({"rooms": {"thickness_m": 0.0}}, "thickness_m"),
        ({"generator": "mine.py:make"}, "rooms.count = [4, 7]: accepted: [0, 0] with a generator"),
        (
            {
                "gates": {"count": [1, 1], "middle_m": [2.0, 2.0]},
                "goal": {"north_m": 20.0, "east_m": 0.0},
            },
            "rooms.count = [4, 7]: accepted: [0, 0] with gates",
        ),
        (
            {"flight_altitude_m": 3.6, "rooms": {"count": [0, 0]}},
            "size.height_m = 4: accepted: value >= 4.1 m below a ceiling",
        ),
    ],
)
def test_rooms_that_cannot_be_are_refused(
    spec: ArenaSpec, tables: dict[str, Any], message: str
) -> None:
    with pytest.raises((ValidationError, UsageError)) as refused:
        changed(spec, **tables)
    assert message in str(refused.value)


def test_doors_that_the_vehicle_does_not_find_its_way_through_are_refused(spec: ArenaSpec) -> None:
    with pytest.raises(
        UsageError, match=r"rooms.door_width_m = \[2.0, 3.0\]: accepted: value >= 2"
    ):
        made(spec, 0, width_m=1.9)


def test_a_start_that_is_always_in_a_wall_is_refused(spec: ArenaSpec) -> None:
    crowded = changed(
        spec,
        size={"north_m": 14.4, "east_m": 14.4},
        start={"north_m": 7.2, "east_m": 7.2},
        rooms={"count": [4, 4]},
        goal={"min_distance_m": 1.0},
    )
    with pytest.raises(UsageError, match=r"in 500 draws of 4 rooms a wall was always within start"):
        made(crowded, 0)
