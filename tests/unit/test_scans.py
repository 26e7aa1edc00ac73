"""Level scans against closed forms: distances to upright cylinders, wherever the camera looks."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from numpy.typing import NDArray
from pydantic import ValidationError
from scipy.spatial.transform import Rotation
from stable_baselines3.common.preprocessing import is_image_space_channels_first

from airl_mav.arena.geometry import Arena, Bounds, Obstacles, Shape
from airl_mav.camera.frame import depth_to_z16
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.camera.render import render
from airl_mav.core.errors import UsageError
from airl_mav.envs.observations import COMPILED
from airl_mav.policy.images import (
    NEAREST_M,
    NUMPY,
    Moved,
    Scanning,
    carried,
    level_scan,
    rays_of,
    scan_bytes,
    tilt_of,
)
from airl_mav.policy.layouts import boxes, encode_layout, newest_frame
from airl_mav.policy.observation import Kinematics, observe
from airl_mav.policy.observation_spec import ObservationSpec

ROUND = Intrinsics.from_fov(512, 160, 2.0 * math.pi, "cylindrical")
AHEAD = Intrinsics.from_fov(256, 192, math.radians(90.0))
ALTITUDE_M = 2.5
RANGE_M = 20.0
BOTH = pytest.mark.parametrize("make", [NUMPY.scanning, COMPILED.scanning], ids=["numpy", "twin"])


def posts(places: NDArray[np.float64], radius_m: float = 0.5) -> Arena:
    """Return upright cylinders in a hall whose walls are out of range."""
    n = len(places)
    center = np.column_stack([places, np.full(n, -2.5)])
    half = np.tile([radius_m, radius_m, 2.5], (n, 1))
    obstacles = Obstacles(np.full(n, Shape.CYLINDER, np.int8), center, half, np.zeros(n))
    walls = Bounds(north_min=-90.0, north_max=90.0, east_min=-90.0, east_max=90.0, height=9.0)
    return Arena("posts", 0, walls, (0, 0, 0), obstacles, (), np.array([5.0, 0.0]))


def attitude(roll: float, pitch: float, yaw: float) -> NDArray[np.float64]:
    """Return the quaternion of angles [deg], by scipy."""
    turn = Rotation.from_euler("ZYX", [yaw, pitch, roll], degrees=True)
    return np.roll(turn.as_quat(), 1)


def image(
    arena: Arena, camera: Intrinsics, place: NDArray[np.float64], quaternion: NDArray[np.float64]
) -> NDArray[np.uint16]:
    """Return what a camera sees, as a batch of one."""
    depth = render(arena, arena.centers_at(0), camera, RANGE_M, place, quaternion)
    return depth_to_z16(depth)[None]


def nearest(
    arena: Arena, place: NDArray[np.float64], yaw_rad: float, edges: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the ranges of a planar lidar with many beams to each bearing, by the closed form."""
    found = np.full(len(edges) - 1, np.inf)
    for k in range(len(found)):
        beams = yaw_rad + np.linspace(edges[k], edges[k + 1], 21)
        along = np.stack([np.cos(beams), np.sin(beams)], axis=1)
        for center, radius in zip(
            arena.obstacles.center, arena.obstacles.half_size[:, 0], strict=True
        ):
            middle = along @ (center[:2] - place[:2])
            aside = radius**2 - (np.sum((center[:2] - place[:2]) ** 2) - middle**2)
            hit = (aside >= 0.0) & (middle > 0.0)
            if hit.any():
                found[k] = min(found[k], float((middle - np.sqrt(np.maximum(aside, 0)))[hit].min()))
    return found


def bearings(camera: Intrinsics, count: int) -> NDArray[np.float64]:
    """Return the edges (count + 1,) of the bearings."""
    half = 0.5 * camera.horizontal_fov_rad
    return np.linspace(-half, half, count + 1)


@BOTH
@pytest.mark.parametrize("camera", [ROUND, AHEAD], ids=["round", "ahead"])
@pytest.mark.parametrize("angles", [(0, 0, 0), (0, -20, 70), (15, 10, -130), (-25, 0, 180)])
def test_a_scan_is_level_however_the_vehicle_leans(
    make: Scanning, camera: Intrinsics, angles: tuple[float, float, float]
) -> None:
    yaw = math.radians(angles[2])
    spread = np.radians(np.arange(0, 360, 30)) + yaw
    distance = np.linspace(2.0, 12.0, len(spread))
    arena = posts(np.stack([distance * np.cos(spread), distance * np.sin(spread)], axis=1))
    place = np.array([0.0, 0.0, -ALTITUDE_M])
    depth = image(arena, camera, place, attitude(*angles))
    roll, pitch = np.radians(angles[:1]), np.radians(angles[1:2])
    found = make.level(depth, rays_of(camera), tilt_of(roll, pitch), 32)[0]
    wanted = nearest(arena, place, yaw, bearings(camera, 32))
    # An edge that falls between two pixels, or two rows, may be missed; nothing may be invented.
    both = np.isfinite(found) & np.isfinite(wanted)
    np.testing.assert_allclose(found[both], wanted[both], atol=0.15)
    assert both.sum() >= (10 if camera is ROUND else 2)
    assert (np.isfinite(found) == np.isfinite(wanted)).mean() > 0.85


