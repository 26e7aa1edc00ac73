"""Hills in the batch twin: images bit for bit those of the rehearsal, contacts, and the planner."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from airl_mav.addons.colour.batch import ColourImages, Looks
from airl_mav.addons.colour.picture import render_picture
from airl_mav.addons.imitation.imitation import StatefulExpert
from airl_mav.addons.imitation.planner import OVER_M, PlannerBody, map_of
from airl_mav.arena.generate import generate
from airl_mav.arena.geometry import Arena
from airl_mav.camera.frame import depth_to_z16
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.camera.projection import lens_of
from airl_mav.camera.render import Mount, camera_pose, render
from airl_mav.core.frames import quat_from_euler
from airl_mav.envs.arena_batch import batch_of, put_arena, relief_of, with_room
from airl_mav.envs.cameras import Eye, render_images
from airl_mav.envs.fleet import FlightStatus, FramePoses
from airl_mav.envs.mesh_batch import MeshesSeen
from airl_mav.envs.navigation import Navigation
from airl_mav.envs.spec import EnvironmentSpec
from airl_mav.policy.actions import commands
from airl_mav.profiles.arena import ArenaSpec
from airl_mav.profiles.loading import load_profile
from tests.support.poses import at_rest

MOUNT = Mount((0.1, 0.0, 0.02), 0.1)
CAMERA = Intrinsics.from_fov(48, 32, 1.5)
RANGE_M = 25.0
SPEC = load_profile("arenas", "hills", ArenaSpec)


@pytest.fixture(scope="module")
def worlds() -> list[Arena]:
    """Hills of three seeds, hills on another grid, and a flat floor."""
    small = {"size": {"north_m": 40.0, "east_m": 30.0, "height_m": 14.0}}
    small |= {"start": {"north_m": 4.0, "east_m": 15.0}}
    other = ArenaSpec.model_validate(SPEC.model_dump() | small)
    plain = load_profile("arenas", "static-obstacles", ArenaSpec)
    return [
        *(generate(SPEC, seed, name="hills", vehicle_width_m=0.55) for seed in (1, 2, 3)),
        generate(other, 1, name="small", vehicle_width_m=0.55),
        generate(plain, 1, name="plain", vehicle_width_m=0.55),
    ]


def scattered(n: int, seed: int) -> FramePoses:
    rng = np.random.default_rng(seed)
    fleet = at_rest(n)
    fleet.position[:] = rng.uniform([0, -14, -6.0], [30, 14, -0.5], (n, 3))
    for i in range(n):
        roll, pitch = rng.normal(0.0, 0.2, 2)
        fleet.quaternion[i] = quat_from_euler(roll, pitch, rng.uniform(-math.pi, math.pi))
    return fleet


def images(worlds: list[Arena], seen: MeshesSeen, fleet: FramePoses) -> np.ndarray:
    n = len(worlds)
    out = np.zeros((n, CAMERA.height, CAMERA.width), np.uint16)
    lens = lens_of(CAMERA, RANGE_M)
    render_images(fleet, batch_of(worlds), np.ones(n, np.bool_), Eye(MOUNT, lens, out, seen.batch))
    return out


def own(world: Arena, fleet: FramePoses, i: int) -> np.ndarray:
    pose = camera_pose(fleet.position[i], fleet.quaternion[i], MOUNT)
    return depth_to_z16(render(world, world.centers_at(0), CAMERA, RANGE_M, *pose))


@pytest.mark.timeout(600)  # compiles kernels, on a busy machine for minutes
def test_depth_is_bit_for_bit_that_of_the_rehearsal_in_any_order(worlds: list[Arena]) -> None:
    seen = MeshesSeen(2)
    seen.put(0, worlds[-1])
    assert seen.batch is None  # nothing is allocated without terrain
    differ = 0
    for k, order in enumerate(((4, 0), (1, 2), (3, 4), (2, 3), (0, 1))):
        pair = [worlds[number] for number in order]
        for i, world in enumerate(pair):
            seen.put(i, world)
        fleet = scattered(2, k)
        out = images(pair, seen, fleet)
        for i, world in enumerate(pair):
            np.testing.assert_array_equal(out[i], own(world, fleet, i))
            flat = own(replace(world, ground=None), fleet, i)
            differ += int(np.count_nonzero(flat != out[i]))
    assert differ > 500
    again = MeshesSeen(2)
    for i, world in enumerate(pair):
        again.put(i, world)
    np.testing.assert_array_equal(images(pair, again, fleet), out)


# Depth, above, and colour in tests/unit/test_terrain.py are in every run.
@pytest.mark.nightly
@pytest.mark.timeout(600)  # compiles kernels, on a busy machine for minutes
def test_colour_is_bit_for_bit_that_of_the_rehearsal(worlds: list[Arena]) -> None:
    n = len(worlds)
    seen, looks = MeshesSeen(n), Looks(n)
    for i, world in enumerate(worlds):
        seen.put(i, world)
        looks.put(i, world)
    twin = ColourImages(replace(CAMERA, kind="rgb"), MOUNT, looks, seen)
    fleet = scattered(n, 9)
    out = np.zeros((n, CAMERA.height, CAMERA.width, 3), np.uint8)
    twin.render(fleet, batch_of(worlds), np.ones(n, np.bool_), out)
    for i, world in enumerate(worlds):
        pose = camera_pose(fleet.position[i], fleet.quaternion[i], MOUNT)
        picture = render_picture(world, world.centers_at(0), CAMERA, *pose)
        np.testing.assert_array_equal(out[i], picture.rgb)


def test_a_batch_has_the_ground_of_each_arena(worlds: list[Arena]) -> None:
    batch = batch_of(worlds[-1:] * 2)
    assert batch.heights.shape == (2, 0)
    for i, world in ((0, worlds[3]), (1, worlds[0]), (0, worlds[4])):
        try:
            put_arena(batch, i, world)
        except ValueError:
            batch = with_room(batch, world)
            put_arena(batch, i, world)
        relief = relief_of(batch, i)
        if world.ground is None:
            assert len(relief.heights) == 0
        else:
            np.testing.assert_array_equal(relief.heights, world.ground.heights.ravel())
            np.testing.assert_array_equal(relief.grid, world.ground.relief.grid)
    first = worlds[0].ground
    assert first is not None
    np.testing.assert_array_equal(relief_of(batch, 1).grid, first.relief.grid)


def test_on_the_planner_s_map_ground_at_the_height_of_the_flight_is_in_the_way(
    worlds: list[Arena],
) -> None:
    # Without obstacles: against the nearest of many points that are high.
    o = worlds[0].obstacles
    none = replace(o, shape=o.shape[:0], center=o.center[:0], half_size=o.half_size[:0])
    body = PlannerBody(0.275, 0.1, 2.5, 4.0, 3.0)
    for world in worlds[:3]:
        bare = replace(world, obstacles=replace(none, yaw=o.yaw[:0]), statics=None)
        assert bare.ground is not None
        known = map_of(batch_of([bare]), 0, body)
        open_map = map_of(batch_of([replace(bare, ground=None)]), 0, body)
        b, most = bare.bounds, body.altitude - body.half_height - OVER_M
        north = np.arange(b.north_min, b.north_max, 0.1)
        east = np.arange(b.east_min, b.east_max, 0.1)
        high = bare.ground.sampled(north, east) > most
        n, e = np.meshgrid(north, east, indexing="ij")
        tree = cKDTree(np.stack([n[high], e[high]], axis=1))
        rows, columns = known.gap.shape
        centres = np.stack(
            np.meshgrid(
                known.north + known.cell * np.arange(rows),
                known.east + known.cell * np.arange(columns),
                indexing="ij",
            ),
            axis=-1,
        )
        away, _ = tree.query(centres)
        outside = away > 2.0 * known.cell
        off = (known.gap - np.minimum(away, open_map.gap))[outside] / known.cell
        # The points are 0.1 m apart.
        assert -1.25 - 0.1 / known.cell < off.min() < off.max() < 0.25 + 0.1 / known.cell
        assert (known.gap[away < 0.05] <= 0.0).all()
        assert high.any()


@pytest.mark.nightly
@pytest.mark.timeout(600)  # compiles kernels, on a busy machine for minutes
def test_the_planner_reaches_its_goals_among_hills() -> None:
    spec = EnvironmentSpec.model_validate(
        {
            "arena": "hills",
            "actions": "velocity-fixed-yaw",
            "max_speed_m_s": 4.0,
            "episode": {"hold_s": 0.2},
        }
    )
    seeds = range(1, 11)
    navigation = Navigation(spec, len(seeds))
    expert = StatefulExpert("planner", navigation)
    navigation.begin(range(len(seeds)), seeds)
    expert.begin(range(len(seeds)))
    while (navigation.fleet.verdict == FlightStatus.FLYING).any():
        navigation.fly(commands(spec.action_spec, expert.decide()))
        for i in np.flatnonzero(navigation.fleet.verdict == FlightStatus.FLYING):
            arena = navigation.arenas[i]
            assert arena is not None
            assert arena.ground is not None
            north, east, down = navigation.fleet.position[i].tolist()
            assert -down > arena.ground.height_at(north, east)
    assert (navigation.fleet.verdict == FlightStatus.SUCCESS).all()
