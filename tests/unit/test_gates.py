"""Gates and goals with a height against their ranges and closed forms."""

from __future__ import annotations

import io
import math
from typing import Any

import numpy as np
import pytest
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from pydantic import TypeAdapter, ValidationError
from rich.console import Console
from scipy import ndimage, stats

from airl_mav.arena.draw import OPENING_COLOUR, draw_arena
from airl_mav.arena.generate import free_area_fraction, generate
from airl_mav.arena.geometry import Arena
from airl_mav.arena.placement import bounding_boxes
from airl_mav.arena.walls import openings_of, over_openings
from airl_mav.cli.arena_command import arena_table
from airl_mav.core.errors import FieldError, UsageError
from airl_mav.core.frames import goal_distance_m
from airl_mav.envs.arena_batch import NOTHING, batch_of, touches
from airl_mav.policy.registry import find_policy
from airl_mav.profiles.arena import ArenaSpec
from airl_mav.profiles.loading import load_profile
from airl_mav.scenario.checks import check_goal_height
from airl_mav.scenario.model import Scenario
from airl_mav.scenario.resolve import resolve

WIDTH_M = 0.55
SEEDS = range(300)


@pytest.fixture(scope="module")
def spec() -> ArenaSpec:
    return load_profile("arenas", "gates", ArenaSpec)


def made(spec: ArenaSpec, seed: int, width_m: float = WIDTH_M) -> Arena:
    return generate(spec, seed, name="gates", vehicle_width_m=width_m)


def changed(spec: ArenaSpec, **tables: Any) -> ArenaSpec:
    """Return a profile with some fields of its tables changed."""
    whole = spec.model_dump()
    for table, fields in tables.items():
        whole[table] = (whole[table] | fields) if isinstance(fields, dict) else fields
    return ArenaSpec.model_validate(whole)


@pytest.fixture(scope="module")
def arenas(spec: ArenaSpec) -> list[Arena]:
    return [made(spec, seed) for seed in SEEDS]


# --- random draws


def test_openings_are_uniform_within_the_profiles_ranges(
    spec: ArenaSpec, arenas: list[Arena]
) -> None:
    gates = spec.gates
    found = [openings_of(arena) for arena in arenas]
    counts = [len(each) for each in found]
    assert set(counts) == {1, 2, 3}
    assert [arena.n_gates for arena in arenas] == counts
    center = np.concatenate([each.center for each in found])
    half = np.concatenate([each.half_size for each in found])
    drawn = {
        "first_m": np.array([each.center[0, 0] for each in found]),
        "spacing_m": np.concatenate([np.diff(each.center[:, 0]) for each in found]),
        "lateral_m": center[:, 1],
        "middle_m": -center[:, 2],
        "width_m": 2.0 * half[:, 1],
        "height_m": 2.0 * half[:, 2],
    }
    for name, values in drawn.items():
        low, high = getattr(gates, name)
        assert values.min() >= low - 1e-9, name
        assert values.max() <= high + 1e-9, name
        uniform = stats.uniform(low, high - low)
        assert stats.kstest(values, uniform.cdf).pvalue > 1e-3, name
    np.testing.assert_allclose(half[:, 0], 0.5 * gates.thickness_m)


def test_the_goal_is_behind_the_last_gate_at_a_height_of_its_range(
    spec: ArenaSpec, arenas: list[Arena]
) -> None:
    assert spec.goal.height_m is not None
    low, high = spec.goal.height_m
    heights = np.array([arena.goal_height_m for arena in arenas], np.float64)
    assert stats.kstest(heights, stats.uniform(low, high - low).cdf).pvalue > 1e-3
    for arena in arenas:
        openings = openings_of(arena)
        last = openings.center[-1, 0] + openings.half_size[-1, 0]
        assert arena.goal[0] >= last + spec.goal.clearance_m - 1e-9
        assert arena.goal_height_m is not None
        assert arena.goal_point == (*arena.goal.tolist(), -arena.goal_height_m)


