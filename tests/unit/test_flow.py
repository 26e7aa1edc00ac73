"""Optical flow, beside points that are followed: projected a moment before and a moment after."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from airl_mav.addons.colour.picture import Picture, render_picture
from airl_mav.addons.colour.pictures import (
    motion_of_camera,
    optical_flow,
    velocities_of,
)
from airl_mav.arena.generate import generate
from airl_mav.arena.geometry import Arena
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.camera.primitives import FLOOR, OBSTACLE, SKY
from airl_mav.camera.render import Motion, Mount
from airl_mav.core.frames import quat_from_euler, quat_to_matrix
from airl_mav.profiles.arena import ArenaSpec
from airl_mav.profiles.loading import load_profile
from airl_mav.profiles.projections import UNDISTORTED, Distortion, Projection
from tests.support.lenses import BARREL, OPENING, published
from tests.unit.test_colour import rays_of

FOV = {"pinhole": 1.6, "cylindrical": 2.0 * math.pi, "fisheye": math.radians(190.0)}
STEP_S = 1e-4


def lens_of(projection: Projection) -> Intrinsics:
    return Intrinsics.from_fov(64, 48, FOV[projection], projection, "rgb")


def places(k: Intrinsics, p: np.ndarray) -> np.ndarray:
    """Columns and rows (n, 2) on which points (n, 3) forward, right, down fall, by angles."""
    z, x, y = p.T
    if k.projection == "pinhole":
        return np.stack([k.focal * x / z, k.focal * y / z], 1)
    if k.projection == "cylindrical":
        return np.stack([k.focal * np.arctan2(x, z), k.focal * y / np.hypot(x, z)], 1)
    off = np.arccos(z / np.linalg.norm(p, axis=1))
    plane, out = np.arctan2(y, x), published(off, k.distortion)
    return k.focal * out[:, None] * np.stack([np.cos(plane), np.sin(plane)], 1)


def followed(
    scene: Arena, k: Intrinsics, picture: Picture, motion: Motion, elapsed_us: int
) -> np.ndarray:
    """Flow (h, w, 2) of the points that are seen, by differences of their places."""
    offsets = picture.depth_m[..., None] * rays_of(k, motion.quaternion)
    far = picture.seen == SKY
    offsets[far] = 1e9 * rays_of(k, motion.quaternion)[far]
    world = motion.position + offsets.reshape(-1, 3)
    number = picture.seen.reshape(-1) - OBSTACLE
    axes = Rotation.from_matrix(quat_to_matrix(motion.quaternion))
    found = []
    for step_s in (-STEP_S, STEP_S):
        moved = scene.centers_at(elapsed_us + round(1e6 * step_s)) - scene.centers_at(elapsed_us)
        carried = np.where((number >= 0)[:, None], moved[np.maximum(number, 0)], 0.0)
        turned = axes * Rotation.from_rotvec(step_s * motion.rates)
        at = motion.position + step_s * motion.velocity
        found.append(places(k, turned.inv().apply(world + carried - at)))
    columns_a_turn = 2.0 * math.pi * k.focal
    apart = found[1] - found[0]
    if k.projection == "cylindrical":
        apart[:, 0] -= columns_a_turn * np.rint(apart[:, 0] / columns_a_turn)
    return (apart / (2.0 * STEP_S)).reshape(k.height, k.width, 2)


@pytest.mark.parametrize(
    ("projection", "distortion"),
    [
        ("pinhole", UNDISTORTED),
        ("cylindrical", UNDISTORTED),
        # The fisheye has a separate renderer, which takes half a minute to compile.
        pytest.param("fisheye", UNDISTORTED, marks=pytest.mark.nightly),
        pytest.param("fisheye", BARREL, marks=pytest.mark.nightly),
        pytest.param("fisheye", OPENING, marks=pytest.mark.nightly),
    ],
)
def test_flow_is_that_of_points_that_are_followed(
    projection: Projection, distortion: Distortion
) -> None:
    """From a vehicle that flies and turns, among obstacles that move."""
    k, rng = replace(lens_of(projection), distortion=distortion), np.random.default_rng(6)
    spec = load_profile("arenas", "dynamic-obstacles", ArenaSpec)
    shown = {SKY: 0, FLOOR: 0}
    moving = 0
    for seed in range(6):
        scene = generate(spec, seed, name="flow", vehicle_width_m=0.55)
        elapsed_us = 3_000_000 + 170_000 * seed
        vehicle = Motion(
            np.array([*rng.uniform(-10, 10, 2), -2.0]),
            quat_from_euler(rng.normal(0.0, 0.2), rng.normal(0.0, 0.2), rng.uniform(-3.0, 3.0)),
            rng.normal(0.0, 3.0, 3),
            rng.normal(0.0, 1.0, 3),
        )
        motion = motion_of_camera(vehicle, Mount((0.2, 0.0, -0.1), 0.3))
        centers = scene.centers_at(elapsed_us)
        picture = render_picture(scene, centers, k, motion.position, motion.quaternion)
        if (picture.depth_m[picture.depth_m > 0.0] < 0.3).any():
            continue  # Beside an obstacle, or inside: differences are coarse there.
        velocities = velocities_of(scene, elapsed_us)
        flow = optical_flow(picture, k, motion, velocities)
        wanted = followed(scene, k, picture, motion, elapsed_us)
        sees = np.isfinite(flow[..., 0])
        np.testing.assert_allclose(flow[sees], wanted[sees], rtol=2e-3, atol=0.05)
        for number in shown:
            shown[number] += int((picture.seen == number)[sees].sum())
        first = OBSTACLE + scene.n_static
        moving += int((picture.seen >= first).sum())
        assert np.linalg.norm(velocities[scene.n_static :], axis=1).max() > 0.5
        assert not velocities[: scene.n_static].any()
    assert min(*shown.values(), moving) > 50


def test_what_is_ahead_opens_from_the_middle() -> None:
    """Straight ahead at v towards a wall at z: (u - cx) v / z, the focus of expansion."""
    k = Intrinsics.from_fov(65, 49, 1.2)
    depth = np.full((49, 65), 8.0, np.float32)
    picture = Picture(np.zeros((49, 65, 3), np.uint8), depth, np.full((49, 65), 2, np.int32))
    level = quat_from_euler(0.0, 0.0, 0.7)
    ahead = quat_to_matrix(level) @ np.array([4.0, 0.0, 0.0])
    motion = Motion(np.zeros(3), level, ahead, np.zeros(3))
    flow = optical_flow(picture, k, motion, np.zeros((0, 3)))
    across = (np.arange(65) - k.cx) * 4.0 / 8.0
    np.testing.assert_allclose(flow[..., 0], np.broadcast_to(across, (49, 65)), atol=1e-5)
    # Turning to the right everything moves to the left, by the focal length in the middle.
    turning = motion._replace(velocity=np.zeros(3), rates=np.array([0.0, 0.0, 0.5]))
    still = optical_flow(picture, k, turning, np.zeros((0, 3)))
    assert still[24, 32, 0] == pytest.approx(-0.5 * k.focal, rel=1e-6)


def test_a_pixel_that_sees_nothing_has_no_flow() -> None:
    k = replace(lens_of("fisheye"), height=64, cy=31.5)
    picture = Picture(
        np.zeros((64, 64, 3), np.uint8),
        np.zeros((64, 64), np.float32),
        np.zeros((64, 64), np.int32),
    )
    motion = Motion(np.zeros(3), np.array([1.0, 0, 0, 0]), np.ones(3), np.ones(3))
    flow = optical_flow(picture, k, motion, np.zeros((0, 3)))
    assert np.isnan(flow[0, 0]).all()
    assert np.isfinite(flow[32]).all()
