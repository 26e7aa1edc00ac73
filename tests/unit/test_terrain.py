"""Hills: surface against matplotlib's, camera images, contacts, arenas and paths."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy
from matplotlib.tri import LinearTriInterpolator, Triangulation
from numpy.typing import NDArray

from airl_mav.addons.colour.picture import render_picture
from airl_mav.arena.generate import generate, local_bounds
from airl_mav.arena.geometry import Arena, Ground, Obstacles, Shape, no_relief
from airl_mav.arena.placed_assets import _problem
from airl_mav.arena.placement import Boxes, Hills, bounding_half, raster_passage
from airl_mav.arena.relief import draw_ground, extreme_within, plane_at, stand_on
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.camera.primitives import FLOOR, OBSTACLE, SKY
from airl_mav.camera.render import render
from airl_mav.core.frames import quat_from_euler
from airl_mav.envs.arena_batch import FLOOR as TOUCHED_FLOOR
from airl_mav.envs.arena_batch import NOTHING, clearance, touches
from airl_mav.profiles.arena import MOST_CELLS, ArenaSpec, Terrain
from airl_mav.profiles.loading import load_profile
from airl_mav.profiles.projections import Projection
from tests.support.lenses import AT_NIGHT_THE_FISHEYE
from tests.support.meshes import kept, ring, scene_of, triangles
from tests.unit.test_meshes_seen import in_world, nearest, rays_of

Floats = NDArray[np.float64]

HILLS = load_profile("arenas", "hills", ArenaSpec)


def spec_of(**tables: Any) -> ArenaSpec:
    return ArenaSpec.model_validate(HILLS.model_dump() | {"description": "a test"} | tables)


@cache
def arena_of(seed: int) -> Arena:
    return generate(HILLS, seed, name="hills", vehicle_width_m=0.6)


def bare(arena: Arena) -> Arena:
    """Return an arena without obstacles."""
    o = arena.obstacles
    none = Obstacles(o.shape[:0], o.center[:0], o.half_size[:0], o.yaw[:0])
    return replace(arena, obstacles=none, statics=None, meshes=())


def ground_of(arena: Arena) -> Ground:
    assert arena.ground is not None
    return arena.ground


def reference(ground: Ground, north: Any, east: Any) -> Floats:
    """Return the heights at places by matplotlib's interpolation of the same triangles."""
    points = ground.points
    surface = Triangulation(points[:, 0], points[:, 1], ground.faces)
    found: Floats = LinearTriInterpolator(surface, -points[:, 2])(north, east).filled(0.0)
    return found


# --- the surface


@pytest.mark.parametrize("seed", [0, 3])
def test_the_surface_is_that_of_its_triangles(seed: int) -> None:
    arena = arena_of(seed)
    ground, b = ground_of(arena), arena.bounds
    rng = np.random.default_rng(seed)
    north, east = (
        rng.uniform(b.north_min, b.north_max, 500),
        rng.uniform(b.east_min, b.east_max, 500),
    )
    heights = [ground.height_at(n, e) for n, e in zip(north, east, strict=True)]
    np.testing.assert_allclose(heights, reference(ground, north, east), atol=1e-12)
    # The slopes match the surrounding heights.
    for n, e in zip(north[:100], east[:100], strict=True):
        height, up, across = plane_at(ground.relief, n, e)
        step = 1e-7
        rise = ground.height_at(n + step, e) - height, ground.height_at(n, e + step) - height
        near_an_edge = min(
            abs((n - ground.south) / ground.step_north % 1.0),
            abs((e - ground.west) / ground.step_east % 1.0),
        )
        if near_an_edge > 0.01:
            np.testing.assert_allclose(np.array(rise) / step, (up, across), atol=1e-5)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_extremes_in_a_disc_are_those_of_many_points_in_it(sign: float) -> None:
    arena = arena_of(3)
    ground, b = ground_of(arena), arena.bounds
    rng = np.random.default_rng(5)
    turn, share = np.meshgrid(np.linspace(0.0, math.tau, 361), np.sqrt(np.linspace(0.0, 1.0, 40)))
    for _ in range(60):
        n, e = rng.uniform(b.north_min, b.north_max), rng.uniform(b.east_min, b.east_max)
        radius = rng.uniform(0.1, 2.5)
        north = (n + radius * share * np.cos(turn)).ravel()
        east = (e + radius * share * np.sin(turn)).ravel()
        inside = (north >= b.north_min) & (north <= b.north_max)
        inside &= (east >= b.east_min) & (east <= b.east_max)
        sampled = float((sign * reference(ground, north[inside], east[inside])).max())
        found = extreme_within(ground.relief, n, e, radius, sign)
        # No sampled point exceeds the extreme, and one sample is near it.
        assert sampled - 1e-12 <= found <= sampled + 0.03 * radius