def test_the_same_seed_is_the_same_arena_and_others_differ(spec: ArenaSpec) -> None:
    one, again, other = made(spec, 7), made(spec, 7), made(spec, 8)
    np.testing.assert_array_equal(one.obstacles.center, again.obstacles.center)
    assert one.goal_point == again.goal_point
    assert one.goal_point != other.goal_point


def test_a_height_changes_nothing_else_of_an_arena() -> None:
    plain = load_profile("arenas", "dynamic-obstacles", ArenaSpec)
    high = changed(plain, goal={"height_m": [1.0, 4.0]})
    for seed in range(20):
        without, with_height = made(plain, seed), made(high, seed)
        np.testing.assert_array_equal(without.goal, with_height.goal)
        np.testing.assert_array_equal(without.obstacles.center, with_height.obstacles.center)
        np.testing.assert_array_equal(without.tours[0].points, with_height.tours[0].points)
        assert without.goal_height_m is None
        assert len(without.goal_point) == 2
        assert 1.0 <= (with_height.goal_height_m or 0.0) <= 4.0


def test_one_number_is_always_that_height() -> None:
    plain = load_profile("arenas", "no-obstacles", ArenaSpec)
    fixed = changed(plain, goal={"height_m": 3.5})
    assert {made(fixed, seed).goal_height_m for seed in range(5)} == {3.5}


def test_profiles_without_them_say_nothing_of_them() -> None:
    """The digest covers the dumped profile, so the dump must not change."""
    dumped = load_profile("arenas", "static-obstacles", ArenaSpec).model_dump()
    assert "gates" not in dumped
    assert "height_m" not in dumped["goal"]


# --- obstacles


def inside(arena: Arena, place: np.ndarray) -> bool:
    """Return True if a place is in any box of an arena; the boxes are not rotated."""
    boxes = arena.obstacles
    return bool((np.abs(place - boxes.center) < boxes.half_size).all(axis=1).any())


@pytest.mark.parametrize("seed", range(8))
def test_the_wall_is_closed_but_for_the_opening(arenas: list[Arena], seed: int) -> None:
    arena, rng = arenas[seed], np.random.default_rng(seed)
    b, openings = arena.bounds, openings_of(arena)
    for center, half in zip(openings.center, openings.half_size, strict=True):
        for _ in range(300):
            east, down = rng.uniform(b.east_min, b.east_max), -rng.uniform(0.0, b.height)
            free = bool(abs(east - center[1]) < half[1] and abs(down - center[2]) < half[2])
            assert inside(arena, np.array([center[0], east, down])) is not free
    # No box is counted twice: together they have the volume of the walls without the openings.
    wall = (b.east_max - b.east_min) * b.height
    holes = 4.0 * openings.half_size[:, 1] * openings.half_size[:, 2]
    wanted = (2.0 * openings.half_size[:, 0] * (wall - holes)).sum()
    assert np.prod(2.0 * arena.obstacles.half_size, axis=1).sum() == pytest.approx(wanted)


@pytest.mark.parametrize("seed", range(8))
def test_the_twin_touches_the_frame_as_the_closed_form_says(arenas: list[Arena], seed: int) -> None:
    """A level disc in the plane of the wall, whose rim and faces the opening leaves room."""
    arena, rng = arenas[seed], np.random.default_rng(seed)
    batch, radius, half_height = batch_of([arena]), 0.275, 0.055
    openings = openings_of(arena)
    hits = 0
    for center, half in zip(openings.center, openings.half_size, strict=True):
        for _ in range(200):
            off = rng.uniform(-1.3, 1.3, 2) * half[1:]
            place = (float(center[0]), float(center[1] + off[0]), float(center[2] + off[1]))
            hit = touches(
                *(place, radius, half_height, batch.bounds[0], len(arena.obstacles)),
                *(batch.shape[0], batch.center[0], batch.half_size[0], batch.yaw[0]),
            )
            beside, above = half[1] - radius, half[2] - half_height
            free = bool(abs(off[0]) <= beside and abs(off[1]) <= above)
            assert (hit == NOTHING) is free
            if not free:
                assert arena.name_of(hit) == f"static-gate-{hit}"
                hits += 1
    assert hits


