"""The planner: map, path, tracks and flights."""

from __future__ import annotations

import heapq
import math
import subprocess
import sys
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import ndimage, signal

from airl_mav import Scenario, rehearse
from airl_mav.flight.judge import Outcome
from airl_mav.policy import planner_kernels as kernels
from airl_mav.policy.actions import Action
from airl_mav.policy.observation import InFlight
from airl_mav.policy.planner import (
    ABOVE_M,
    BASE,
    BLOCKED,
    CELLS,
    CREEP_M_S,
    LAYERS,
    LEARNED,
    OUTCOME_FEATURES,
    STRAIGHT_ON_S,
    Hold,
    OccupancyMap,
    Places,
    PlannerPolicy,
    PlannerSettings,
    Scans,
    Track,
    follow,
)
from airl_mav.profiles.arena import ArenaSpec
from airl_mav.profiles.loading import load_profile, profiles_dir
from airl_mav.scenario.resolve import resolve
from tests.unit.test_greedy import arena, look

S = PlannerSettings()
FOV = math.radians(90.0)
BEARINGS = 45
NO_HITS = np.empty((0, 2))
TEST_ARENAS = sorted((profiles_dir() / "arenas" / "test").glob("*.toml"))

Floats = NDArray[np.float64]


def new_map(goal: tuple[float, float] = (30.0, 0.0)) -> OccupancyMap:
    return OccupancyMap(np.zeros(2), np.array(goal))


def scans(ranges: Floats, rays: float = math.inf) -> Scans:
    """Scans with lines of sight of one length, from straight down to straight up."""
    return Scans(ABOVE_M, ranges, -10.0, 1.0, np.full((BEARINGS, 20), rays))


def update(known: OccupancyMap, position: Floats, ranges: Floats, hits: Floats) -> None:
    """Look at the layer of the vehicle alone."""
    every, all_hits = np.zeros((LAYERS, BEARINGS)), [NO_HITS] * LAYERS
    every[BASE], all_hits[BASE] = ranges, hits
    known.look(position, 0.0, FOV, scans(every), all_hits)


def seen_from(position: Floats, circles: list[tuple[Floats, float]]) -> tuple[Floats, Floats]:
    """Ranges (b,) and points (b, 2) of circles seen from a position along the north axis."""
    angle = (np.arange(BEARINGS) + 0.5) * (FOV / BEARINGS) - 0.5 * FOV
    ray = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    ranges = np.full(BEARINGS, np.inf)
    for center, radius in circles:
        to = center - position
        along, square = ray @ to, float(to @ to)
        inside = radius**2 - (square - along**2)
        hit = along - np.sqrt(np.maximum(inside, 0.0))
        ranges = np.where((inside > 0.0) & (along > 0.0), np.minimum(ranges, hit), ranges)
    points, seen = np.full((BEARINGS, 2), np.inf), np.isfinite(ranges)
    points[seen] = position + ranges[seen, None] * ray[seen]
    return ranges, points


# --- map


def test_a_map_shows_a_wall_and_the_free_space_in_front_of_it() -> None:
    known, policy = new_map(), PlannerPolicy()
    wall = look(arena((8.5, 0.0, 0.5, 6.0)), (30.0, 0.0))
    for _ in range(3):
        policy.act(wall)
    assert policy._map is not None
    evidence = policy._map.evidence[BASE]
    # The wall's near face is 8 m north: its cell, or the next one.
    row, column = known.cells_of(np.array([[8.0, 0.0], [8.0, 4.0]]))
    assert all(evidence[r - 1 : r + 2, c].max() > 0.0 for r, c in zip(row, column, strict=True))
    free = known.cells_of(np.array([[2.0, 0.0], [5.0, 3.0], [6.5, -5.0]]))
    assert (evidence[free] < 0.0).all()
    behind = known.cells_of(np.array([[10.5, 0.0], [-5.0, 0.0], [3.0, 9.0]]))
    assert (evidence[behind] == 0.0).all()


