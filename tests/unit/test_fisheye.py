"""Fisheye cameras: projection, rendered pixels, and rejection."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from airl_mav.addons.colour.picture import render_picture
from airl_mav.arena.geometry import Arena, Bounds, Obstacles, Shape
from airl_mav.camera.frame import depth_to_z16
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.camera.primitives import OBSTACLE
from airl_mav.camera.render import render
from airl_mav.core.errors import FieldError, UsageError
from airl_mav.core.frames import quat_from_euler, quat_to_matrix
from airl_mav.policy.greedy import near_points
from airl_mav.policy.images import rays_of
from airl_mav.policy.observation import Kinematics, observe
from airl_mav.policy.observation_spec import ObservationSpec, camera_mismatch
from airl_mav.prediction import CameraPose, PosedImage, Reprojector
from airl_mav.profiles.arena import DEFAULT_APPEARANCE
from airl_mav.profiles.projections import UNDISTORTED, Distortion
from airl_mav.profiles.vehicle import load_vehicle
from tests.support.lenses import BARREL, OPENING, published, rays_of_fisheye
from tests.unit.test_colour import arena, busy, poses, sun

WIDE = Intrinsics(191, 191, 180.0 / math.pi, 95.0, 95.0, "fisheye")
"""A pixel a degree, in every direction."""

LEVEL = quat_from_euler(0.0, 0.0, 0.0)
HERE = np.array([0.0, 0.0, -2.0])


def wide(distortion: Distortion) -> Intrinsics:
    """Return a lens that sees to 95 degrees, all within its image."""
    rim: float = published(math.radians(95.0), distortion)
    return replace(WIDE, focal=95.0 / rim, distortion=distortion)


def ball(off_deg: float, plane_deg: float, distance: float, radius: float) -> Arena:
    """One sphere, seen from `HERE` so far off the axis, in a plane through it, and no room."""
    off, plane = math.radians(off_deg), math.radians(plane_deg)
    way = np.array(
        [math.cos(off), math.sin(off) * math.cos(plane), math.sin(off) * math.sin(plane)]
    )
    sphere = Obstacles(
        np.array([Shape.SPHERE], np.int8),
        (HERE + distance * way)[None],
        np.full((1, 3), radius),
        np.zeros(1),
    )
    return Arena("ball", 0, Bounds(-500, 500, -500, 500, 0.001), (0, 0, 0), sphere, (), np.zeros(2))


@pytest.mark.nightly
@pytest.mark.parametrize("off_deg", [0.0, 40.0, 89.0, 93.0])
@pytest.mark.parametrize("plane_deg", [0.0, -50.0, -170.0])
@pytest.mark.parametrize("distortion", [UNDISTORTED, BARREL, OPENING])
def test_a_sphere_covers_the_angles_that_it_is_seen_under(
    off_deg: float, plane_deg: float, distortion: Distortion
) -> None:
    """The half angle asin(radius / distance) about its direction; depth is the range."""
    scene = ball(off_deg, plane_deg, 10.0, 1.5)
    lens = wide(distortion)
    picture = render_picture(scene, scene.obstacles.center, lens, HERE, LEVEL)
    towards = (scene.obstacles.center[0] - HERE) / 10.0
    rays = np.nan_to_num(rays_of_fisheye(lens))
    cosine: Any = rays @ towards
    seen = (cosine > math.cos(math.asin(0.15))) & rays.any(axis=-1)
    ball_range = 10.0 * cosine - np.sqrt(np.maximum(1.5**2 - 100.0 * (1.0 - cosine**2), 0.0))
    mine: Any = picture.seen == OBSTACLE
    edge: Any = np.abs(np.arccos(cosine) - math.asin(0.15)) < 1e-5
    np.testing.assert_array_equal(mine[~edge], seen[~edge])
    assert seen.sum() > 40
    np.testing.assert_allclose(picture.depth_m[mine], ball_range[mine], atol=2e-4)


def test_points_fall_where_the_rays_begin() -> None:
    rays = WIDE.rays
    sees: Any = rays.any(axis=0)
    np.testing.assert_allclose(np.linalg.norm(rays[:, sees], axis=0), 1.0, atol=1e-12)
    u, v = WIDE.model.places(WIDE, 7.0 * rays)
    rows, columns = np.nonzero(sees)
    np.testing.assert_allclose(u[sees], columns, atol=1e-6)
    np.testing.assert_allclose(v[sees], rows, atol=1e-6)
    # The image's corners lie outside of the lens's circle.
    assert not sees[0, 0]
    assert sees[95, 0]
    behind, _ = WIDE.model.places(WIDE, np.array([[-1.0], [0.05], [0.0]]))
    assert not np.isfinite(behind).any()


@pytest.mark.nightly
@pytest.mark.parametrize("distortion", [UNDISTORTED, BARREL])
def test_a_pixel_shows_what_a_pinhole_shows_that_looks_along_its_ray(
    distortion: Distortion,
) -> None:
    """Depth, colours, shadows and textures: a small pinhole of the same pixels, turned there."""
    k = Intrinsics.from_fov(64, 48, math.radians(150.0), "fisheye", distortion=distortion)
    small = Intrinsics(3, 3, k.focal, 1.0, 1.0)
    rays, rng = k.rays, np.random.default_rng(2)
    scene = replace(arena(busy(1), sun=sun(200.0, 40.0)), appearance=DEFAULT_APPEARANCE)
    same = total = 0
    for position, attitude in poses(1, 6):
        centers, at = scene.obstacles.center, np.array(position)
        whole = render_picture(scene, centers, k, at, attitude)
        for _ in range(60):
            v, u = int(rng.integers(48)), int(rng.integers(64))
            ray = rays[:, v, u]
            yaw, pitch = math.atan2(ray[1], ray[0]), -math.asin(np.clip(ray[2], -1.0, 1.0))
            turn = Rotation.from_matrix(
                quat_to_matrix(attitude) @ quat_to_matrix(quat_from_euler(0.0, pitch, yaw))
            )
            x, y, z, w = turn.as_quat()
            part = render_picture(scene, centers, small, at, np.array([w, x, y, z]))
            assert whole.depth_m[v, u] == pytest.approx(part.depth_m[1, 1], rel=1e-4, abs=1e-3)
            apart = np.abs(whole.rgb[v, u].astype(int) - part.rgb[1, 1])
            same, total = same + int(apart.max() <= 1), total + 1
    # A place may fall on either side of a texel's or a shadow's edge.
    assert same > 0.97 * total


@pytest.mark.parametrize("distortion", [UNDISTORTED, BARREL, OPENING])
def test_an_image_from_elsewhere_is_that_of_the_camera_there(distortion: Distortion) -> None:
    camera = load_vehicle("quad").camera.model_copy(update={"projection": "fisheye"})
    k = Intrinsics.from_fov(64, 48, math.radians(180.0), "fisheye", distortion=distortion)
    scene, there = arena(busy(2)), np.array([0.3, 0.1, -2.05])
    centers = scene.obstacles.center
    turned = quat_from_euler(0.0, 0.0, 0.1)
    first, wanted = (
        depth_to_z16(render(scene, centers, k, camera.range_m, *pose))
        for pose in ((HERE, LEVEL), (there, turned))
    )
    sight = PosedImage(first, CameraPose(HERE, quat_to_matrix(LEVEL)))
    found = Reprojector(camera, k).image([sight], CameraPose(there, quat_to_matrix(turned)))
    both = (found > 0) & (wanted > 0)
    off_m = np.abs(found[both].astype(float) - wanted[both]) / 1e3
    assert both.mean() > 0.3
    # Errors on slopes and edges come from the distance between pixels.
    assert np.median(off_m) < 0.05
    assert np.abs(first[both].astype(float) - wanted[both]).mean() / 1e3 > 2.0 * off_m.mean()


@pytest.mark.parametrize("distortion", [UNDISTORTED, BARREL, OPENING])
def test_greedy_takes_returns_for_the_points_that_they_are(distortion: Distortion) -> None:
    scene, lens = ball(80.0, 0.0, 6.0, 0.5), wide(distortion)
    depth = depth_to_z16(render(scene, scene.obstacles.center, lens, 5.9, HERE, LEVEL))
    state = Kinematics(HERE, np.zeros(3), LEVEL)
    seen = observe(depth, lens, state, np.array([9.0, 0.0]))
    points = near_points(seen, 0.4)
    apart = np.linalg.norm(points - (scene.obstacles.center[0] - HERE)[:2], axis=1)
    assert len(points) > 10
    assert apart.max() <= 0.501


def test_the_card_tells_a_fisheye_from_a_cylinder_of_the_same_size() -> None:
    spec = ObservationSpec(
        height_px=48, width_px=64, projection="fisheye", horizontal_fov_deg=160.0, range_m=20.0
    )
    lens = Intrinsics.from_fov(64, 48, math.radians(160.0), "fisheye")
    assert camera_mismatch(spec, lens) is None
    told = camera_mismatch(spec, replace(lens, projection="cylindrical"))
    assert told == "cylindrical camera; accepted: fisheye"
    narrow = Intrinsics.from_fov(64, 48, math.radians(150.0), "fisheye")
    assert "field of view of 150.0 deg" in (camera_mismatch(spec, narrow) or "")


def test_what_it_does_not_see_is_refused() -> None:
    with pytest.raises(FieldError, match="value <= 190 deg with 'fisheye'"):
        type(load_vehicle("quad").camera).model_validate(
            {
                **load_vehicle("quad").camera.model_dump(),
                "projection": "fisheye",
                "horizontal_fov_deg": 191.0,
            }
        )
    with pytest.raises(UsageError, match="a fisheye gives no level scan"):
        rays_of(WIDE)
    with pytest.raises(ValueError, match=r"fisheye.*accepted: pinhole or cylindrical with"):
        ObservationSpec(
            layout="scan",
            height_px=48,
            width_px=64,
            projection="fisheye",
            horizontal_fov_deg=160.0,
            range_m=20.0,
        )
