"""The environment generator against its promises, over many seeds and specifications."""

from __future__ import annotations

import hashlib
import math
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.image import imread
from scipy import ndimage, stats

from airl_mav.arena.draw import draw_arena, save_png
from airl_mav.arena.generate import LAYOUTS, free_area_fraction, generate, local_bounds
from airl_mav.arena.geometry import Arena, Bounds, Obstacles, Shape
from airl_mav.arena.placement import (
    BATCH,
    BATCHES,
    Boxes,
    NoRoomError,
    gaps_suffice,
    passage_exists,
    place_all,
    raster_passage,
    zone_of,
    zone_radius_m,
)
from airl_mav.arena.tours import set_out_later
from airl_mav.core.errors import UsageError
from airl_mav.profiles.arena import ArenaSpec
from airl_mav.profiles.loading import load_profile
from tests.support.command_line import airl

WIDTH_M = 0.55
SHIPPED = ("no-obstacles", "static-obstacles", "dynamic-obstacles")
EPS = 1e-9

seeds = st.integers(0, 2**32 - 1)
relaxed = settings(
    deadline=None, max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


def shipped(name: str) -> ArenaSpec:
    return load_profile("arenas", name, ArenaSpec)


def make(spec: ArenaSpec, seed: int, zone: int | None = None, width: float = WIDTH_M) -> Arena:
    return generate(spec, seed, name="test", vehicle_width_m=width, zone=zone)


def spec_of(**knobs: object) -> ArenaSpec:
    return ArenaSpec.model_validate({"description": "test", **knobs})


@st.composite
def specs(draw: st.DrawFn) -> ArenaSpec:
    """Small to middling arenas, sparse to hopeless."""
    north, east = draw(st.floats(12, 60)), draw(st.floats(12, 60))
    least = draw(st.floats(0.1, 1.0))
    most = least + draw(st.floats(0, 0.4))
    static, moving = draw(st.integers(0, 25)), draw(st.integers(0, 4))
    return spec_of(
        size={"north_m": north, "east_m": east, "height_m": 5},
        start={"north_m": draw(st.floats(2, north - 2)), "east_m": 6, "clearance_m": 2},
        goal={"min_distance_m": 2, "clearance_m": draw(st.floats(0.5, 2))},
        zones_m=[6, 12, 30],
        min_clearance_m=draw(st.floats(0, 2)),
        static={"count": [static, static + 3], "half_width_m": [least, most]},
        moving={"count": [moving, moving], "dwell_s": draw(st.sampled_from([0.0, 0.2]))},
    )


def corners(arena: Arena, i: int) -> np.ndarray:
    """Return points (k, 2) north, east whose bounding box is the footprint's, relative to it."""
    along, across, _ = arena.obstacles.half_size[i]
    if arena.obstacles.shape[i] != Shape.BOX:
        return np.array([[along, 0], [-along, 0], [0, along], [0, -along]])
    yaw = arena.obstacles.yaw[i]
    turn = np.array([[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]])
    local = np.array([[a * along, b * across] for a in (-1, 1) for b in (-1, 1)])
    return local @ turn.T


def rectangle(arena: Arena, i: int, center: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the south-west and north-east corners of a bounding box."""
    points = corners(arena, i) + center[:2]
    return points.min(axis=0), points.max(axis=0)


def gap(a: tuple[np.ndarray, np.ndarray], b: tuple[np.ndarray, np.ndarray]) -> float:
    """Return by how much one rectangle can grow on every side before they overlap."""
    return float(np.maximum(a[0] - b[1], b[0] - a[1]).max())


def point(*at: float) -> tuple[np.ndarray, np.ndarray]:
    return np.array(at), np.array(at)


def occupied(obstacles: Obstacles, north: np.ndarray, east: np.ndarray) -> np.ndarray:
    """Return which raster points are inside a footprint."""
    taken = np.zeros(np.broadcast(north, east).shape, bool)
    for shape, center, half, yaw in zip(
        obstacles.shape, obstacles.center, obstacles.half_size, obstacles.yaw, strict=True
    ):
        offset = (north - center[0]) + 1j * (east - center[1])
        if shape == Shape.BOX:
            local = offset * np.exp(-1j * yaw)
            taken |= (np.abs(local.real) <= half[0]) & (np.abs(local.imag) <= half[1])
        else:
            taken |= np.abs(offset) <= half[0]
    return taken


def way_exists(arena: Arena, width: float, cell: float = 0.1) -> bool:
    """Judge start and goal connected by a distance transform of the occupied raster."""
    b = arena.bounds
    rows = np.arange(b.north_min - cell, b.north_max + 2 * cell, cell)
    columns = np.arange(b.east_min - cell, b.east_max + 2 * cell, cell)
    north, east = np.meshgrid(rows, columns, indexing="ij")
    n = arena.n_static
    o = arena.obstacles
    taken = occupied(Obstacles(o.shape[:n], o.center[:n], o.half_size[:n], o.yaw[:n]), north, east)
    taken |= (north <= b.north_min) | (north >= b.north_max)
    taken |= (east <= b.east_min) | (east >= b.east_max)
    free = ndimage.distance_transform_edt(~taken) * cell > width / 2
    label, _ = ndimage.label(free, structure=np.ones((3, 3)))
    ends = [
        label[np.abs(rows - p[0]).argmin(), np.abs(columns - p[1]).argmin()]
        for p in ((0.0, 0.0), arena.goal)
    ]
    return ends[0] != 0 and ends[0] == ends[1]


def check_layout(arena: Arena, spec: ArenaSpec) -> None:
    """Everything promised of time 0."""
    b, o = arena.bounds, arena.obstacles
    boxes = [rectangle(arena, i, o.center[i]) for i in range(len(o))]
    for i, (low, high) in enumerate(boxes):
        walls = min(
            low[0] - b.north_min, b.north_max - high[0], low[1] - b.east_min, b.east_max - high[1]
        )
        assert walls >= spec.min_clearance_m - EPS
        assert gap((low, high), point(0, 0)) >= spec.start.clearance_m - EPS
        if i < arena.n_static:
            assert gap((low, high), point(*arena.goal)) >= spec.goal.clearance_m - EPS
        for other in boxes[:i]:
            assert gap((low, high), other) >= spec.min_clearance_m - EPS
        top, bottom = -o.center[i, 2] + o.half_size[i, 2], -o.center[i, 2] - o.half_size[i, 2]
        assert top <= b.height + EPS
        assert bottom >= -EPS
        if o.shape[i] == Shape.SPHERE:
            assert bottom < spec.flight_altitude_m < top
        else:
            assert bottom == pytest.approx(0, abs=EPS)
        kind = spec.static if i < arena.n_static else spec.moving
        assert (o.half_size[i, :2] >= kind.half_width_m[0]).all()
        assert (o.half_size[i, :2] <= kind.half_width_m[1]).all()
        assert Shape(o.shape[i]).name.lower() in kind.shapes
    to_walls = np.concatenate(
        [arena.goal - [b.north_min, b.east_min], [b.north_max, b.east_max] - arena.goal]
    )
    assert to_walls.min() >= spec.goal.clearance_m - EPS


def check_tours(arena: Arena, spec: ArenaSpec) -> None:
    """Everything promised of a moving obstacle, at all times."""
    b, o, kind = arena.bounds, arena.obstacles, spec.moving
    n = arena.n_static
    static = [rectangle(arena, i, o.center[i]) for i in range(n)]
    for i, tour in enumerate(arena.tours, start=n):
        dt = np.diff(tour.times_s)
        length = np.hypot(*np.diff(tour.points, axis=0).T)
        assert tour.times_s[0] == 0
        assert (dt > 0).all()
        np.testing.assert_array_equal(tour.points[0], tour.points[-1])
        np.testing.assert_array_equal(tour.points[0], o.center[i, :2])
        assert tour.times_s[-1] >= kind.tour_min_s - EPS
        moves = length > 0
        speed = length[moves] / dt[moves]
        np.testing.assert_allclose(speed, speed[0], rtol=1e-6)
        assert kind.speed_m_s[0] - EPS <= speed[0] <= kind.speed_m_s[1] + EPS
        assert length.max() <= kind.leg_max_m + EPS
        np.testing.assert_allclose(dt[~moves], kind.dwell_s)
        assert (~moves).sum() == (moves.sum() if kind.dwell_s else 0)
        # Straight legs, so that dense points on each show whatever it would touch.
        share = np.linspace(0, 1, 200)[:, None, None]
        track = (tour.points[:-1] + share * np.diff(tour.points, axis=0)).reshape(-1, 2)
        own = corners(arena, i)
        low, high = track + own.min(axis=0), track + own.max(axis=0)
        keep = kind.clearance_m - 1e-6
        assert (low - [b.north_min, b.east_min]).min() >= keep
        assert ([b.north_max, b.east_max] - high).min() >= keep
        for box_low, box_high in static:
            assert np.maximum(low - box_high, box_low - high).max(axis=1).min() >= keep
        nearest = np.hypot(*np.maximum(np.maximum(low, -high), 0).T)
        assert nearest.min() >= spec.start.clearance_m - 1e-6


@pytest.mark.parametrize("name", SHIPPED)
@relaxed
@given(seed=seeds, zone=st.sampled_from([None, 0, 1, 2]))
def test_shipped_arenas_keep_every_promise(name: str, seed: int, zone: int | None) -> None:
    spec = shipped(name)
    arena = make(spec, seed, zone)
    check_layout(arena, spec)
    check_tours(arena, spec)
    distance = np.hypot(*arena.goal)
    assert spec.goal.min_distance_m <= distance <= zone_radius_m(spec, zone)
    assert spec.static.count[0] <= arena.n_static <= spec.static.count[1]
    assert spec.moving.count[0] <= len(arena.tours) <= spec.moving.count[1]


@relaxed
@given(spec=specs(), seed=st.integers(0, 1000))
def test_any_spec_is_met_or_refused_in_one_line(spec: ArenaSpec, seed: int) -> None:
    try:
        arena = make(spec, seed)
    except UsageError as error:
        assert "\n" not in str(error)
        return
    check_layout(arena, spec)
    check_tours(arena, spec)
    # Two cells of slack: the judge's raster may be off by that.
    assert way_exists(arena, WIDTH_M - 0.2)


@pytest.mark.parametrize("name", SHIPPED)
def test_a_way_to_the_goal_exists(name: str) -> None:
    for seed in range(25):
        assert way_exists(make(shipped(name), seed), WIDTH_M)


def digest(arena: Arena) -> str:
    arrays = [
        *(getattr(arena.obstacles, f) for f in ("shape", "center", "half_size", "yaw")),
        *(a for tour in arena.tours for a in (tour.times_s, tour.points)),
        arena.bounds.as_array(),
        arena.goal,
    ]
    return hashlib.sha256(b"".join(np.ascontiguousarray(a).tobytes() for a in arrays)).hexdigest()


@pytest.mark.nightly
def test_same_seed_same_arena_in_another_process() -> None:
    spec = shipped("dynamic-obstacles")
    mine = [digest(make(spec, seed)) for seed in range(4)]
    assert len(set(mine)) == 4
    assert mine == [digest(make(spec, seed)) for seed in range(4)]
    code = (
        "from tests.unit.test_arena import digest, make, shipped;"
        "print([digest(make(shipped('dynamic-obstacles'), seed)) for seed in range(4)])"
    )
    root = Path(__file__).resolve().parents[2]
    theirs = subprocess.run(
        [sys.executable, "-c", code],
        cwd=root,
        env={**os.environ, "PYTHONHASHSEED": "7", "PYTHONPATH": str(root)},
        capture_output=True,
        text=True,
        check=True,
    ).stdout.strip()
    assert theirs == str(mine)


def test_counts_are_shared_within_a_period_and_cover_their_range() -> None:
    spec = shipped("static-obstacles")
    counts = [make(spec, seed).n_static for seed in range(240)]
    groups = [set(counts[k : k + 4]) for k in range(0, 240, 4)]
    assert all(len(group) == 1 for group in groups)
    drawn = [group.pop() for group in groups]
    assert set(drawn) == {5, 6, 7, 8, 9, 10}
    assert stats.chisquare(np.bincount(drawn)[5:]).pvalue > 1e-3
    assert {len(make(shipped("dynamic-obstacles"), 4 * k).tours) for k in range(60)} == set(
        range(1, 6)
    )


def test_streams_are_independent() -> None:
    spec = shipped("static-obstacles")
    moving = spec.model_copy(update={"moving": shipped("dynamic-obstacles").moving})
    for seed in range(20):
        far, near = make(spec, seed, 2), make(spec, seed, 0)
        np.testing.assert_array_equal(far.obstacles.center, near.obstacles.center)
        walked = make(moving, seed)
        assert walked.n_static == far.n_static
        np.testing.assert_array_equal(walked.obstacles.center[: far.n_static], far.obstacles.center)
        np.testing.assert_array_equal(walked.goal, far.goal)


def test_goals_spread_evenly_over_the_zone() -> None:
    spec = shipped("no-obstacles")
    goals = np.array([make(spec, seed).goal for seed in range(1500)])
    # The share of the allowed floor in each ring, from a fine raster.
    north, east = np.meshgrid(np.arange(-1, 45, 0.05), np.arange(-23, 23, 0.05))
    distance = np.hypot(north, east)
    allowed = (distance >= 7) & (distance <= 48)
    edges = [7, 16, 24, 32, 40, 48]
    expected, _ = np.histogram(distance[allowed], edges)
    found, _ = np.histogram(np.hypot(*goals.T), edges)
    assert stats.chisquare(found, expected / expected.sum() * len(goals)).pvalue > 1e-3
    assert stats.binomtest(int((goals[:, 1] > 0).sum()), len(goals)).pvalue > 1e-3


def test_zones_are_inclusive() -> None:
    spec = shipped("no-obstacles")
    assert [zone_radius_m(spec, k) for k in (0, 1, 2, None)] == [16, 32, 48, 48]
    assert zone_of(spec, np.array([0.0, 16.0])) == 0
    assert zone_of(spec, np.array([16.0, 1.0])) == 1
    assert zone_of(spec, np.array([40.0, 30.0])) is None
    assert {zone_of(spec, make(spec, seed, 2).goal) for seed in range(60)} == {0, 1, 2}
    for zone in (-1, 3):
        with pytest.raises(UsageError, match=rf"zone {zone}: accepted: 0 <= value <= 2"):
            make(spec, 0, zone)


def test_origin_is_the_start() -> None:
    b = local_bounds(spec_of(start={"north_m": 4, "east_m": 20}))
    assert (b.north_min, b.north_max, b.east_min, b.east_max, b.height) == (-4, 46, -20, 30, 5)


def test_fixed_goal_is_kept_and_kept_free() -> None:
    spec = spec_of(goal={"north_m": 20, "east_m": -3.5}, static={"count": [12, 12]})
    for seed in range(20):
        arena = make(spec, seed)
        np.testing.assert_array_equal(arena.goal, [20, -3.5])
        check_layout(arena, spec)
    with pytest.raises(
        UsageError, match=r"20\.3 m from the start; accepted: value <= 16 m in zone"
    ):
        make(spec, 0, 0)


def test_movers_are_where_their_tours_say() -> None:
    arena = make(shipped("dynamic-obstacles"), 1)
    n = arena.n_static
    np.testing.assert_array_equal(arena.centers_at(0), arena.obstacles.center)
    fastest = 2.5 + EPS
    previous = arena.centers_at(0)
    for time_us in range(100_000, 130_000_000, 100_000):
        now = arena.centers_at(time_us)
        np.testing.assert_array_equal(now[:n], previous[:n])
        np.testing.assert_array_equal(now[:, 2], previous[:, 2])
        assert np.linalg.norm(now[n:] - previous[n:], axis=1).max() <= fastest * 0.1
        previous = now
    period_us = round(arena.tours[0].times_s[-1] * 1e6)
    np.testing.assert_allclose(
        arena.centers_at(period_us + 7_000_000)[n], arena.centers_at(7_000_000)[n], atol=1e-5
    )


def test_movers_that_set_out_later_walk_the_same_way() -> None:
    arena = make(shipped("dynamic-obstacles"), 1)
    first = arena.tours[0]
    # Between way-points, on each of one tour, and after more than a whole tour.
    for later_s in (0.0, 0.3, 10.9, *first.times_s, first.times_s[-1] + 10.9):
        later = set_out_later(arena, float(later_s))
        np.testing.assert_array_equal(later.centers_at(0), later.obstacles.center)
        np.testing.assert_array_equal(later.goal, arena.goal)
        for tour in later.tours:
            assert tour.times_s[0] == 0.0
            assert (np.diff(tour.times_s) > 0.0).all()
            np.testing.assert_array_equal(tour.points[0], tour.points[-1])
        for time_us in range(0, 130_000_000, 1_700_000):
            # A microsecond's rounding at 2.5 m/s.
            np.testing.assert_allclose(
                later.centers_at(time_us + round(later_s * 1e6)),
                arena.centers_at(time_us),
                atol=3e-6,
            )
    standing = make(shipped("static-obstacles"), 1)
    assert set_out_later(standing, 10.9) is standing


def test_too_dense_is_refused_with_counts_after_bounded_work(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    layouts: list[int] = []

    def counted(*args: Any) -> Any:
        layouts.append(1)
        return place_all(*args)

    monkeypatch.setattr("airl_mav.arena.placement.place_all", counted)
    with pytest.raises(UsageError) as caught:
        make(spec_of(static={"count": [150, 150]}), 3)
    message = str(caught.value)
    assert len(layouts) == LAYOUTS
    assert "arena 'test', seed 3: too dense: " in message
    assert "of 150 static obstacles found a place, none for the next in 2048 tries" in message
    assert "% of the 50 x 50 m floor" in message
    assert "min_clearance_m 2" in message


def test_a_layout_given_up_has_drawn_only_what_it_tried() -> None:
    rngs = np.random.default_rng(5), np.random.default_rng(5)
    for rng in rngs:
        # An odd number of whole numbers leaves half a draw behind, which must not be lost.
        rng.integers(3, size=5)
    walls = Bounds(north_min=0.0, north_max=10.0, east_min=0.0, east_max=10.0, height=3.0)
    # The second would have to be where the first is; the third is never tried.
    halves = np.array([[3.0, 3.0], [3.0, 3.0], [0.1, 0.1]])
    with pytest.raises(NoRoomError) as caught:
        place_all(rngs[0], halves, Boxes(np.empty((0, 2)), np.empty((0, 2))), walls, 0.5)
    assert caught.value.progress == 1
    rngs[1].random((1 + BATCHES, BATCH, 2))
    assert rngs[0].bit_generator.state == rngs[1].bit_generator.state


@pytest.mark.parametrize(
    ("knobs", "width", "message"),
    [
        (
            {"zones_m": [61], "goal": {"min_distance_m": 60}},
            WIDTH_M,
            "no free place for the goal 60 to 61 m from the start, goal.clearance_m 2",
        ),
        ({"static": {"count": [1, 1]}}, 7.0, "no way 7 m wide from the start to the goal"),
        (
            {"moving": {"count": [30, 30], "half_width_m": [1.5, 1.5]}, "min_clearance_m": 9},
            WIDTH_M,
            "of 30 moving obstacles found a place and a tour among 0 static ones",
        ),
        (
            {
                "static": {"count": [1, 1], "half_width_m": [20, 20], "shapes": ["box"]},
                "size": {"north_m": 30, "east_m": 50, "height_m": 5},
            },
            WIDTH_M,
            "0 of 1 static obstacles",
        ),
    ],
)
def test_impossible_requests_say_why(knobs: dict[str, Any], width: float, message: str) -> None:
    with pytest.raises(UsageError) as caught:
        make(spec_of(**knobs), 0, width=width)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("seed", "width"), [(-1, WIDTH_M), (0, 0.0), (0, float("nan"))])
def test_wrong_arguments_are_refused(seed: int, width: float) -> None:
    with pytest.raises(UsageError, match="accepted"):
        make(shipped("no-obstacles"), seed, width=width)


def fence(gap_m: float, yaw: float = 0.0) -> Obstacles:
    """Two long boxes across the floor, from wall to wall but for a gap at east = 0."""
    half = (24.9 - gap_m / 2) / 2
    east = half + gap_m / 2
    return Obstacles(
        shape=np.zeros(2, np.int8),
        center=np.array([[20.0, east, -1], [20.0, -east, -1]]),
        half_size=np.array([[0.5, half, 1.0], [0.5, half, 1.0]]),
        yaw=np.array([yaw, yaw]),
    )


@pytest.mark.parametrize(
    ("gap_m", "width", "open_"),
    [(1.0, 0.55, True), (1.0, 1.05, False), (0.5, 0.55, False), (3.0, 2.5, True)],
)
def test_passage_through_a_fence(gap_m: float, width: float, open_: bool) -> None:
    bounds = local_bounds(spec_of())
    for yaw in (0.0, math.pi):
        obstacles = fence(gap_m, yaw)
        assert raster_passage(bounds, obstacles, np.array([40.0, 0.0]), width) is open_
        assert passage_exists(bounds, obstacles, np.array([40.0, 0.0]), width) is open_
        assert passage_exists(bounds, obstacles, np.array([10.0, 20.0]), width)


def test_goal_inside_an_obstacle_has_no_passage() -> None:
    bounds = local_bounds(spec_of())
    for goal in ([20.0, 10.0], [20.8, 10.0], [46.9, 0.0]):
        assert not passage_exists(bounds, fence(3.0), np.array(goal), WIDTH_M)


@pytest.mark.parametrize(("gap_m", "open_"), [(0.0, False), (0.3, False), (2.0, True)])
def test_goal_fenced_in_far_from_walls(gap_m: float, open_: bool) -> None:
    """Four boxes around the goal, `gap_m` apart at the corners along one axis."""
    reach = 4.0
    obstacles = Obstacles(
        shape=np.zeros(4, np.int8),
        center=np.array([[20 + reach, 0, -1], [20 - reach, 0, -1], [20, 4, -1], [20, -4, -1.0]]),
        half_size=np.array([[1, 5, 1], [1, 5, 1], [3 - gap_m, 1, 1], [3 - gap_m, 1, 1.0]]),
        yaw=np.zeros(4),
    )
    args = (local_bounds(spec_of()), obstacles, np.array([20.0, 0.0]), WIDTH_M)
    assert gaps_suffice(*args) is open_
    assert passage_exists(*args) is open_


@relaxed
@given(seed=seeds, n=st.integers(0, 14), width=st.floats(0.2, 2.0))
def test_passage_agrees_with_a_distance_transform(seed: int, n: int, width: float) -> None:
    """Never a wrong yes; a no only where a vehicle 1 m wider would not pass either."""
    rng = np.random.default_rng(seed)
    places = rng.uniform([3, -14], [20, 14], size=(n, 2))
    radius = rng.uniform(0.3, 4, size=(n, 2))
    shape = rng.integers(0, 3, size=n).astype(np.int8)
    round_ = shape != Shape.BOX
    arena = Arena(
        name="test",
        seed=seed,
        bounds=Bounds(-3, 27, -15, 15, 5),
        wall_colour=(0, 0, 0),
        obstacles=Obstacles(
            shape=shape,
            center=np.column_stack([places, np.full(n, -1.0)]),
            half_size=np.column_stack(
                [radius[:, 0], np.where(round_, radius[:, 0], radius[:, 1]), np.ones(n)]
            ),
            yaw=np.where(round_, 0.0, rng.uniform(-3, 3, size=n)),
        ),
        tours=(),
        goal=np.array([24.0, 5.0]),
    )
    args = (arena.bounds, arena.obstacles, arena.goal, width)
    if gaps_suffice(*args) or raster_passage(*args):
        assert passage_exists(*args)
        assert way_exists(arena, width - 0.2)
    else:
        assert not passage_exists(*args)
        assert not way_exists(arena, width + 1.0)


@pytest.mark.parametrize(
    "seeds", [range(10, 13), pytest.param(range(30), marks=pytest.mark.nightly)]
)
def test_walled_in_start_is_redrawn_or_refused(seeds: range) -> None:
    """Boxes with hardly a gap: the generator keeps only layouts with a way."""
    spec = spec_of(
        size={"north_m": 40, "east_m": 9, "height_m": 5},
        start={"east_m": 4.5, "clearance_m": 2},
        goal={"min_distance_m": 12, "clearance_m": 0.6},
        min_clearance_m=0,
        static={"count": [26, 26], "half_width_m": [0.8, 1.2], "shapes": ["box"]},
    )
    outcomes = set()
    for seed in seeds:
        try:
            arena = make(spec, seed, width=1.2)
        except UsageError as error:
            outcomes.add("refused")
            assert "no way 1.2 m wide" in str(error) or "too dense" in str(error)
        else:
            gaps = gaps_suffice(arena.bounds, arena.obstacles, arena.goal, 1.2)
            outcomes.add("wide gaps" if gaps else "found a way")
            assert way_exists(arena, 1.2 - 0.2)
    assert outcomes >= {"found a way", "refused"}


def test_free_area_fraction_matches_a_raster() -> None:
    arena = make(shipped("dynamic-obstacles"), 2)
    b, n, o = arena.bounds, arena.n_static, arena.obstacles
    north, east = np.meshgrid(
        np.arange(b.north_min, b.north_max, 0.05), np.arange(b.east_min, b.east_max, 0.05)
    )
    static = Obstacles(o.shape[:n], o.center[:n], o.half_size[:n], o.yaw[:n])
    taken = occupied(static, north, east).mean()
    assert free_area_fraction(arena) == pytest.approx(1 - taken, abs=2e-4)


def test_picture_is_written_whole_or_not_at_all(tmp_path: Path) -> None:
    arena = make(shipped("dynamic-obstacles"), 1)
    path = tmp_path / "arena.png"
    save_png(arena, path, time_us=3_000_000, goal_radius_m=3, zone_radii_m=(16, 32, 48))
    assert path.read_bytes().startswith(b"\x89PNG\r\n\x1a\n")
    pixels = np.round(imread(path)[..., :3] * 255).astype(int)
    crimson = (pixels == [153, 0, 0]).all(axis=2)
    assert 0.02 < crimson.mean() < 0.2
    assert list(tmp_path.iterdir()) == [path]
    with pytest.raises(OSError, match="nowhere"):
        save_png(arena, tmp_path / "nowhere" / "arena.png")


def test_picture_shows_what_is_there() -> None:
    arena = make(shipped("dynamic-obstacles"), 10)
    figure = Figure()
    FigureCanvasAgg(figure)
    ax = figure.add_subplot()
    draw_arena(arena, ax, 5_000_000, goal_radius_m=3)
    lines = {line.get_label(): np.asarray(line.get_xydata())[0] for line in ax.lines}
    np.testing.assert_allclose(lines["goal"], arena.goal[::-1])
    np.testing.assert_allclose(lines["start, heading north"], [0, 0])
    drawn = {
        tuple(np.round(patch.get_path().get_extents(patch.get_transform()).p0, 3))
        for patch in ax.patches
    }
    for i, center in enumerate(arena.centers_at(5_000_000)):
        low, _ = rectangle(arena, i, center)
        shown = ax.transData.transform(low[::-1])
        assert min(np.hypot(*(shown - corner)) for corner in drawn) < 1.0, i
    _, labels = ax.get_legend_handles_labels()
    assert set(labels) == {"static obstacle", "moving obstacle", "start, heading north", "goal"}
    assert ax.get_aspect() == 1.0


def run_cli(*args: str) -> str:
    code, text = airl("arena", *args, width=120)
    assert code == 0
    return text


def test_cli_prints_the_arena_and_draws_it(tmp_path: Path) -> None:
    # Text that resembles terminal markup is printed verbatim.
    png = tmp_path / "a[bold].png"
    text = run_cli("dynamic-obstacles", "--seed", "12", "--zone", "1", "--png", str(png))
    assert f"picture: {png}" in text
    arena = make(shipped("dynamic-obstacles"), 12, 1)
    assert "dynamic-obstacles, seed 12" in text
    assert "50 x 50 x 5 m" in text
    assert f"{np.hypot(*arena.goal):.2f} m, zone" in text
    assert f"{arena.goal[0]:.2f} N {arena.goal[1]:.2f} E m" in text
    assert f"{len(arena.tours)} (" in text
    first = arena.tours[0]
    speed = np.hypot(*(first.points[1] - first.points[0])) / first.times_s[1]
    assert f"{speed:.2f}" in text
    assert png.stat().st_size > 10_000
    assert "seed 0" in run_cli("no-obstacles")


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (["nope"], "no arena profile 'nope'; shipped: crowded, dense-obstacles, dynamic-obs"),
        (["no-obstacles", "--zone", "5"], "--zone 5: accepted: 0 <= value <= 2"),
        (
            ["no-obstacles", "--png", "a.jpg"],
            "--png a.jpg: accepted: a file name that ends in .png",
        ),
        (["no-obstacles", "--png", "/nowhere/a.png"], "--png /nowhere/a.png: cannot write"),
        (
            ["no-obstacles", "--vehicle-width-m", "0"],
            "--vehicle-width-m 0: accepted: 0 < value <= 100 m",
        ),
        (["no-obstacles", "--time-s=-1"], "--time-s -1: accepted: 0 <= value <= 1e+06 s"),
    ],
)
def test_cli_refuses_in_one_line(args: list[str], message: str) -> None:
    with pytest.raises(UsageError) as caught:
        run_cli(*args)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)