def test_looks_through_a_cell_free_it_again() -> None:
    known = new_map()
    ranges, points = seen_from(np.zeros(2), [(np.array([6.0, 0.0]), 0.5)])
    hits = points[np.isfinite(ranges)]
    cell = known.cells_of(np.array([[5.5, 0.0]]))
    for _ in range(20):
        update(known, np.zeros(2), ranges, hits)
    most = float(known.evidence[BASE][cell][0])
    assert most > 0.0
    for looks in range(1, 12):
        update(known, np.zeros(2), np.full(BEARINGS, np.inf), NO_HITS)
        assert known.evidence[BASE][cell][0] == pytest.approx(max(-2.0, most - looks))


@given(st.integers(0, 2**31), st.floats(0.0, 0.2))
def test_gaps_agree_with_scipy(seed: int, share: float) -> None:
    known = new_map()
    full = np.random.default_rng(seed).random(known.evidence.shape) < share
    known.evidence = np.where(full, 1.0, -1.0)
    gap = known.gaps(1, NO_HITS, S.comfort_m)
    free = known.evidence[1] <= 0.0
    if free.all():
        assert (gap > S.comfort_m).all()
        return
    expected = ndimage.distance_transform_edt(free, sampling=known.cell)
    near = expected <= S.comfort_m
    np.testing.assert_allclose(gap[near], expected[near], atol=1e-9)
    assert (gap[~near] > S.comfort_m).all()


@given(
    st.lists(
        st.tuples(st.integers(-30, 30), st.floats(0.1, 25), st.sampled_from([-1.1, 0.0, 0.3, 0.7])),
        max_size=80,
    )
)
def test_a_scan_keeps_the_nearest_range_of_each_height_and_bearing(
    polar: list[tuple[int, float, float]],
) -> None:
    # In the middle of bearings of 2 degrees, also of some out of view.
    numbers, ranges, up = (np.array(each) for each in np.reshape(polar, (-1, 3)).T)
    angle = np.radians(2.0 * numbers)
    points = np.stack([ranges * np.cos(angle), ranges * np.sin(angle), -up], axis=1)
    above = np.array([0.0, 0.5])
    found, rays = np.full((2, BEARINGS), np.inf), np.full((BEARINGS, 4), np.inf)
    kernels.scan_layers(points, above, 0.5, FOV, -1.0, 2.0, found, rays)
    bearing = numbers + BEARINGS // 2
    for layer, k in np.ndindex(found.shape):
        inside = (bearing == k) & (np.abs(up - above[layer]) < 0.5)
        assert found[layer, k] == pytest.approx(min(ranges[inside], default=math.inf))
    line = np.floor((up / ranges + 1.0) * 2.0)
    for k, slope in np.ndindex(rays.shape):
        inside = (bearing == k) & (line == slope)
        assert rays[k, slope] == pytest.approx(min(ranges[inside], default=math.inf))


def test_a_layer_is_free_where_lines_of_sight_reach_it() -> None:
    known = new_map()
    ranges = np.full((LAYERS, BEARINGS), np.inf)
    # A beam 4 m ahead, half a metre above the vehicle.
    ranges[BASE + 1] = 4.0
    seen = scans(ranges)._replace(lowest=-2.0, per_slope=20.0, rays=np.full((BEARINGS, 80), np.inf))
    seen.rays[:, 40 + int(20.0 * 0.4 / 4.0) : 40 + math.ceil(20.0 * 0.6 / 4.0)] = 4.0
    known.look(np.zeros(2), 0.0, FOV, seen, [NO_HITS] * LAYERS)
    rows, columns = known.cells_of(np.array([[3.0, 0.0], [6.0, 0.0], [8.0, 0.0]]))
    near, behind, far = (known.evidence[:, rows, columns] < 0.0).T.tolist()
    assert near == [True] * LAYERS
    assert behind == [True] * (BASE + 1) + [False] + [True] * (LAYERS - BASE - 2)
    # The lines of sight to one metre above pass the beam at half of their length.
    assert far[BASE + 1 : BASE + 3] == [False, False]
    assert far[: BASE + 1] == [True] * (BASE + 1)