def test_there_is_no_ground_beyond_the_walls_nor_without_hills() -> None:
    ground = ground_of(arena_of(3))
    assert plane_at(ground.relief, -4.5, 0.0) == (0.0, 0.0, 0.0)
    assert extreme_within(ground.relief, -6.0, 0.0, 1.0, 1.0) == -math.inf
    assert plane_at(no_relief(), 1.0, 1.0) == (0.0, 0.0, 0.0)
    assert extreme_within(no_relief(), 1.0, 1.0, 1.0, 1.0) == -math.inf


# --- drawing


@pytest.mark.parametrize("seed", range(6))
def test_hills_are_as_high_as_drawn_and_level_around_the_start(seed: int) -> None:
    ground = ground_of(arena_of(seed))
    low, high = HILLS.terrain.relief_m
    assert low <= ground.top_m <= high
    assert ground.heights.min() == 0.0
    # No triangle that rises reaches into what is level.
    corners = ground.points[ground.faces][..., :2]
    middles = corners.mean(axis=1)
    assert np.linalg.norm(middles, axis=1).min() > HILLS.terrain.flat_m
    around = np.linspace(0.0, math.tau, 200)
    for share in (0.2, 0.7, 1.0):
        radius = share * HILLS.terrain.flat_m
        assert not reference(ground, radius * np.cos(around), radius * np.sin(around)).any()