@BOTH
def test_what_stands_is_where_it_was_and_what_moves_is_not(make: Scanning) -> None:
    rng = np.random.default_rng(4)
    where = np.array([[6.0, 1.0], [-4.0, 3.0], [1.0, -7.0], [-6.0, -5.0], [3.0, 8.0]])
    before = posts(where)
    moved_place = where.copy()
    moved_place[0] += [-0.6, 0.4]
    after = posts(moved_place)
    for _ in range(5):
        shift, turn = rng.uniform(-1.0, 1.0, 2), rng.uniform(-1.0, 1.0)
        first, second = np.array([0.0, 0.0, -2.5]), np.array([*shift, -2.5])
        level = np.zeros(1)
        scans = [
            make.level(
                image(arena, ROUND, place, attitude(0.0, 0.0, math.degrees(yaw))),
                rays_of(ROUND),
                tilt_of(level, level),
                64,
            )
            for arena, place, yaw in ((before, first, 0.0), (after, second, turn))
        ]
        # Where the first scan was made, seen from the second: by scipy.
        ahead, right = Rotation.from_euler("Z", -turn).apply([*-shift, 0.0])[:2]
        by = Moved(np.array([ahead]), np.array([right]), np.array([turn]))
        carried_ = make.carried(scans[0], by, 2.0 * math.pi)[0]
        angle = bearings(ROUND, 64)
        middle = 0.5 * (angle[1:] + angle[:-1]) + turn
        for k, place in enumerate(moved_place):
            at = int(
                np.argmin(
                    np.abs(np.angle(np.exp(1j * (middle - math.atan2(*(place - shift)[::-1])))))
                )
            )
            assert np.isfinite(scans[1][0, at])
            apart = abs(carried_[at] - scans[1][0, at])
            assert apart < 0.2 if k else apart > 0.3
    still = make.carried(scans[0], Moved(*np.zeros((3, 1))), 2.0 * math.pi)
    np.testing.assert_allclose(still, scans[0])


@pytest.mark.parametrize("camera", [ROUND, AHEAD], ids=["round", "ahead"])
def test_the_compiled_scans_are_those_of_numpy(camera: Intrinsics) -> None:
    rng = np.random.default_rng(7)
    depth = rng.integers(200, 20_000, (6, camera.height, camera.width)).astype(np.uint16)
    depth[rng.random(depth.shape) < 0.5] = 0
    tilt = tilt_of(*rng.uniform(-0.6, 0.6, (2, 6)))
    rays = rays_of(camera)
    scans = [make.level(depth, rays, tilt, 64) for make in (NUMPY.scanning, COMPILED.scanning)]
    np.testing.assert_array_equal(scan_bytes(scans[0], RANGE_M), scan_bytes(scans[1], RANGE_M))
    np.testing.assert_allclose(scans[0], scans[1], rtol=1e-14)
    scans[0][rng.random(scans[0].shape) < 0.5] = np.inf
    for far_m in (0.0, 0.3, 3.0):
        ahead, right = far_m * rng.normal(size=(2, 6))
        by = Moved(ahead, right, rng.uniform(-4.0, 4.0, 6))
        ours, theirs = (
            make.carried(scans[0], by, rays.fov_rad) for make in (NUMPY.scanning, COMPILED.scanning)
        )
        np.testing.assert_array_equal(scan_bytes(ours, RANGE_M), scan_bytes(theirs, RANGE_M))


def test_bytes_are_logarithms_of_ranges() -> None:
    ranges = np.array(
        [[0.0, NEAREST_M, NEAREST_M * (RANGE_M / NEAREST_M) ** (100 / 255), RANGE_M, 60.0, np.inf]]
    )
    assert scan_bytes(ranges, RANGE_M).tolist() == [[0, 0, 100, 255, 255, 255]]
    many = np.linspace(NEAREST_M, RANGE_M, 999)
    share = np.log(many / NEAREST_M) / math.log(RANGE_M / NEAREST_M)
    assert (np.abs(scan_bytes(many, RANGE_M) - 255.0 * share) <= 0.501).all()