def test_what_is_out_of_the_image_is_not_free() -> None:
    known = new_map()
    seen = scans(np.full((LAYERS, BEARINGS), np.inf))
    seen = seen._replace(lowest=-0.1, per_slope=10.0, rays=np.full((BEARINGS, 2), np.inf))
    known.look(np.zeros(2), 0.0, FOV, seen, [NO_HITS] * LAYERS)
    rows, columns = known.cells_of(np.array([[3.0, 0.0], [8.0, 0.0]]))
    near, far = (known.evidence[:, rows, columns] < 0.0).T.tolist()
    # Half a metre is in view from 5 m on, one metre from 10 m.
    assert near == [layer == BASE for layer in range(LAYERS)]
    assert far == [abs(layer - BASE) <= 1 for layer in range(LAYERS)]


def test_an_obstacle_is_as_high_as_the_arena_until_it_is_seen() -> None:
    known = new_map()
    cell = known.cells_of(np.array([[6.0, 0.0]]))
    known.evidence[BASE][cell] = 5.0
    known.evidence[BASE + 2][cell] = -2.0
    here = [known.gaps(layer, NO_HITS, S.comfort_m)[cell][0] for layer in range(LAYERS)]
    assert [gap == 0.0 for gap in here] == [layer != BASE + 2 for layer in range(LAYERS)]


def test_a_gate_above_is_flown_through_at_its_height() -> None:
    known, policy = new_map(), PlannerPolicy()
    policy._heights_m = 2.5 + ABOVE_M
    (row, _), (_, column) = known.cells_of(np.array([[10.0, 0.0], [10.0, 3.0]]))
    known.evidence[:, row] = 5.0
    known.evidence[BASE + 2 :, row, column - 3 : column + 4] = -2.0
    hits, goal = [NO_HITS] * LAYERS, np.array([20.0, 0.0])
    target, level, gaps = policy._way(known, np.zeros(2), goal, hits)
    assert level == BASE + 2
    assert known.is_clear(gaps[1], np.zeros(2), target, 0.5)
    # Blocked at all heights: it stays.
    known.evidence[:, row] = 5.0
    assert policy._way(known, np.zeros(2), goal, hits)[1] == BASE


# --- path


