"""Fleet camera: pixel-identical to the rehearsal's camera at the same poses."""

from __future__ import annotations

import math

import numpy as np
import pytest

from airl_mav.arena.generate import generate
from airl_mav.arena.geometry import Arena
from airl_mav.camera.frame import depth_to_z16
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.camera.projection import LensConstants, lens_of
from airl_mav.camera.render import Mount, camera_pose, render
from airl_mav.core.frames import quat_from_euler
from airl_mav.envs.arena_batch import batch_of
from airl_mav.envs.cameras import Eye, render_images
from airl_mav.envs.fleet import FramePoses
from airl_mav.profiles.arena import ArenaSpec
from airl_mav.profiles.loading import load_profile
from airl_mav.profiles.vehicle import load_vehicle
from tests.support.lenses import OPENING
from tests.support.poses import at_rest

N = 12
CAMERA = Intrinsics.from_fov(64, 48, math.radians(87.0))
PANORAMA = Intrinsics.of(load_vehicle("quad-panorama").camera)
FISHEYE = Intrinsics.from_fov(64, 48, math.radians(170.0), "fisheye")
BENT = Intrinsics.from_fov(64, 48, math.radians(170.0), "fisheye", distortion=OPENING)
MOUNT = Mount((0.12, 0.03, -0.02), math.radians(8.0))


@pytest.fixture(params=["static-obstacles", "dynamic-obstacles"])
def worlds(request: pytest.FixtureRequest) -> list[Arena]:
    spec = load_profile("arenas", request.param, ArenaSpec)
    return [generate(spec, seed, name="view", vehicle_width_m=0.55) for seed in range(N)]


def scattered(rng: np.random.Generator) -> FramePoses:
    """Vehicles anywhere in the room, tilted, at any time."""
    fleet = at_rest(N)
    fleet.position[:] = rng.uniform([-20, -20, -4.5], [20, 20, -0.5], (N, 3))
    for i in range(N):
        roll, pitch = rng.normal(0.0, 0.3, 2)
        fleet.quaternion[i] = quat_from_euler(roll, pitch, rng.uniform(-math.pi, math.pi))
    fleet.time_us[:] = 4_000 * rng.integers(0, 50_000, N)
    return fleet


def expected(
    world: Arena, fleet: FramePoses, i: int, range_m: float, camera: Intrinsics = CAMERA
) -> np.ndarray:
    pose = camera_pose(fleet.position[i], fleet.quaternion[i], MOUNT)
    centers = world.centers_at(int(fleet.time_us[i]))
    return depth_to_z16(render(world, centers, camera, range_m, *pose))


CAMERAS = {"pinhole": CAMERA, "cylindrical": PANORAMA, "fisheye": FISHEYE, "distorted": BENT}


@pytest.mark.parametrize("name", CAMERAS)
def test_the_twins_lens_has_the_rays_of_the_rehearsals(name: str) -> None:
    camera = CAMERAS[name]
    lens, model = lens_of(camera, 20.0), camera.model
    assert lens[:5] == (camera.focal, camera.cx, camera.cy, 20.0, model.cylindrical)
    assert (lens.bent is None) == (not model.tabled) == (camera.projection != "fisheye")
    if lens.bent is not None:
        forward, right, down = camera.rays
        for ours, theirs in zip(lens.bent, (forward, down, right), strict=False):
            np.testing.assert_array_equal(ours, theirs)


@pytest.mark.parametrize(
    "camera",
    [
        CAMERA,
        PANORAMA,
        # Their rays are looked at above; the twin with them is compiled for long.
        pytest.param(FISHEYE, marks=pytest.mark.nightly),
        pytest.param(BENT, marks=pytest.mark.nightly),
    ],
    ids=list(CAMERAS),
)
@pytest.mark.parametrize("range_m", [6.0, 20.0, 100.0])
def test_sees_what_the_rehearsal_s_camera_sees(
    worlds: list[Arena], range_m: float, camera: Intrinsics
) -> None:
    fleet, arenas = scattered(np.random.default_rng(1)), batch_of(worlds)
    out = np.full((N, camera.height, camera.width), 7, np.uint16)
    render_images(
        fleet, arenas, np.ones(N, np.bool_), Eye(MOUNT, lens_of(camera, range_m), out, None)
    )
    for i, world in enumerate(worlds):
        assert np.array_equal(out[i], expected(world, fleet, i, range_m, camera))
    assert len(np.unique(out)) > 1000  # it is a picture


def test_only_those_that_look_get_an_image(worlds: list[Arena]) -> None:
    fleet, arenas = scattered(np.random.default_rng(2)), batch_of(worlds)
    out = np.full((N, 48, 64), 7, np.uint16)
    who = np.arange(N) % 3 == 1
    render_images(fleet, arenas, who, Eye(MOUNT, lens_of(CAMERA, 20.0), out, None))
    for i, world in enumerate(worlds):
        image = expected(world, fleet, i, 20.0) if who[i] else np.full((48, 64), 7)
        assert np.array_equal(out[i], image)


def test_obstacles_are_seen_where_they_are_at_the_vehicle_s_time() -> None:
    spec = load_profile("arenas", "dynamic-obstacles", ArenaSpec)
    world = generate(spec, 3, name="view", vehicle_width_m=0.55)
    fleet, arenas, out = at_rest(1), batch_of([world]), np.zeros((1, 48, 64), np.uint16)
    fleet.position[0, 2] = -2.0
    seen = []
    for time_us in (0, 1_500_000, 0, 90_000_000):
        fleet.time_us[0] = time_us
        for i in range(4):
            fleet.quaternion[0] = quat_from_euler(0.0, 0.0, 0.5 * math.pi * i)
            one = np.ones(1, np.bool_)
            render_images(fleet, arenas, one, Eye(MOUNT, lens_of(CAMERA, 40.0), out, None))
            assert np.array_equal(out[0], expected(world, fleet, 0, 40.0))
            seen.append(out.copy())
    assert np.array_equal(seen[:4], seen[8:12])
    assert not np.array_equal(seen[:4], seen[4:8])


def test_depth_beyond_16_bits_is_clipped() -> None:
    """A wall 90 m ahead: 65,535 mm, as in a frame of the rehearsal."""
    spec = load_profile("arenas", "no-obstacles", ArenaSpec)
    world = generate(spec, 1, name="view", vehicle_width_m=0.55)
    fleet, arenas = at_rest(1), batch_of([world])
    arenas.bounds[0] = [-100.0, 100.0, -100.0, 100.0, 50.0, 0.0]
    fleet.position[0] = [0.0, 0.0, -20.0]
    out = np.zeros((1, 9, 9), np.uint16)
    eye = Eye(Mount((10.0, 0.0, 0.0), 0.0), LensConstants(40.0, 4.0, 4.0, 200.0), out, None)
    render_images(fleet, arenas, np.ones(1, np.bool_), eye)
    assert np.all(out == 65_535)
    eye = Eye(Mount((40.0, 0.0, 0.0), 0.0), LensConstants(40.0, 4.0, 4.0, 200.0), out, None)
    render_images(fleet, arenas, np.ones(1, np.bool_), eye)
    assert out[0, 4, 4] == 60_000
