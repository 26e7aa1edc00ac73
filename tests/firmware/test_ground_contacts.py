"""The vehicle's box on hills: both plants beside each other, and beside the surface itself."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pybullet
import pytest
from matplotlib.tri import LinearTriInterpolator, Triangulation
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from airl_mav.arena.generate import generate
from airl_mav.arena.geometry import Arena, Ground, Obstacles
from airl_mav.core.constants import TICK_S
from airl_mav.envs.arena_batch import NOTHING, touches
from airl_mav.profiles.arena import ArenaSpec
from airl_mav.profiles.loading import load_profile
from firmware_sim.addons.auxiliary_estimation.simulated_sensors import PlantRangefinder
from firmware_sim.addons.kernel_plant.convex import MOST, ROW
from firmware_sim.addons.kernel_plant.ground_contact import near_ground, touch_ground
from firmware_sim.interfaces import ActuatorControls
from firmware_sim.plant.body import BREAKING_SHARE
from firmware_sim.plant.bullet_body import BulletWorld
from firmware_sim.plant.plant import Plant
from firmware_sim.plant.sensors import Site
from tests.firmware.test_kernel_body import HALF, HEIGHT, both
from tests.firmware.test_rangefinder_plant import QUIET
from tests.firmware.test_world import OFF

Floats = NDArray[np.float64]

RADIUS = float(np.linalg.norm(HALF))
CLOSE = BREAKING_SHARE * RADIUS


@cache
def hills(seed: int = 3) -> Arena:
    """Return hills without obstacles."""
    spec = load_profile("arenas", "hills", ArenaSpec)
    arena = generate(spec, seed, name="hills", vehicle_width_m=0.6)
    o = arena.obstacles
    none = Obstacles(o.shape[:0], o.center[:0], o.half_size[:0], o.yaw[:0])
    return replace(arena, obstacles=none, statics=None)


def ground_of(arena: Arena) -> Ground:
    assert arena.ground is not None
    return arena.ground


@cache
def surface() -> LinearTriInterpolator:
    """Return the same triangles as matplotlib knows them."""
    ground = ground_of(hills())
    points = ground.points
    return LinearTriInterpolator(
        Triangulation(points[:, 0], points[:, 1], ground.faces), -points[:, 2]
    )


def places(seed: int, n: int, *, steepest: float = math.inf) -> list[tuple[float, float]]:
    """Draw places on hills, no steeper anywhere around."""
    arena, rng = hills(), np.random.default_rng(seed)
    b, found = arena.bounds, list[tuple[float, float]]()
    while len(found) < n:
        north = float(rng.uniform(b.north_min + 1.0, b.north_max - 1.0))
        east = float(rng.uniform(b.east_min + 1.0, b.east_max - 1.0))
        around = north + rng.uniform(-0.5, 0.5, 40), east + rng.uniform(-0.5, 0.5, 40)
        heights = surface()(*around)
        slopes = np.hypot(*(part.filled(0.0) for part in surface().gradient(*around)))
        if not heights.mask.any() and heights.min() > 0.1 and slopes.max() < steepest:
            found.append((north, east))
    return found


def touching_height(north: float, east: float, turn: Rotation) -> float:
    """Return the height of the box's centre at its first contact when lowered.

    Points on all faces of the box give the height to a millimetre.
    """
    grid = np.linspace(-1.0, 1.0, 161)
    u, v = (each.ravel() for each in np.meshgrid(grid, grid))
    most = -math.inf
    for axis in range(3):
        for side in (-1.0, 1.0):
            local = np.empty((len(u), 3))
            local[:, axis] = side
            local[:, (axis + 1) % 3], local[:, (axis + 2) % 3] = u, v
            at = turn.apply(local * HALF)
            below = surface()(north + at[:, 0], east + at[:, 1]).filled(0.0)
            most = max(most, float((below + at[:, 2]).max()))
    return most


def attitude(rng: np.random.Generator, tilt: float) -> Rotation:
    return Rotation.from_euler("ZYX", [rng.uniform(-3.0, 3.0), *rng.normal(0.0, tilt, 2)])


def wxyz(turn: Rotation) -> tuple[float, float, float, float]:
    x, y, z, w = turn.as_quat().tolist()
    return (w, x, y, z)


@pytest.mark.timeout(600)  # compiles kernels, on a busy machine for minutes
def test_the_kernel_s_box_touches_hills_where_their_surface_says() -> None:
    arena, rng = hills(), np.random.default_rng(1)
    relief = ground_of(arena).relief
    for north, east in places(2, 40):
        turn = attitude(rng, 0.15)
        height = touching_height(north, east, turn)
        for gap, touched in ((0.003, False), (-0.003, True)):
            p, rows = (north, east, -height - gap), np.zeros((MOST, ROW))
            count = touch_ground(p, wxyz(turn), HALF, CLOSE, relief, rows, 0)
            assert (rows[:count, 6] < 0.0).any() == touched
            assert near_ground(relief, p, RADIUS, CLOSE)
            # Contacts push upwards, from a point of the box.
            np.testing.assert_allclose(np.linalg.norm(rows[:count, 3:6], axis=1), 1.0)
            assert (rows[:count, 5] < 0.0).all()
            own = turn.inv().apply(rows[:count, :3])
            assert (np.abs(own) <= HALF + CLOSE + 1e-9).all()


def test_pybullet_s_box_touches_hills_where_their_surface_says() -> None:
    arena, rng = hills(), np.random.default_rng(1)
    world = BulletWorld(arena, RADIUS)
    client = world.client
    shape = client.createCollisionShape(pybullet.GEOM_BOX, halfExtents=HALF.tolist())
    box = client.createMultiBody(1.0, shape)
    for north, east in places(3, 25):
        turn = attitude(rng, 0.15)
        height = touching_height(north, east, turn)
        # NED axes of the body as ENU ones: the same box, for it is as wide as it is long.
        swap = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
        enu = Rotation.from_matrix(swap @ turn.as_matrix() @ swap.T).as_quat().tolist()
        for gap, touched in ((0.004, False), (-0.004, True)):
            client.resetBasePositionAndOrientation(box, (east, north, height + gap), enu)
            client.performCollisionDetection()
            depths = [contact[8] for contact in client.getContactPoints(box)]
            assert any(depth < 0.0 for depth in depths) == touched
    world.close()


def test_the_twin_s_disc_touches_before_the_box_by_no_more_than_the_slope_makes_of_it() -> None:
    arena = hills()
    relief, b = ground_of(arena).relief, arena.bounds.as_array()
    none = np.zeros(0, np.int8), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0)
    radius, differences = float(HALF[0]), []
    for north, east in places(4, 30):
        box = touching_height(north, east, Rotation.identity())
        low, high = box - 0.5, box + 0.5
        while high - low > 1e-5:
            middle = 0.5 * (low + high)
            at = (north, east, -middle)
            hit = touches(at, radius, float(HALF[2]), b, 0, *none, relief) != NOTHING
            low, high = (middle, high) if hit else (low, middle)
        # The disc lies within the level box: it touches later, by at most the corner that it lacks.
        slope = np.hypot(*(part.filled(0.0) for part in surface().gradient([north], [east])))
        assert -1e-3 <= box - low <= 0.415 * radius * (slope[0] + 0.35)
        differences.append(box - low)
    assert np.mean(differences) < 0.05


@pytest.mark.timeout(600)
def test_both_plants_land_on_a_gentle_slope_and_stay_there() -> None:
    arena = hills()
    for north, east in places(5, 6, steepest=0.35):
        start = touching_height(north, east, Rotation.identity())
        with both(arena) as plants:
            for plant in plants:
                plant.put((north, east, -start - 0.05), (0.0, 0.0, 0.3))
            first = [0, 0]
            for tick in range(750):
                for k, plant in enumerate(plants):
                    plant.step(OFF)
                    if plant.collisions and not first[k]:
                        first[k] = tick
            rests = [plant.motion.copy() for plant in plants]
            assert {hit.what for plant in plants for hit in plant.collisions} == {"floor"}
            # It came down at the same moment.
            assert abs(first[0] - first[1]) <= 2
            for plant, row in zip(plants, rests, strict=True):
                turn = Rotation.from_quat(row[[7, 8, 9, 6]])
                # On the ground, not in it, near where it came down.
                rest = touching_height(float(row[0]), float(row[1]), turn)
                assert -row[2] == pytest.approx(rest, abs=0.01)
                assert math.hypot(row[0] - north, row[1] - east) < 0.25
                for _ in range(500):
                    plant.step(OFF)
                assert np.linalg.norm(plant.motion[:3] - row[:3]) < 0.01
                assert np.linalg.norm(plant.motion[3:6]) < 0.05
            assert np.abs(rests[0][:3] - rests[1][:3]).max() < 0.05


def test_neither_plant_flies_through_a_hill() -> None:
    arena = hills()
    ground = ground_of(arena)
    inner = ground.heights[8:-8, 8:-8]
    top = np.unravel_index(inner.argmax(), inner.shape)
    north = ground.south + ground.step_north * (8 + top[0])
    east = ground.west + ground.step_east * (8 + top[1])
    with both(arena) as plants:
        for plant in plants:
            hits = list[tuple[float, float]]()
            for way in np.linspace(0.0, math.tau, 5)[:-1]:
                at = north - 9.0 * math.cos(way), east - 9.0 * math.sin(way)
                b = arena.bounds
                inside = b.north_min + 1 < at[0] < b.north_max - 1
                if not (inside and b.east_min + 1 < at[1] < b.east_max - 1):
                    continue
                plant.put(
                    (*at, -0.6 * inner.max()), (8.0 * math.cos(way), 8.0 * math.sin(way), -1.0)
                )
                for _ in range(300):
                    plant.step(OFF)
                    row = plant.motion
                    assert -row[2] > ground.height_at(float(row[0]), float(row[1])) - 0.05
                assert plant.collisions[0].what == "floor"
                hits.append((row[0], row[1]))
            assert len(hits) >= 2


def test_on_the_level_ground_around_the_start_it_moves_as_without_hills() -> None:
    arena = hills()
    for name in ("pybullet", "kernel"):
        rows = []
        for place in (arena, replace(arena, ground=None)):
            with both(place) as plants:
                plant = plants[("pybullet", "kernel").index(name)]
                for motors in ((0.0,) * 4, (0.2, 0.25, 0.1, 0.12), (0.8,) * 4):
                    for _ in range(100):
                        plant.step(ActuatorControls(plant.time_us, motors, True))
                rows.append(plant.motion)
        np.testing.assert_array_equal(rows[0], rows[1])


@pytest.mark.nightly
def test_a_rangefinder_sees_hills_as_pybullet_s_rays_do() -> None:
    arena, rng = hills(), np.random.default_rng(3)
    finder = PlantRangefinder(QUIET, Site(arena, rng, 1.0, TICK_S))
    world = BulletWorld(arena, RADIUS)
    offset = np.array([QUIET.forward_m, QUIET.right_m, QUIET.down_m])
    for north, east in places(6, 40):
        turn = attitude(rng, 0.2)
        height = touching_height(north, east, turn) + rng.uniform(0.0, 5.0)
        at = np.array([north, east, -height])
        told = finder.ray.length_m(at, np.array(wxyz(turn)), 0)
        begin = at + turn.apply(offset)
        end = begin + QUIET.greatest_m * turn.apply([0.0, 0.0, 1.0])
        (hit,) = world.client.rayTestBatch(
            [(begin[1], begin[0], -begin[2])], [(end[1], end[0], -end[2])]
        )
        if hit[0] < 0:
            assert told is None
        else:
            assert told is not None
            assert told == pytest.approx(hit[2] * QUIET.greatest_m, abs=2e-3)
    world.close()


def test_a_rangefinder_on_a_slope_reads_its_height_above_it() -> None:
    arena = hills()
    for north, east in places(7, 3, steepest=0.25):
        finder = PlantRangefinder(QUIET, Site(arena, np.random.default_rng(0), 1.0, TICK_S))
        start = touching_height(north, east, Rotation.identity())
        with both(arena) as plants:
            for plant in plants:
                plant.put((north, east, -start - 0.01))
                for _ in range(400):
                    plant.step(OFF)
                told = finder.ray.length_m(plant.motion[:3], plant.motion[6:10], 0)
                assert told is not None
                assert told < HEIGHT + 0.05


def test_the_plants_have_the_rest_of_the_arena_as_well() -> None:
    spec = load_profile("arenas", "hills", ArenaSpec)
    arena = generate(spec, 3, name="hills", vehicle_width_m=0.6)
    with both(arena) as plants:
        for plant in plants:
            assert isinstance(plant, Plant)
            names = set(plant.body.names.values())
            assert {"floor", "wall-north"} < names
            assert sum(name.startswith("static-") for name in names) == len(arena.obstacles)