def test_hills_are_as_wide_as_they_are_asked_for() -> None:
    # The width of the autocorrelation's peak, of many grounds without a level part.
    for scale in (10.0, 20.0):
        widths = []
        for seed in range(8):
            terrain = Terrain(relief_m=(5.0, 5.0), scale_m=scale, flat_m=1.0)
            bounds = local_bounds(
                spec_of(size={"north_m": 120.0, "east_m": 120.0, "height_m": 14.0})
            )
            ground = draw_ground(np.random.default_rng(seed), terrain, bounds)
            rough = ground.heights - ground.heights.mean()
            spectrum = np.abs(np.fft.fft2(rough)) ** 2
            correlation = np.fft.ifft2(spectrum).real
            along = correlation[: len(correlation) // 2, 0] / correlation[0, 0]
            first = int(np.argmax(along < 0.5))
            crossed = first - 1 + (along[first - 1] - 0.5) / (along[first - 1] - along[first])
            widths.append(2.0 * ground.step_north * crossed)
        assert np.mean(widths) == pytest.approx(0.7 * scale, rel=0.3)


def test_the_same_seed_has_the_same_ground_and_another_one_another() -> None:
    again = generate(HILLS, 3, name="hills", vehicle_width_m=0.6)
    np.testing.assert_array_equal(ground_of(again).heights, ground_of(arena_of(3)).heights)
    assert not np.array_equal(ground_of(arena_of(2)).heights, ground_of(arena_of(3)).heights)


def test_hills_change_no_other_draw() -> None:
    flat = spec_of(terrain={})
    low = spec_of(terrain={"relief_m": [1.0, 1.0], "scale_m": 16.0})
    for seed in range(4):
        one, other = (generate(s, seed, name="x", vehicle_width_m=0.6) for s in (flat, low))
        # Hills that are flown over: only heights differ.
        np.testing.assert_array_equal(one.goal, other.goal)
        np.testing.assert_array_equal(one.obstacles.center[:, :2], other.obstacles.center[:, :2])
        np.testing.assert_array_equal(one.obstacles.half_size, other.obstacles.half_size)
        assert one.ground is None
        assert other.ground is not None


# --- obstacles on hills


def test_obstacles_stand_on_the_lowest_ground_below_them() -> None:
    lifted = 0
    for seed in range(8):
        arena = arena_of(seed)
        ground, o, statics = ground_of(arena), arena.obstacles, arena.statics
        assert statics is not None
        half = bounding_half(o.shape, o.half_size, o.yaw)
        bottom = -(o.center[:, 2] + o.half_size[:, 2])
        for thing, name in enumerate(statics.names):
            own = np.flatnonzero(statics.of == thing)
            base = bottom[own].min()
            if name == "tree":  # All of its parts are lifted alike.
                assert len(own) > 1
            for i in own:
                low, high = o.center[i, :2] - half[i], o.center[i, :2] + half[i]
                north, east = (np.linspace(*ends, 60) for ends in zip(low, high, strict=True))
                below = ground.sampled(north, east)
                if o.shape[i] != Shape.BOX:
                    away = np.hypot(north[:, None] - o.center[i, 0], east - o.center[i, 1])
                    below = below[away <= half[i, 0]]
                assert base <= below.min() + 1e-9, "it floats"
            assert base >= 0.0
            lifted += base > 0.3
    assert lifted > 5


def test_spheres_cross_the_flight_altitude_above_the_start() -> None:
    spec = spec_of(static={"count": [12, 12], "shapes": ["sphere"], "half_width_m": [0.4, 0.8]})
    o = generate(spec, 1, name="x", vehicle_width_m=0.6).obstacles
    assert (
        np.abs(o.center[:, 2] + spec.flight_altitude_m) <= 0.5 * o.half_size[:, 2] + 1e-12
    ).all()


def test_the_height_of_a_goal_is_that_above_the_ground_below_it() -> None:
    above = 0
    for seed in range(12):
        spec = spec_of(goal={"min_distance_m": 12.0, "height_m": [1.5, 1.5]})
        arena = generate(spec, seed, name="x", vehicle_width_m=0.6)
        ground = ground_of(arena).height_at(*arena.goal.tolist())
        assert arena.goal_height_m == pytest.approx(1.5 + ground, abs=1e-12)
        assert arena.goal_height_m is not None
        assert arena.goal_point[2:] == (-arena.goal_height_m,)
        above += ground > 0.1
    assert above > 0


# --- paths


@pytest.mark.parametrize("seed", range(10))
def test_a_way_leads_past_hills_that_are_higher_than_the_flight(seed: int) -> None:
    # By Dijkstra on a coarse grid of the true surface, at the height of the flight.
    arena = arena_of(seed)
    ground, b, cell = ground_of(arena), arena.bounds, 0.2
    north = np.arange(b.north_min + cell, b.north_max, cell)
    east = np.arange(b.east_min + cell, b.east_max, cell)
    n, e = np.meshgrid(north, east, indexing="ij")
    free = reference(ground, n, e) < HILLS.flight_altitude_m - 0.5
    label, _ = scipy.ndimage.label(free)
    places = [(0.0, 0.0), arena.goal.tolist()]
    at = [label[np.abs(north - x).argmin(), np.abs(east - y).argmin()] for x, y in places]
    assert at[0] == at[1] != 0


def test_a_ridge_across_the_arena_is_in_the_way() -> None:
    bounds = replace(arena_of(0).bounds)
    ridge = np.zeros((46, 46))
    ridge[20:23] = 5.0
    step = 60.0 / 45.0
    none = Obstacles(np.zeros(0, np.int8), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))
    beyond, before = np.array([40.0, 3.0]), np.array([15.0, 3.0])

    def way(heights: Floats, goal: Floats, most_m: float = 2.0) -> bool:
        ground = Ground(heights, bounds.north_min, bounds.east_min, step, step)
        return raster_passage(bounds, none, goal, 0.6, Hills(ground, most_m))

    assert way(ridge, before)
    assert not way(ridge, beyond)
    assert way(ridge, beyond, most_m=6.0)
    # A gap of 4 m is wide enough. A gap of 0 m at its foot and 1.3 m at the height is not.
    gap = ridge.copy()
    gap[20:23, 30:34] = 0.0
    assert way(gap, beyond)
    narrow = ridge.copy()
    narrow[20:23, 30:31] = 0.0
    assert not way(narrow, beyond)


