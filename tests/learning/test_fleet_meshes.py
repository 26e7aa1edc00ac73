"""Meshes in the batch twin: bit for bit what the rehearsal's camera sees of them."""

from __future__ import annotations

import math

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from airl_mav.addons.colour.batch import ColourImages, Looks
from airl_mav.addons.colour.picture import render_picture
from airl_mav.arena.generate import generate
from airl_mav.arena.geometry import Arena
from airl_mav.camera.frame import depth_to_z16
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.camera.projection import lens_of
from airl_mav.camera.render import Mount, camera_pose, render
from airl_mav.core.frames import quat_from_euler
from airl_mav.envs.arena_batch import batch_of
from airl_mav.envs.cameras import Eye, render_images
from airl_mav.envs.fleet import FramePoses
from airl_mav.envs.mesh_batch import MeshesSeen
from airl_mav.profiles.arena import ArenaSpec
from airl_mav.profiles.loading import load_profile
from tests.support.command_line import airl
from tests.support.lenses import BARREL
from tests.support.poses import at_rest

MOUNT = Mount((0.1, 0.0, 0.02), 0.1)
CAMERA = Intrinsics.from_fov(48, 32, 1.5)
FISHEYE = Intrinsics.from_fov(48, 32, 2.8, "fisheye", distortion=BARREL)
RANGE_M = 25.0

PROFILE = """
base = "{base}"
[static]
count = [4, 12]
shapes = ["{first}", "{second}", "tree", "box"]
"""


@pytest.fixture(scope="module")
def worlds(tmp_path_factory: pytest.TempPathFactory) -> list[Arena]:
    """Return arenas of two meshes among shapes and assets; one arena has no mesh."""
    folder = tmp_path_factory.mktemp("meshes")
    torus = trimesh.creation.torus(0.8, 0.3, major_sections=24, minor_sections=10)
    torus.export(folder / "torus.stl")
    trimesh.creation.capsule(2.0, 0.5, count=(12, 12)).export(folder / "pill.stl")
    pill, both = folder / "pills.toml", folder / "both.toml"
    airl("asset", f"{folder}/pill.stl", "--out", f"{pill}", "--most", "8")
    airl("asset", f"{folder}/torus.stl", "--out", f"{both}", "--most", "12", "--arena", f"{pill}")
    mixed = folder / "mixed.toml"
    mixed.write_text(PROFILE.format(base=both, first="torus", second="pill"), encoding="utf-8")
    spec = load_profile("arenas", str(mixed), ArenaSpec)
    made = [generate(spec, seed, name="mixed", vehicle_width_m=0.55) for seed in range(5)]
    plain = load_profile("arenas", "static-obstacles", ArenaSpec)
    return [*made, generate(plain, 1, name="plain", vehicle_width_m=0.55)]


def seen_of(worlds: list[Arena]) -> MeshesSeen:
    seen = MeshesSeen(len(worlds))
    for i, world in enumerate(worlds):
        seen.put(i, world)
    return seen


def scattered(n: int) -> FramePoses:
    rng = np.random.default_rng(4)
    fleet = at_rest(n)
    fleet.position[:] = rng.uniform([0, -15, -4.0], [30, 15, -0.5], (n, 3))
    for i in range(n):
        roll, pitch = rng.normal(0.0, 0.2, 2)
        fleet.quaternion[i] = quat_from_euler(roll, pitch, rng.uniform(-math.pi, math.pi))
    return fleet


def mesh_pixels(world: Arena, seen: NDArray[np.int32]) -> int:
    return sum(int(np.count_nonzero(seen == 4 + mesh.first)) for mesh in world.meshes)


def test_the_worlds_have_meshes_of_both_kinds(worlds: list[Arena]) -> None:
    files = {mesh.file for world in worlds for mesh in world.meshes}
    assert len(files) == 2
    assert not worlds[-1].meshes
    assert any(len(world.meshes) < len(world.statics.names) for world in worlds if world.statics)