def reference_cost(known: OccupancyMap, start: Floats, goal: Floats, gap: Floats) -> Floats:
    """Costs of all nodes to the goal, by Dijkstra's algorithm with a heap."""
    half = CELLS // 2
    wide = gap.reshape(half, 2, half, 2).max(axis=(1, 3))
    room = (wide - S.radius_m) / (S.comfort_m - S.radius_m)
    cost = np.where(room < 0.15, BLOCKED, 1.0 / np.clip(room, 0.25, 1.0))
    rows, columns = known.cells_of(np.stack([start, goal]))
    best = np.full((half, half), np.inf)
    end = (int(rows[1]) // 2, int(columns[1]) // 2)
    best[end] = 0.0
    heap = [(0.0, end)]
    moves = [(s * r, s * c) for r, c in kernels.MOVES for s in (1, -1)]
    while heap:
        so_far, (r, c) = heapq.heappop(heap)
        if so_far > best[r, c]:
            continue
        for dr, dc in moves:
            to = (r + dr, c + dc)
            if not (0 <= to[0] < half and 0 <= to[1] < half):
                continue
            on_way = [(r, c), to]
            if abs(dr) == 2:
                on_way += [(r + dr // 2, c), (r + dr // 2, c + dc)]
            elif abs(dc) == 2:
                on_way += [(r, c + dc // 2), (r + dr, c + dc // 2)]
            length = math.hypot(dr, dc) * 2.0 * known.cell
            there = so_far + length * float(np.mean([cost[each] for each in on_way]))
            if there < best[to] - 1e-12:
                best[to] = there
                heapq.heappush(heap, (there, to))
    return best


@pytest.mark.parametrize("seed", range(3))
def test_a_path_has_the_least_cost(seed: int) -> None:
    known, start, goal = new_map(), np.zeros(2), np.array([30.0, 4.0])
    rng = np.random.default_rng(seed)
    for _ in range(25):
        row, column = rng.integers(10, CELLS - 20, 2)
        known.evidence[
            BASE, row : row + rng.integers(1, 9), column : column + rng.integers(1, 9)
        ] = 5.0
    gap = known.gaps(BASE, NO_HITS, S.comfort_m)
    path, cost = known.path(start, goal, gap, S)
    best = reference_cost(known, start, goal, gap)
    nodes = [tuple((index // 2).astype(int)) for index in (path - known.origin) / known.cell]
    costs = [best[node] for node in nodes]
    # Each node of a path of least cost is nearer to the goal, by the cost of its link.
    assert all(a > b for a, b in pairwise(costs))
    np.testing.assert_allclose(path[-1], goal)
    assert cost == pytest.approx(best[nodes[0]])
    assert cost < BLOCKED * known.cell
    assert (gap[known.cells_of(path[1:-1])] > 0.0).all()


def test_no_path_leads_through_a_wall_one_cell_thick() -> None:
    known, start, goal = new_map(), np.zeros(2), np.array([20.0, 0.0])
    (row, _), (_, column) = known.cells_of(np.array([[10.0, 0.0], [10.0, 12.0]]))
    known.evidence[BASE, row, :] = 5.0
    # A door of 2 m.
    door = slice(column - 3, column + 2)
    known.evidence[BASE, row, door] = -2.0
    gap = known.gaps(BASE, NO_HITS, S.comfort_m)
    path, _ = known.path(start, goal, gap, S)
    crossing = path[np.abs(path[:, 0] - 10.0) < 0.6]
    assert len(crossing) > 0
    assert (np.abs(crossing[:, 1] - 12.0) < 1.2).all()


def test_it_loads_its_kernels_before_the_flight() -> None:
    program = """
import sys
from airl_mav.policy.registry import load_policy
assert "numba" not in sys.modules
load_policy("planner", 0.1)
assert "airl_mav.policy.planner_kernels" in sys.modules
"""
    subprocess.run([sys.executable, "-c", program], check=True)


# --- tracks


@pytest.mark.parametrize("velocity", [(0.0, 1.5), (-2.0, 0.5), (-1.0, -2.0), (0.0, 3.5)])
def test_a_moving_obstacle_is_tracked(velocity: tuple[float, float]) -> None:
    known, tracks, going = new_map(), list[Track](), np.array(velocity)
    for step in range(14):
        at = np.array([9.0, 0.0]) + (0.1 * step - 0.7) * going
        ranges, points = seen_from(np.zeros(2), [(at, 0.6)])
        tracks, moving = follow(tracks, known, points, ranges, 0.1)
        update(known, np.zeros(2), ranges, points[np.isfinite(ranges) & ~moving])
    (track,) = [each for each in tracks if each.moving]
    assert moving[np.isfinite(ranges)].all()
    assert np.hypot(*(track.velocity - going)) < 0.35 * np.hypot(*going)
    # The visible surface is nearer than the middle.
    assert np.hypot(*(track.position - at)) < 0.9


@pytest.mark.parametrize("speed", [1.0, 3.0, 5.0])
def test_static_obstacles_seen_in_flight_do_not_move(speed: float) -> None:
    rng = np.random.default_rng(3)
    circles = [
        (np.array([rng.uniform(8.0, 30.0), rng.uniform(-12.0, 12.0)]), rng.uniform(0.2, 1.5))
        for _ in range(14)
    ]
    known, tracks, said = new_map(), list[Track](), 0
    for step in range(int(20.0 / speed / 0.1)):
        position = np.array([0.1 * step * speed, -13.0])
        ranges, points = seen_from(position, circles)
        ranges = ranges + np.where(np.isfinite(ranges), rng.normal(0.0, 0.02, BEARINGS), 0.0)
        tracks, moving = follow(tracks, known, points, ranges, 0.1)
        update(known, position, ranges, points[np.isfinite(ranges) & ~moving])
        said += int(moving.sum())
    assert said <= 0.01 * BEARINGS * step


def test_a_lost_obstacle_is_forgotten() -> None:
    known, nothing = new_map(), np.full(BEARINGS, np.inf)
    track = Track(np.array([5.0, 0.0]), np.array([3.0, 0.0]), 0.5, np.array([2.0, 0.0]), 1.0)
    tracks = [track]
    for _ in range(20):
        tracks, _ = follow(tracks, known, np.full((BEARINGS, 2), np.inf), nothing, 0.1)
    assert tracks == []
    np.testing.assert_allclose(track.position, [8.0, 0.0], atol=0.2)


# --- decisions


def test_it_flies_straight_to_a_visible_goal() -> None:
    action = PlannerPolicy().act(look(arena(), (15.0, 0.0)))
    assert isinstance(action, Action)
    assert action.forward_m_s == pytest.approx(S.speeds_m_s[-1], rel=0.02)
    assert abs(action.right_m_s) < 0.1
    assert action.yaw_rate_rad_s == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_it_passes_a_wall_on_the_shorter_side(side: float) -> None:
    policy = PlannerPolicy()
    wall = look(arena((10.0, side * 3.0, 0.3, 5.0)), (20.0, 0.0))
    action = [policy.act(wall) for _ in range(3)][-1]
    assert action.right_m_s * side < -0.5
    assert action.yaw_rate_rad_s * side < 0.0


def test_it_stays_within_its_speed_and_turns_to_a_goal_behind() -> None:
    policy = PlannerPolicy()
    action = policy.act(look(arena(), (-12.0, 2.0)))
    assert math.hypot(action.forward_m_s, action.right_m_s) <= CREEP_M_S + 1e-9
    assert action.yaw_rate_rad_s == pytest.approx(S.max_yaw_rate_rad_s)


def test_it_pursues_a_point_of_the_path_ahead_even_without_sight_of_it() -> None:
    known, policy = new_map(), PlannerPolicy()
    known.evidence[:] = 0.0
    rows, columns = known.cells_of(np.array([[2.0, -9.0], [2.0, 9.0]]))
    known.evidence[:, rows[0], columns[0] : columns[1]] = 5.0
    hits = [NO_HITS] * LAYERS
    target, level, _ = policy._way(known, np.zeros(2), np.array([30.0, 0.0]), hits)
    assert level == BASE
    assert np.hypot(*target) > 1.5


def mover(north: float, east: float, speed: float) -> Track:
    """An obstacle of 0.5 m that approaches the origin from the north, tracked for a second."""
    at, going = np.array([north, east]), np.array([-speed, 0.0])
    return Track(at, at - going, 0.5, going, 1.0)


def predicted(
    policy: PlannerPolicy, wishes: Floats, hold: Hold, target: tuple[float, float] = (30.0, 0.0)
) -> Floats:
    """Outcomes (8, k, c) in open space, from a hover."""
    known, goal = new_map(), np.array(target)
    gap = known.gaps(BASE, NO_HITS, S.comfort_m)
    still = np.zeros(2)
    return policy._outcomes(
        known, BASE, np.stack([gap, gap]), wishes, hold, Places(still, still, goal, goal)
    )


QUICK = Hold(S.dead_time_s + 0.01, 0.11, 0.0, 0.0)


def test_too_close_to_a_moving_obstacle_it_leaves() -> None:
    policy = PlannerPolicy()
    policy._tracks = [mover(0.9, 0.0, 1.0)]
    wishes = policy._wishes(0.0, 0.0, FOV, 0.01)
    costs = predicted(policy, wishes, QUICK)[kernels.COST].min(axis=0)
    assert costs[wishes[:, 0] > 1.0].min() > costs[wishes[:, 0] < 0.0].min()


@pytest.mark.parametrize("speed", [0.6, 2.5])
def test_a_prediction_is_a_first_order_response(speed: float) -> None:
    found = predicted(PlannerPolicy(), np.array([[speed, 0.0]]), QUICK)
    t = kernels.STEP_S * np.arange(1, 100)
    for k, straight_on in enumerate(STRAIGHT_ON_S):
        end = QUICK.lead_s + QUICK.held_s + straight_on
        asked = np.where((t > QUICK.lead_s) & (t <= end), speed, 0.0)
        left = math.exp(-kernels.STEP_S / S.response_s)
        steps = math.ceil((QUICK.lead_s + QUICK.held_s + 1.5 + kernels.BRAKING_S) / kernels.STEP_S)
        going = signal.lfilter([1.0 - left], [1.0, -left], asked)[:steps]
        away = 30.0 - kernels.STEP_S * going.sum()
        assert found[kernels.LEFT, k, 0] * S.speeds_m_s[-1] == pytest.approx(away, abs=1e-9)


def test_a_setpoint_turns_with_the_nose() -> None:
    """A setpoint of 2 s that turns by 1 rad flies an arc about its mean course."""
    turning, straight = (
        predicted(PlannerPolicy(), np.array([[2.0, 0.0]]), Hold(0.23, 2.0, rate, 0.0))
        for rate in (0.5, 0.0)
    )
    # Chord over arc of 1 rad.
    chord = 2.0 * math.sin(0.5)
    away = 30.0 - S.speeds_m_s[-1] * np.array([turning, straight])[:, kernels.LEFT, 0, 0]
    assert away[0] == pytest.approx(chord * away[1], rel=0.03)
    assert away[0] < 0.99 * away[1]


def test_a_collision_with_a_moving_obstacle_has_its_time() -> None:
    policy = PlannerPolicy()
    policy._tracks = [mover(5.0, 0.0, 2.0)]
    hit_s = predicted(policy, np.zeros((1, 2)), QUICK)[kernels.HIT_S]
    # (5 - 2 t) m are left of 0.5 + 0.3 + 0.25 + 0.25 t + 0.2.
    assert hit_s == pytest.approx(3.75 / 2.25, abs=kernels.STEP_S)
    policy._tracks = []
    assert np.isinf(predicted(policy, np.zeros((1, 2)), QUICK)[kernels.HIT_S]).all()


def test_late_decisions_fly_slowly() -> None:
    wishes = PlannerPolicy(LEARNED)._wishes(0.0, 0.0, FOV, 0.396)
    assert np.hypot(*wishes.T).max() == pytest.approx(2.5)
    wishes = PlannerPolicy(LEARNED)._wishes(0.0, 0.0, FOV, 0.1)
    assert np.hypot(*wishes.T).max() == pytest.approx(7.0)


@pytest.mark.parametrize(("bearing", "most"), [(0.6, 7.0), (1.0, 3.75), (-2.0, 3.75)])
def test_it_flies_slowly_while_its_path_is_out_of_view(bearing: float, most: float) -> None:
    wishes = PlannerPolicy(LEARNED)._wishes(bearing, 0.0, FOV, 0.01)
    assert np.hypot(*wishes.T).max() == pytest.approx(most)


def test_it_knows_the_setpoint_in_flight() -> None:
    """A compensated observation is of the time at which the setpoint arrives."""
    seen = look(arena(), (20.0, 0.0))
    told = InFlight(np.array(0.4), np.array(0.0), np.array([0.0, 2.0, 0.0, 0.0]))
    reached = []
    for foreseen in (True, False):
        policy = PlannerPolicy(LEARNED)
        in_flight = replace(told, foreseen=foreseen)
        found = policy.candidates(replace(seen, in_flight=in_flight), features=True)
        np.testing.assert_allclose(policy._last, [0.0, 2.0])
        reached.append(found.features[0, OUTCOME_FEATURES - 2])
    # Without compensation it flies to the side for another 0.4 s.
    assert reached[1] > reached[0]


# --- flights


def flown(arena_name: str, seed: int, episodes: int, out: Path) -> list[Any]:
    scenario = Scenario(
        policy="planner", arena=arena_name, level="gym", seed=seed, episodes=episodes
    )
    assert resolve(scenario).pilot.hold_s == 0.1
    return list(rehearse(scenario, out=out).episodes)


@pytest.mark.parametrize("name", ["rooms", "dense-obstacles", "test/l-walls", "test/poles-160"])
def test_it_reaches_goals_behind_walls(name: str, tmp_path: Path) -> None:
    file = str(profiles_dir() / "arenas" / f"{name}.toml") if "/" in name else name
    episodes = flown(file, 700_101, 4, tmp_path / "run")
    assert [each.outcome for each in episodes] == [Outcome.SUCCESS] * 4


def test_the_same_seed_gives_the_same_flight(tmp_path: Path) -> None:
    first, second = (flown("crowded", 700_200, 2, tmp_path / name) for name in "ab")
    assert [each.quality for each in first] == [each.quality for each in second]


def test_six_test_arenas_are_fixed() -> None:
    assert [path.stem for path in TEST_ARENAS] == [
        "corridor",
        "l-walls",
        "movers-fast",
        "movers",
        "poles-160",
        "poles-80",
    ]
    for path in TEST_ARENAS:
        assert load_profile("arenas", str(path), ArenaSpec).description.startswith("Test arena")