# --- cameras


def pose_in(rng: np.random.Generator, arena: Arena) -> tuple[Floats, Floats]:
    b = arena.bounds
    at = rng.uniform([b.north_min, b.east_min], [b.north_max, b.east_max])
    above = ground_of(arena).height_at(*at) + rng.uniform(0.05, 6.0)
    roll, pitch = rng.normal(0.0, 0.3, 2)
    return np.array([*at, -above]), quat_from_euler(roll, pitch - 0.2, rng.uniform(-np.pi, np.pi))


@pytest.mark.timeout(600)  # Compiles kernels, on a busy machine for minutes.
@pytest.mark.parametrize("projection", AT_NIGHT_THE_FISHEYE)
def test_depth_of_hills_is_that_of_rays_in_float64(projection: Projection) -> None:
    rng = np.random.default_rng(4)
    pixels = 0
    for view in range(10):
        arena = bare(arena_of(view % 3))
        widest = math.tau if projection == "cylindrical" else 3.2
        fov = rng.uniform(0.6, 2.4) if projection == "pinhole" else widest
        k = Intrinsics.from_fov(25, 19, fov, projection)
        pose = pose_in(rng, arena)
        seen = render(arena, arena.obstacles.center, k, math.inf, *pose).astype(np.float64)
        flat = replace(arena, ground=None)
        room = render(flat, flat.obstacles.center, k, math.inf, *pose).astype(np.float64)
        ground, rays = ground_of(arena), rays_of(k, pose[1])
        corners = ground.points[ground.faces]
        hits = nearest(np.broadcast_to(pose[0], rays.shape), rays, corners).reshape(seen.shape)
        both = np.minimum(np.where(room > 0.0, room, math.inf), hits)
        expected = np.where(np.isfinite(both), np.maximum(both, 0.001), 0.0)
        # Triangles are kept in float32, to some 2e-6 m: far away rays graze them.
        assert (np.abs(seen - expected) <= 1e-4 + 1e-4 * expected).mean() > 0.998, f"view {view}"
        pixels += int((hits < np.where(room > 0.0, room, math.inf)).sum())
    assert pixels > 500


def test_a_camera_below_the_ground_is_raised_above_it() -> None:
    arena = bare(arena_of(3))
    ground = ground_of(arena)
    top = np.unravel_index(ground.heights[5:-5, 5:-5].argmax(), ground.heights[5:-5, 5:-5].shape)
    north = ground.south + ground.step_north * (5 + top[0]) + 0.1
    east = ground.west + ground.step_east * (5 + top[1]) + 0.2
    k = Intrinsics.from_fov(3, 3, 0.1)
    down = quat_from_euler(0.0, -0.5 * math.pi, 0.0)
    for sunk in (0.0, 0.02, 0.5):
        at = np.array([north, east, sunk - ground.height_at(north, east)])
        image = render(arena, arena.obstacles.center, k, 10.0, at, down)
        np.testing.assert_allclose(image, 0.001, rtol=0.2)


