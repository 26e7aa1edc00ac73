"""A stereo camera's errors against their closed forms, and its shadows against pybullet's rays."""

from __future__ import annotations

import math

import numpy as np
import pytest

from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.camera.noise import Matching, matched_depth, matching_of
from airl_mav.core.errors import UsageError
from airl_mav.profiles.camera import Stereo
from airl_mav.profiles.vehicle import VehicleProfile, load_vehicle

D435 = load_vehicle("quad-d435").camera
WIDE = Intrinsics.from_fov(128, 72, math.radians(87.0))
EXACT = Matching(1e6, WIDE.focal * 0.3, 0.0, 0.0, 1e9, 60.0)
"""A baseline of 0.3 m, and a disparity without error."""


def measured(depth_mm: np.ndarray, matching: Matching, seed: int = 0) -> np.ndarray:
    return matched_depth(depth_mm.astype(np.uint16), matching, np.random.default_rng(seed))


def plane(depth_m: float, width: int = 400) -> np.ndarray:
    return np.full((200, width), round(1000 * depth_m), np.uint16)


def of_d435(**changes: float) -> Matching:
    found = matching_of(D435)
    assert found is not None
    return found._replace(**changes)


@pytest.mark.parametrize("depth_m", [1.0, 2.0, 4.0])
def test_noise_is_depth_squared_by_focal_length_and_baseline(depth_m: float) -> None:
    """RMS error = distance² x subpixel / (focal length x baseline), says Intel."""
    seen = measured(plane(depth_m), of_d435(step_px=0.0))
    inside = seen[:, 20:] / 1000.0
    expected = depth_m**2 * 0.08 / (446.8 * 0.05)
    assert (inside > 0.0).all()
    assert inside.std() == pytest.approx(expected, rel=0.03)
    assert inside.mean() == pytest.approx(depth_m, abs=4.0 * expected / math.sqrt(inside.size))


def test_depth_comes_in_steps_of_the_disparity() -> None:
    seen = measured(plane(6.0), of_d435())[:, 20:]
    disparities = 446.8 * 0.05 / (np.unique(seen) / 1000.0)
    assert len(disparities) < 25
    assert np.abs(disparities * 32.0 - np.rint(disparities * 32.0)).max() < 0.05


def test_nearer_than_the_search_reaches_there_is_no_return() -> None:
    least_m = 446.8 * 0.05 / 126.0
    assert not measured(plane(0.97 * least_m), of_d435(noise_px=0.0)).any()
    assert measured(plane(1.03 * least_m), of_d435(noise_px=0.0)).any()


def test_farther_than_its_range_and_without_a_return_it_measures_none() -> None:
    assert not measured(plane(0.0), of_d435()).any()
    beyond = measured(plane(20.0), of_d435())
    assert beyond.max() <= 20_000
    assert 0.3 < (beyond == 0).mean() < 0.7, "half of them are measured too far"


def test_the_left_edge_and_the_left_of_what_is_near_have_no_match() -> None:
    """Bands as wide as the difference of the shifts, by the half pixel at the image's edge."""
    wall, near = 8.0, 2.0
    image = plane(wall, width=128)
    image[:, 60:80] = round(1000 * near)
    seen = measured(image, EXACT)
    shift = EXACT.shift_px_m
    edge = math.ceil(shift / wall - 0.5)
    hidden = math.floor(shift * (1.0 / near - 1.0 / wall))
    assert (edge, hidden) == (3, 7)
    holes = np.flatnonzero(seen[0] == 0).tolist()
    assert holes == [*range(edge), *range(60 - hidden, 60)]
    assert (seen == seen[0]).all()
    kept = seen > 0
    assert np.array_equal(seen[kept], image[kept])


def test_shadows_are_where_pybullet_s_rays_from_the_right_imager_are_stopped() -> None:
    pybullet = pytest.importorskip("pybullet")
    client = pybullet.connect(pybullet.DIRECT)
    try:
        # Right, down, forward: spheres and a box before a wall at 9 m.
        def add(kind: int, at: tuple[float, float, float], **size: object) -> None:
            shape = pybullet.createCollisionShape(kind, physicsClientId=client, **size)
            pybullet.createMultiBody(0, shape, basePosition=at, physicsClientId=client)

        add(pybullet.GEOM_BOX, (0.0, 0.0, 10.0), halfExtents=(40.0, 40.0, 1.0))
        add(pybullet.GEOM_SPHERE, (-1.0, 0.2, 3.0), radius=0.5)
        add(pybullet.GEOM_SPHERE, (1.1, -0.4, 5.0), radius=0.8)
        add(pybullet.GEOM_BOX, (0.6, 0.5, 2.2), halfExtents=(0.2, 0.4, 0.2))
        v, u = np.mgrid[: WIDE.height, : WIDE.width]
        rays = np.stack(
            [(u - WIDE.cx) / WIDE.focal, (v - WIDE.cy) / WIDE.focal, np.ones(u.shape)], -1
        ).reshape(-1, 3)
        far = (20.0 * rays).tolist()
        hits = [
            hit[2]
            for k in range(0, len(far), 4096)
            for hit in pybullet.rayTestBatch(
                [(0.0, 0.0, 0.0)] * len(far[k : k + 4096]),
                far[k : k + 4096],
                physicsClientId=client,
            )
        ]
        depth = 20.0 * np.array(hits)
        points = rays * depth[:, None]
        right = np.array([0.3, 0.0, 0.0])
        ends = (right + 1.0002 * (points - right)).tolist()
        shares = [
            hit[2] if hit[0] >= 0 else 1.0
            for k in range(0, len(ends), 4096)
            for hit in pybullet.rayTestBatch(
                [right.tolist()] * len(ends[k : k + 4096]),
                ends[k : k + 4096],
                physicsClientId=client,
            )
        ]
    finally:
        pybullet.disconnect(client)
    visible = (np.array(shares) > 0.995).reshape(u.shape)
    there = u - EXACT.shift_px_m / depth.reshape(u.shape)
    visible &= there >= -0.5
    seen = measured(np.rint(1000.0 * depth).reshape(u.shape), EXACT) > 0
    # Of an edge that crosses a pixel either may be right: none is off by more than a column.
    off = seen != visible
    beside = np.zeros_like(off)
    beside[:, 1:] |= visible[:, 1:] != visible[:, :-1]
    beside[:, :-1] |= visible[:, 1:] != visible[:, :-1]
    assert not (off & ~beside).any()
    assert off.mean() < 0.02
    assert 0.03 < (~seen).mean() < 0.3


def test_an_ideal_camera_is_asked_for_with_none_of_the_noise() -> None:
    assert matching_of(D435, 0.0) is None
    assert matching_of(load_vehicle("quad").camera) is None
    double = matching_of(D435, 2.0)
    assert double is not None
    assert double.noise_px == 0.16


def test_the_oak_d_has_the_least_depth_that_luxonis_states() -> None:
    """35 cm at 400P."""
    stereo = load_vehicle("quad-oak-d").camera.stereo
    assert stereo is not None
    assert stereo.focal_px * stereo.baseline_m / stereo.most_px == pytest.approx(0.35, abs=0.003)


def test_a_panorama_is_no_stereo_camera() -> None:
    fields = load_vehicle("quad-panorama").model_dump()
    fields["camera"]["stereo"] = Stereo.model_dump(D435.stereo)  # type: ignore[arg-type]
    with pytest.raises(UsageError, match=r"camera.stereo.*where the projection is not pinhole"):
        VehicleProfile.model_validate(fields)