# --- the layout


def layout(camera: Intrinsics, **more: Any) -> ObservationSpec:
    known = {"layout": "scan", "height_px": 20, "width_px": 64, "range_m": RANGE_M}
    fov = math.degrees(camera.horizontal_fov_rad)
    known |= {"horizontal_fov_deg": fov, "projection": camera.projection}
    return ObservationSpec.model_validate(known | more)


def state(n: int, north_m: float = 0.0, yaw: float = 0.0) -> Kinematics:
    position = np.tile([north_m, 0.0, -ALTITUDE_M], (n, 1))
    return Kinematics(position, np.zeros((n, 3)), np.tile(attitude(0.0, 0.0, yaw), (n, 1)))


def test_a_row_a_frame_each_carried_to_the_present() -> None:
    camera = Intrinsics.from_fov(128, 40, 2.0 * math.pi, "cylindrical")
    arena = posts(np.array([[7.0, 0.0], [-5.0, 2.0]]))
    poses = [(0.0, 40.0), (0.6, 10.0), (1.2, -20.0)]
    taken = [
        (
            image(arena, camera, np.array([north, 0.0, -ALTITUDE_M]), attitude(0.0, 0.0, yaw)),
            state(1, north, yaw),
        )
        for north, yaw in poses
    ]
    *earlier, (depth, now) = taken
    goal = np.array([[9.0, 0.0]])
    seen = observe(depth, camera, now, goal, earlier=earlier[::-1])
    spec = layout(camera, frames=3)
    found = encode_layout(spec, seen)
    assert list(found) == list(boxes(spec)) == ["depth", "velocity", "goal"]
    assert found["depth"].shape == (1, *boxes(spec)["depth"].shape) == (1, 1, 3, 80)
    # Static obstacles have the same bearings and distances in every row.
    rows = found["depth"][0, 0]
    near = (rows < 200).all(axis=0)
    assert near.sum() >= 2
    assert np.ptp(rows[:, near].astype(int), axis=0).max() <= 12
    # Both ends are repeated to avoid a seam at the rear.
    np.testing.assert_array_equal(rows[:, :8], rows[:, 64:72])
    np.testing.assert_array_equal(rows[:, -8:], rows[:, 8:16])
    # One decision that nothing came before: no return in the other rows.
    first = encode_layout(spec, observe(depth, camera, now, goal))["depth"][0, 0]
    np.testing.assert_array_equal(first[0], rows[0])
    assert (first[1:] == 255).all()
    # All else is as in `body`.
    body = layout(camera, layout="body")
    for key, array in encode_layout(body, observe(depth, camera, now, goal)).items():
        assert key == "depth" or np.array_equal(array, found[key])
    picture = newest_frame(spec, {key: array[0] for key, array in found.items()})
    assert picture.shape == (20, 64)
    np.testing.assert_array_equal(picture[7], rows[0, 8:72])


@pytest.mark.parametrize("frames", [1, 2, 8])
def test_libraries_take_it_for_an_image_with_its_channels_first(frames: int) -> None:
    box = boxes(layout(ROUND, frames=frames))["depth"]
    space = spaces.Box(int(box.low), int(box.high), box.shape, np.uint8)
    assert is_image_space_channels_first(space)


def test_a_camera_that_looks_ahead_has_no_seam() -> None:
    assert boxes(layout(AHEAD, width_px=64, height_px=48))["depth"].shape == (1, 1, 64)


def test_colours_are_no_ranges() -> None:
    with pytest.raises(ValidationError, match="kind = 'rgb': accepted: 'depth' with layout 'scan'"):
        layout(ROUND, kind="rgb")


def test_a_seen_image_of_another_kind_is_refused() -> None:
    camera = Intrinsics.from_fov(128, 40, 2.0 * math.pi, "cylindrical", "grey")
    seen = observe(np.zeros((1, 40, 128, 1), np.uint8), camera, state(1), np.zeros((1, 2)))
    with pytest.raises(UsageError):
        encode_layout(layout(ROUND), seen)


def test_nothing_is_carried_from_nowhere() -> None:
    empty = np.full((2, 64), np.inf)
    moved = Moved(*np.ones((3, 2)))
    assert np.isinf(carried(empty, moved, 2.0 * math.pi)).all()
    blind = np.zeros((2, ROUND.height, ROUND.width), np.uint16)
    assert np.isinf(level_scan(blind, rays_of(ROUND), tilt_of(*np.zeros((2, 2))), 64)).all()