def test_meshes_on_hills_stand_as_high_as_their_place(tmp_path: Path) -> None:
    file = kept(triangles(ring()), tmp_path / "ring.npz")
    arena, rng, pixels = bare(arena_of(3)), np.random.default_rng(6), 0
    ground = ground_of(arena)
    places = [(8.0, -3.0, 0.4, 1.5), (16.0, 6.0, -1.0, 2.0), (20.0, -18.0, 2.0, 1.0)]
    scene = scene_of(file, places)
    boxes = Boxes(np.array(places)[:, :2], np.full((3, 2), 0.5))
    standing, meshes = stand_on(ground, scene.obstacles, boxes, None, scene.meshes)
    lifts = [ground.lowest_within(north, east, math.hypot(0.5, 0.5)) for north, east, *_ in places]
    assert [mesh.base_m for mesh in meshes] == lifts
    assert max(lifts) > 0.3
    np.testing.assert_allclose(-standing.center[:, 2], np.array(lifts) + 0.5)
    arena = replace(arena, obstacles=standing, meshes=meshes)
    corners = np.concatenate([ground.points[ground.faces], in_world(scene)])
    for number, lift in enumerate(lifts):
        corners[len(ground.faces) + 768 * number :][:768, :, 2] -= lift
    flat = bare(replace(arena, ground=None))
    for _ in range(4):
        k = Intrinsics.from_fov(25, 19, 1.4)
        at = np.array([*rng.uniform([2.0, -8.0], [9.0, 2.0]), -rng.uniform(2.0, 4.0)])
        attitude = quat_from_euler(0.0, -0.1, rng.uniform(-0.6, 0.6))
        seen = render(arena, arena.obstacles.center, k, math.inf, at, attitude).astype(np.float64)
        room = render(flat, flat.obstacles.center, k, math.inf, at, attitude).astype(np.float64)
        rays = rays_of(k, attitude)
        hits = nearest(np.broadcast_to(at, rays.shape), rays, corners).reshape(seen.shape)
        both = np.minimum(np.where(room > 0.0, room, math.inf), hits)
        expected = np.where(np.isfinite(both), both, 0.0)
        assert (np.abs(seen - expected) <= 1e-4 + 1e-4 * expected).mean() > 0.998
        alone = nearest(np.broadcast_to(at, rays.shape), rays, corners[len(ground.faces) :])
        pixels += int((np.abs(alone.reshape(seen.shape) - seen) < 1e-3).sum())
    assert pixels > 20


@pytest.mark.nightly
def test_hills_are_ground_and_look_like_the_floor() -> None:
    arena = arena_of(3)
    k = Intrinsics.from_fov(120, 90, 1.4, kind="rgb")
    pose = np.array([0.0, 0.0, -3.0]), quat_from_euler(0.0, -0.05, 0.0)
    picture = render_picture(arena, arena.obstacles.center, k, *pose)
    depth = render(arena, arena.obstacles.center, replace(k, kind="depth"), math.inf, *pose)
    np.testing.assert_allclose(picture.depth_m, depth, atol=1e-6)
    flat = render_picture(replace(arena, ground=None), arena.obstacles.center, k, *pose)
    hill = (picture.seen == FLOOR) & (flat.seen != FLOOR)
    assert hill.sum() > 100
    assert set(np.unique(picture.seen)) <= {SKY, FLOOR, 2, 3, *range(OBSTACLE, 200)}
    # Grass is green in the sun.
    red, green, blue = picture.rgb[hill].mean(axis=0)
    assert green > red > blue


@pytest.mark.nightly
def test_the_pattern_of_the_floor_goes_on_over_ground_that_hardly_rises() -> None:
    arena = bare(arena_of(3))
    ground = ground_of(arena)
    low = replace(ground, heights=1e-5 * ground.heights)
    k = Intrinsics.from_fov(96, 72, 1.4, kind="rgb")
    pose = np.array([0.0, 0.0, -3.0]), quat_from_euler(0.0, -0.4, 0.0)
    one = render_picture(replace(arena, ground=None), arena.obstacles.center, k, *pose)
    other = render_picture(replace(arena, ground=low), arena.obstacles.center, k, *pose)
    np.testing.assert_array_equal(one.seen, other.seen)
    same = np.abs(one.rgb.astype(int) - other.rgb).max(axis=2) <= 2
    assert same[one.seen == FLOOR].mean() > 0.99