@pytest.mark.timeout(600)  # compiles kernels, on a busy machine for minutes
# The rays of the twin's fisheye: test_fleet_camera.py.
@pytest.mark.parametrize(
    "camera",
    [CAMERA, pytest.param(FISHEYE, marks=pytest.mark.nightly)],
    ids=["pinhole", "fisheye"],
)
def test_depth_is_bit_for_bit_that_of_the_rehearsal(
    worlds: list[Arena], camera: Intrinsics
) -> None:
    n = len(worlds)
    seen, arenas, differ = seen_of(worlds), batch_of(worlds), 0
    for _ in range(6):
        fleet = scattered(n)
        out = np.zeros((n, camera.height, camera.width), np.uint16)
        lens = lens_of(camera, RANGE_M)
        render_images(fleet, arenas, np.ones(n, np.bool_), Eye(MOUNT, lens, out, seen.batch))
        for i, world in enumerate(worlds):
            pose = camera_pose(fleet.position[i], fleet.quaternion[i], MOUNT)
            centers = world.centers_at(0)
            assert np.array_equal(
                out[i], depth_to_z16(render(world, centers, camera, RANGE_M, *pose))
            )
    boxes = np.zeros_like(out)
    render_images(fleet, arenas, np.ones(n, np.bool_), Eye(MOUNT, lens, boxes, None))
    differ = int(np.count_nonzero(boxes != out))
    assert differ > 100
    assert np.array_equal(boxes[-1], out[-1])


# Each half is seen in every run: the twin's meshes above, its colours without them in
# test_colour_flight.py, a mesh in colour in test_meshes_seen.py. Together they compile for minutes.
@pytest.mark.nightly
@pytest.mark.timeout(600)  # compiles kernels, on a busy machine for minutes
@pytest.mark.parametrize("camera", [CAMERA, FISHEYE], ids=["pinhole", "fisheye"])
def test_colour_is_bit_for_bit_that_of_the_rehearsal(
    worlds: list[Arena], camera: Intrinsics
) -> None:
    n = len(worlds)
    seen, looks, arenas = seen_of(worlds), Looks(n), batch_of(worlds)
    for i, world in enumerate(worlds):
        looks.put(i, world)
    twin = ColourImages(camera, MOUNT, looks, seen)
    fleet = scattered(n)
    out = np.zeros((n, camera.height, camera.width, 3), np.uint8)
    twin.render(fleet, arenas, np.ones(n, np.bool_), out)
    pixels = 0
    for i, world in enumerate(worlds):
        pose = camera_pose(fleet.position[i], fleet.quaternion[i], MOUNT)
        picture = render_picture(world, world.centers_at(0), camera, *pose)
        assert np.array_equal(out[i], picture.rgb)
        pixels += mesh_pixels(world, picture.seen)
    assert pixels > 50


def test_slots_take_new_arenas_in_any_order(worlds: list[Arena]) -> None:
    seen = MeshesSeen(2)
    seen.put(0, worlds[-1])
    assert seen.batch is None  # nothing is allocated without meshes
    for order in ((0, 1), (3, 2), (4, 5), (1, 0)):
        pair = [worlds[number] for number in order]
        for i, world in enumerate(pair):
            seen.put(i, world)
        fleet, arenas = scattered(2), batch_of(pair)
        out = np.zeros((2, CAMERA.height, CAMERA.width), np.uint16)
        lens = lens_of(CAMERA, RANGE_M)
        render_images(fleet, arenas, np.ones(2, np.bool_), Eye(MOUNT, lens, out, seen.batch))
        for i, world in enumerate(pair):
            pose = camera_pose(fleet.position[i], fleet.quaternion[i], MOUNT)
            expected = render(world, world.centers_at(0), CAMERA, RANGE_M, *pose)
            assert np.array_equal(out[i], depth_to_z16(expected))