def test_there_is_a_way_for_the_vehicle_by_a_distance_transform(arenas: list[Arena]) -> None:
    """From above, with openings open: an erosion of a fine raster, which shares no code."""
    cell = 0.05
    for arena in arenas[:30]:
        b, boxes = arena.bounds, arena.obstacles
        north = np.arange(b.north_min, b.north_max, cell) + 0.5 * cell
        east = np.arange(b.east_min, b.east_max, cell) + 0.5 * cell
        free = np.ones((len(north), len(east)), np.bool_)
        open_way = over_openings(arena)
        for i in np.flatnonzero(~open_way):
            center, half = boxes.center[i], boxes.half_size[i]
            free &= ~(
                (np.abs(north - center[0]) < half[0])[:, None]
                & (np.abs(east - center[1]) < half[1])[None, :]
            )
        room = cell * ndimage.distance_transform_edt(np.pad(free, 1))[1:-1, 1:-1]
        label, _ = ndimage.label(room > 0.5 * WIDTH_M + cell)

        def at(place: Any, label: np.ndarray = label, b: Any = b) -> int:
            row, column = (place[0] - b.north_min) / cell, (place[1] - b.east_min) / cell
            return int(label[int(row), int(column)])

        assert at((0.0, 0.0)) == at(arena.goal) != 0


def test_what_a_view_is_told_is_the_arena(arenas: list[Arena]) -> None:
    shown = TypeAdapter(Arena).validate_json(TypeAdapter(Arena).dump_json(arenas[1]))
    assert shown.goal_point == arenas[1].goal_point
    np.testing.assert_array_equal(openings_of(shown).center, openings_of(arenas[1]).center)


def test_pictures_show_openings_and_the_floor_counts_once(arenas: list[Arena]) -> None:
    arena = arenas[1]
    ax = Figure().add_subplot()
    draw_arena(arena, ax)
    drawn = [patch for patch in ax.patches if patch.get_facecolor() == to_rgba(OPENING_COLOUR)]
    assert len(drawn) == 2 * arena.n_gates
    labels = ax.get_legend_handles_labels()[1]
    assert labels.count("opening of a gate") == 1
    b = arena.bounds
    share = arena.n_gates * 0.2 / (b.north_max - b.north_min)
    assert 1.0 - free_area_fraction(arena) == pytest.approx(share, rel=0.5)


def test_the_table_tells_of_them(spec: ArenaSpec, arenas: list[Arena]) -> None:
    arena, console = arenas[0], Console(width=120, file=io.StringIO())
    console.print(arena_table(arena, spec))
    assert isinstance(console.file, io.StringIO)
    told = console.file.getvalue()
    (place,), (half,) = openings_of(arena).center[:1], openings_of(arena).half_size[:1]
    assert f"{place[0]:.2f} N {place[1]:.2f} E, {-place[2]:.2f} m high" in told
    assert f"{2 * half[1]:.2f} x {2 * half[2]:.2f} m" in told
    assert f"{arena.goal_height_m:.2f} m" in told


def test_obstacles_keep_off_the_gates(spec: ArenaSpec) -> None:
    crowd = changed(spec, static={"count": [4, 6], "half_width_m": [0.3, 0.6]}, min_clearance_m=1.5)
    for seed in range(30):
        arena = made(crowd, seed)
        gate = np.arange(arena.n_static) >= arena.n_static - 4 * arena.n_gates
        boxes = bounding_boxes(arena.obstacles)
        assert 4 <= (~gate).sum() <= 6
        assert len(openings_of(arena)) == arena.n_gates
        for i in np.flatnonzero(~gate):
            gap = np.abs(boxes.center[gate, 0] - boxes.center[i, 0])
            gap -= boxes.half[gate, 0] + boxes.half[i, 0]
            assert gap.min() >= 1.5 - 1e-9
            assert "gate" not in arena.name_of(int(i))