@pytest.mark.nightly
def test_hills_throw_shadows_on_themselves_and_on_the_floor() -> None:
    sun = {"elevation_deg": [25, 25], "azimuth_deg": [90, 90], "irradiance": [0.8, 0.8]}
    spec = spec_of(appearance={"sun": sun, "floor": {"materials": ["plaster"]}})
    arena = bare(generate(spec, 3, name="x", vehicle_width_m=0.6))
    ground, to_sun = ground_of(arena), arena.look.light.to_sun
    k = Intrinsics.from_fov(80, 60, 1.5, kind="rgb")
    pose = np.array([24.0, 0.0, -30.0]), quat_from_euler(0.0, -0.5 * math.pi, 0.0)
    picture = render_picture(arena, arena.obstacles.center, k, *pose)
    rays = rays_of(k, pose[1])
    points = pose[0] + picture.depth_m.reshape(-1, 1) * rays
    corners = ground.points[ground.faces]
    hidden = np.isfinite(
        nearest(points + 2e-3 * to_sun, np.broadcast_to(to_sun, rays.shape), corners, 1e-3)
    )
    floor = picture.seen.ravel() == FLOOR
    light = picture.rgb.reshape(-1, 3)[:, 1].astype(float)
    level = floor & (np.abs(points[:, 2]) < 1e-4)
    assert (hidden & floor).sum() > 100
    # Level ground has one light in the sun, and another in the shade, without hills that of walls.
    flat = render_picture(replace(arena, ground=None), arena.obstacles.center, k, *pose)
    sunny = flat.rgb.reshape(-1, 3)[:, 1] > 0.9 * flat.rgb[..., 1].max()
    shade, lit = level & hidden & sunny, level & ~hidden & sunny
    assert min(shade.sum(), lit.sum()) > 5
    assert light[shade].max() < 0.9 * light[lit].min()


# --- contact


def test_a_disc_touches_the_ground_where_it_is_highest_below_it() -> None:
    arena = arena_of(3)
    ground, b = ground_of(arena), arena.bounds.as_array()
    none = np.zeros(0, np.int8), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0)
    rng = np.random.default_rng(8)
    radius, half_height = 0.3, 0.1
    turn, share = np.meshgrid(np.linspace(0.0, math.tau, 181), np.linspace(0.0, 1.0, 30))
    for _ in range(60):
        north, east = rng.uniform(b[0] + 1.0, b[1] - 1.0), rng.uniform(b[2] + 1.0, b[3] - 1.0)
        below = reference(
            ground,
            (north + radius * share * np.cos(turn)).ravel(),
            (east + radius * share * np.sin(turn)).ravel(),
        ).max()
        for gap, expected in ((0.01, NOTHING), (-0.01, TOUCHED_FLOOR)):
            at = (north, east, -(below + half_height + gap))
            assert touches(at, radius, half_height, b, 0, *none, ground.relief) == expected


def test_nothing_is_touched_within_the_clearance_over_hills() -> None:
    arena = bare(arena_of(3))
    ground, b = ground_of(arena), arena.bounds.as_array()
    none = np.zeros(0, np.int8), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0)
    rng = np.random.default_rng(9)
    radius, half_height, near = 0.3, 0.1, 0
    for _ in range(300):
        here = rng.uniform([b[0] - 2.0, b[2] - 2.0, -12.0], [b[1] + 2.0, b[3] + 2.0, -0.2])
        room = clearance(tuple(here), radius, half_height, b, 0, none[1], none[2], ground.relief)
        if room <= 0.0:
            continue
        for _ in range(20):
            way = rng.normal(size=3)
            there = here + 0.999 * room * way / np.linalg.norm(way)
            assert touches(tuple(there), radius, half_height, b, 0, *none, ground.relief) == NOTHING
        # It is not far too little either: straight below it the ground is not much farther.
        height = -here[2] - half_height
        inside = b[0] < here[0] < b[1] and b[2] < here[1] < b[3]
        near += inside and room > 0.3 * (height - ground.top_m)
    assert near > 100


# --- rejected input


@pytest.mark.parametrize(
    ("tables", "told"),
    [
        ({"terrain": {"relief_m": [0.0, 4.0]}}, "terrain.relief_m = [0.0, 4.0]: accepted: 0.2"),
        ({"terrain": {"relief_m": [4.0, 14.0]}}, "terrain.relief_m = [4.0, 14.0]: accepted: 0.2"),
        (
            {"terrain": {"relief_m": [9.5, 9.5]}},
            "static.height_m = [3.0, 5.0]: accepted: value <= 4.5 m (size.height_m 14, the walls,",
        ),
        (
            {"terrain": {"relief_m": [4.0, 5.0], "flat_m": 60.0}},
            "terrain.flat_m = 60: accepted: value <= 48.5 m",
        ),
        ({"gates": {"count": [1, 1]}}, "accepted: [0, 0] with gates"),
        ({"rooms": {"count": [2, 2]}}, "accepted: [0, 0] with rooms"),
        ({"moving": {"count": [1, 1]}}, "accepted: [0, 0] with moving obstacles"),
        ({"generator": "own.py:make"}, "accepted: [0, 0] with a generator of your own"),
        (
            {"size": {"north_m": 60.0, "east_m": 60.0, "height_m": 14.0, "ceiling": True}},
            "accepted: [0, 0] with a ceiling",
        ),
        (
            {"goal": {"min_distance_m": 12.0, "height_m": [1.0, 7.0]}},
            "goal.height_m = [1.0, 7.0]: accepted: value <= 6 m",
        ),
        (
            {
                "size": {"north_m": 500.0, "east_m": 500.0, "height_m": 14.0},
                "terrain": {"relief_m": [5.0, 8.0], "scale_m": 16.0},
            },
            "terrain.scale_m = 16: accepted: value >= 19.5 m on a floor of 500 x 500 m",
        ),
    ],
)
def test_what_does_not_go_together_is_refused_in_one_line(
    tables: dict[str, Any], told: str
) -> None:
    with pytest.raises(ValueError, match="accepted") as error:
        spec_of(**tables)
    assert told in str(error.value)


def test_a_large_arena_has_hills_of_a_bounded_number_of_cells() -> None:
    spec = spec_of(
        size={"north_m": 500.0, "east_m": 500.0, "height_m": 40.0},
        terrain={"relief_m": [20.0, 20.0], "scale_m": 60.0},
    )
    ground = ground_of(generate(spec, 1, name="x", vehicle_width_m=0.6))
    rows, columns = ground.heights.shape
    assert (rows - 1) * (columns - 1) <= MOST_CELLS
    assert ground.top_m == pytest.approx(20.0)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"heights": np.zeros((1, 5))}, "ground.heights (1, 5); accepted: two or more each way"),
        ({"heights": np.full((3, 3), -0.1)}, "none below 0"),
        ({"heights": np.full((3, 3), math.inf)}, "accepted: finite heights"),
        ({"step_east": 0.0}, "steps > 0"),
    ],
)
def test_ground_of_a_generator_of_one_s_own_is_looked_at(change: dict[str, Any], told: str) -> None:
    arena = arena_of(3)
    assert _problem(arena) is None
    problem = _problem(replace(arena, ground=replace(ground_of(arena), **change)))
    assert problem is not None
    assert told in problem


def test_a_profile_without_hills_is_what_it_was() -> None:
    spec = load_profile("arenas", "static-obstacles", ArenaSpec)
    assert "terrain" not in spec.model_dump()
    assert "terrain" in HILLS.model_dump()
    assert ArenaSpec.model_validate(HILLS.model_dump()) == HILLS