# --- rejected input


@pytest.mark.parametrize(
    ("tables", "message"),
    [
        ({"goal": {"height_m": [2.0, 7.0]}}, "goal.height_m = [2.0, 7.0]: accepted: value <= 6 m"),
        ({"gates": {"lateral_m": [-9.0, 0.0]}}, "gates.lateral_m = [-9.0, 0.0]: accepted: -8.1"),
        ({"gates": {"middle_m": [1.0, 2.0]}}, "gates.middle_m = [1.0, 2.0]: accepted: 1.4"),
        ({"gates": {"first_m": [2.0, 8.0]}}, "gates.first_m = [2.0, 8.0]: accepted: value >= 3.1"),
        ({"gates": {"count": [1, 5]}}, "gates.count = [1, 5]: the last may be"),
        ({"goal": {"north_m": 20.0, "east_m": 0.0}}, "goal.north_m = 20: accepted: value >= 32.1"),
        ({"gates": {"spacing_m": [1.0, 3.0], "thickness_m": 1.5}}, "gates.spacing_m = [1.0, 3.0]"),
        ({"generator": "mine.py:make"}, "gates.count = [1, 3]: accepted: 0 with a generator"),
    ],
)
def test_gates_that_cannot_be_are_refused(
    spec: ArenaSpec, tables: dict[str, Any], message: str
) -> None:
    with pytest.raises((ValidationError, UsageError)) as refused:
        changed(spec, **tables)
    assert message in str(refused.value)


def test_an_opening_that_the_vehicle_does_not_fit_through_is_refused(spec: ArenaSpec) -> None:
    with pytest.raises(UsageError, match=r"an opening of a gate is .* more than the vehicle's 3 m"):
        made(spec, 0, width_m=3.0)


def test_a_policy_that_is_told_the_height_flies_only_where_there_is_one() -> None:
    with pytest.raises(FieldError, match="a goal with a height, which policy gates is told") as no:
        resolve(Scenario(policy="gates", arena="static-obstacles", level="gym"))
    assert no.value.field == "arena"
    goal = resolve(Scenario(policy="gates", arena="gates", level="gym")).arena_of(1).goal_point
    assert len(goal) == 3
    check_goal_height(find_policy("gates"), goal, "goal", "20 5 -4")
    with pytest.raises(FieldError, match=r"goal.*20 5"):
        check_goal_height(find_policy("gates"), (20.0, 5.0), "goal", "20 5")


# --- distance to the goal


def test_distances_to_a_goal() -> None:
    assert goal_distance_m((3.0, 4.0), (0.0, 0.0, -50.0)) == 5.0
    assert goal_distance_m((3.0, 4.0, -2.0), (0.0, 0.0, -14.0)) == pytest.approx(13.0)
    assert goal_distance_m((0.0, 0.0, -2.0), (0.0, 0.0, -2.0)) == 0.0
    assert math.isclose(goal_distance_m((1.0, 0.0, 0.0), (0.0, 0.0, 1.0)), math.sqrt(2.0))


@pytest.mark.parametrize("name", ["static-obstacles", "gates", "park"])
def test_an_arena_is_the_same_after_any_dump(name: str) -> None:
    spec = load_profile("arenas", name, ArenaSpec)
    for data in (
        spec.model_dump(mode="json", exclude_none=True),
        spec.model_dump(mode="json", exclude_defaults=True),
        spec.model_dump(mode="json", exclude_unset=True),
    ):
        assert ArenaSpec.model_validate(data) == spec
