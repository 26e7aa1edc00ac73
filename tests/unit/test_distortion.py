"""Kannala-Brandt coefficients against OpenCV and scipy's solver, and their rejection."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from airl_mav.camera.frame import Frame, FrameError
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.core.errors import FieldError, UsageError
from airl_mav.envs.spec import CameraChange
from airl_mav.policy.observation import Kinematics
from airl_mav.policy.observation_spec import ObservationSpec, camera_mismatch
from airl_mav.profiles.camera import Camera
from airl_mav.profiles.projections import (
    MOST_OFF_RAD,
    UNDISTORTED,
    Distortion,
    distorted,
    sees_to,
    steepness,
    undistorted,
)
from airl_mav.profiles.vehicle import load_vehicle
from companion.limits import ground_in_view
from tests.support.lenses import BARREL, ENDING, OPENING, angles, last_angle, published

LENSES = [UNDISTORTED, BARREL, OPENING, ENDING]


def fisheye(fov_deg: float, k: Distortion, **changes: Any) -> Camera:
    told = {**load_vehicle("quad").camera.model_dump(), "stereo": None, "projection": "fisheye"}
    wanted = {"horizontal_fov_deg": fov_deg, "distortion": k}
    return Camera.model_validate({**told, **wanted, **changes})


LENS = Intrinsics(640, 480, 310.0, 319.5, 239.5, "fisheye", distortion=BARREL)

POINTS = [[0.3, -0.2, 1.0], [1.5, 0.4, 1.0], [-2.0, -3.0, 1.0], [8.0, 2.0, 0.5], [1e-4, 2e-4, 1.0]]
"""Right, down, forward."""

PIXELS = [[0, 0], [639, 0], [100, 400], [500, 250], [320, 240]]

PROJECTED: dict[Distortion, list[list[float]]] = {
    BARREL: [
        [408.23295238200865, 180.34469841199422],
        [604.8472344434897, 315.59259585159725],
        [113.83241326966726, -69.00138009549914],
        [721.4661793880238, 339.9915448470059],
        [319.5309999994058, 239.56199999881167],
    ],
    OPENING: [
        [410.820272575839, 178.619818282774],
        [663.6593432231357, 331.27582485950285],
        [46.02568591932885, -170.71147112100675],
        [905.2971695114054, 385.94929237785135],
        [319.5309999997933, 239.56199999958667],
    ],
}
"""Pixels of POINTS by OpenCV 5.0.0: `cv2.fisheye.projectPoints(POINTS, 0, 0, K, D)` with the
coefficients D and K of LENS."""

SEEN: dict[Distortion, list[list[float]]] = {
    BARREL: [
        [-5.737745909922922, -4.301064617923442],
        [5.737745909922922, -4.301064617923442],
        [-1.0432386342684798, 0.7628236938500730],
        [0.6730690625624397, 0.039153601977316439],
        [0.0016129064426696367, 0.0016129064426696367],
    ],
    OPENING: [
        [-1.5630307099287586, -1.171661518084312],
        [1.5630307099287586, -1.171661518084312],
        [-0.821060641149572, 0.6003655257608488],
        [0.6154365924092754, 0.03580102061106589],
        [0.0016129043447175577, 0.0016129043447175577],
    ],
}
"""Right and down components of the rays of PIXELS, at 1 ahead, by OpenCV:
`cv2.fisheye.undistortPoints(PIXELS, K, D, criteria=(3, 100, 1e-15))`."""


@pytest.mark.parametrize("k", [BARREL, OPENING])
def test_points_fall_and_pixels_look_where_opencv_has_them(k: Distortion) -> None:
    camera = replace(LENS, distortion=k)
    right, down, forward = np.array(POINTS).T
    places = np.stack(camera.model.places(camera, np.stack([forward, right, down])), axis=1)
    np.testing.assert_allclose(places, PROJECTED[k], rtol=1e-12)
    columns, rows = np.array(PIXELS).T
    ahead, aside, below = camera.rays[:, rows, columns]
    # OpenCV stops as soon as a step is below 1e-8.
    np.testing.assert_allclose(np.stack([aside, below], 1) / ahead[:, None], SEEN[k], rtol=1e-7)


def test_theta_d_is_the_published_polynomial() -> None:
    rng = np.random.default_rng(1)
    for _ in range(50):
        k = tuple(rng.normal(0.0, [0.5, 0.3, 0.1, 0.05]).tolist())
        theta = float(rng.uniform(0.0, 1.66))
        assert distorted(theta, k) == pytest.approx(published(theta, k), rel=1e-13, abs=1e-15)
        slope = (published(theta + 1e-5, k) - published(theta - 1e-5, k)) / 2e-5
        assert steepness(theta, k) == pytest.approx(slope, rel=1e-6, abs=1e-8)


@pytest.mark.parametrize("k", LENSES)
def test_angles_are_solved_to_rounding(k: Distortion) -> None:
    rim = distorted(sees_to(k), k)
    theta_d = np.concatenate([np.linspace(0.0, rim, 400), [1e-9, 1e-4, 1.001 * rim, 4.0]])
    found = undistorted(theta_d, k)
    assert np.isinf(found[-2:]).all()
    # Where theta_d turns, a rounding of it is the square root of one in the angle.
    inside = slice(0, 390)
    np.testing.assert_allclose(found[inside], angles(theta_d, k)[inside], rtol=4e-15, atol=4e-15)
    np.testing.assert_allclose(distorted(found[:-2], k), theta_d[:-2], rtol=1e-15, atol=1e-16)


def test_the_rim_is_where_theta_d_turns() -> None:
    rng, ended = np.random.default_rng(4), 0
    for _ in range(60):
        k = tuple(rng.normal(0.0, [0.6, 0.4, 0.2, 0.1]).tolist())
        last = last_angle(k)
        assert sees_to(k) == pytest.approx(last, abs=2e-5)
        ended += last < MOST_OFF_RAD
    assert 15 < ended < 60
    assert sees_to(UNDISTORTED) == MOST_OFF_RAD
    # It may turn twice, and increase again: 1 - 2.7 x + 1.5 x^2 = 0 at the square of the angle.
    first = (2.7 - math.sqrt(2.7**2 - 6.0)) / 3.0
    assert sees_to((-0.9, 0.3, 0.0, 0.0)) == pytest.approx(math.sqrt(first), rel=1e-12)


@pytest.mark.parametrize("k", LENSES)
@pytest.mark.parametrize("fov_deg", [60.0, 120.0])
def test_the_field_of_view_ends_at_the_edges_of_the_image(k: Distortion, fov_deg: float) -> None:
    """The focal length that a field of view and the coefficients make."""
    camera = Intrinsics.of(fisheye(fov_deg, k))
    half = math.radians(0.5 * fov_deg)
    edge = np.array([[math.cos(half)], [math.sin(half)], [0.0]])
    column, row = camera.model.places(camera, edge)
    assert column[0] == pytest.approx(camera.width - 0.5, abs=1e-9)
    assert row[0] == pytest.approx(camera.cy)
    assert camera.focal == pytest.approx(0.5 * camera.width / published(half, k))
    assert camera.horizontal_fov_rad == pytest.approx(2.0 * half, rel=1e-12)


@pytest.mark.parametrize("k", LENSES)
def test_points_fall_where_the_rays_begin(k: Distortion) -> None:
    camera = Intrinsics(191, 161, 50.0, 95.0, 79.0, "fisheye", distortion=k)
    rays = camera.rays
    sees: Any = rays.any(axis=0)
    assert sees.sum() > 5_000
    assert not sees[0, 0]
    np.testing.assert_allclose(np.linalg.norm(rays[:, sees], axis=0), 1.0, atol=1e-12)
    u, v = camera.model.places(camera, 3.0 * rays)
    rows, columns = np.nonzero(sees)
    # At the rim itself rounding decides.
    inside = np.hypot(rows - 79.0, columns - 95.0) < 50.0 * distorted(sees_to(k), k) - 0.5
    np.testing.assert_allclose(u[sees][inside], columns[inside], atol=1e-6)
    np.testing.assert_allclose(v[sees][inside], rows[inside], atol=1e-6)


def test_coefficients_left_out_leave_every_profile_as_it_was() -> None:
    assert "distortion" not in load_vehicle("quad").camera.model_dump()
    assert "distortion" not in fisheye(120.0, UNDISTORTED).model_dump()
    bent = fisheye(120.0, BARREL).model_dump()
    assert Camera.model_validate(bent).distortion == BARREL


def test_what_is_no_lens_is_refused() -> None:
    with pytest.raises(FieldError) as refused:
        fisheye(140.0, ENDING)
    line = refused.value.line()
    assert "camera.distortion" in line
    assert "[0.34, -0.3, 0.05, -0.01]" in line
    assert "to 70 deg from the axis; with these it does to" in line
    fisheye(100.0, ENDING)
    with pytest.raises(FieldError, match=r"camera\.distortion.*left out with projection 'pinhole'"):
        fisheye(90.0, BARREL, projection="pinhole")
    for wrong in ([0.1, 0.2], [0.1, 0.2, 0.3, 101.0], "wide"):
        with pytest.raises(ValueError, match="distortion"):
            fisheye(90.0, wrong)  # type: ignore[arg-type]
    with pytest.raises(FieldError, match=r"camera\.distortion"):
        CameraChange(horizontal_fov_deg=160.0).of(fisheye(100.0, ENDING))


def test_the_card_tells_lenses_apart_by_what_they_see() -> None:
    told: dict[str, Any] = {"height_px": 48, "width_px": 64, "projection": "fisheye"}
    spec = ObservationSpec(**told, horizontal_fov_deg=160.0, range_m=20.0, distortion=BARREL)
    lens = Intrinsics.from_fov(128, 96, math.radians(160.0), "fisheye", distortion=BARREL)
    assert ObservationSpec.model_validate(spec.model_dump()) == spec
    assert camera_mismatch(spec, lens) is None
    # Another calibration of the same lens: nowhere off by a tenth of a degree.
    k1, k2, k3, k4 = (1.001 * each for each in BARREL)
    again = (k1, k2, k3, k4)
    other = Intrinsics.from_fov(128, 96, math.radians(160.0), "fisheye", distortion=again)
    assert camera_mismatch(spec, other) is None
    plain = Intrinsics.from_fov(128, 96, math.radians(160.0), "fisheye")
    assert "accepted: [-0.05, 0.008" in (camera_mismatch(spec, plain) or "")
    bare = ObservationSpec(**told, horizontal_fov_deg=160.0, range_m=20.0)
    assert "distortion" not in bare.model_dump()
    assert "deg away; accepted: [0.0, 0.0, 0.0, 0.0]" in (camera_mismatch(bare, lens) or "")
    with pytest.raises(UsageError, match="distortion"):
        ObservationSpec(**told, horizontal_fov_deg=160.0, range_m=20.0, distortion=ENDING)


@pytest.mark.parametrize("kind", ["depth", "rgb", "grey"])
def test_a_frame_takes_its_coefficients_along(kind: Any) -> None:
    lens = replace(LENS, width=4, height=3, kind=kind)
    image = np.arange(math.prod(lens.shape), dtype=lens.dtype).reshape(lens.shape)
    wire = Frame(7, 123_456, image, lens).to_bytes()
    assert wire[:4] == {"depth": b"ADK1", "rgb": b"ARK1", "grey": b"AGK1"}[kind]
    assert np.frombuffer(wire, "<f8", 4, 48).tolist() == list(BARREL)
    back = Frame.from_bytes(wire)
    assert back.intrinsics == lens
    np.testing.assert_array_equal(back.image, image)
    # All else is where it is in the frame of a lens without.
    plain = Frame(7, 123_456, image, replace(lens, distortion=UNDISTORTED)).to_bytes()
    assert wire[4:48] + wire[80:] == plain[4:]
    for broken in (wire[:60], wire[:-1], wire[:48] + np.full(4, np.nan).tobytes() + wire[80:]):
        with pytest.raises(FrameError):
            Frame.from_bytes(broken)


def test_the_ground_is_as_far_below_a_fisheye_as_its_lens_has_it() -> None:
    lens = Intrinsics.from_fov(64, 64, math.radians(100.0), "fisheye", distortion=OPENING)
    frame = Frame(0, 0, np.zeros(lens.shape, np.uint16), lens)
    level = np.array([1.0, 0.0, 0.0, 0.0])
    # The middle of the bottom row, half a pixel above the edge: by scipy's solver.
    down = float(angles(np.array([31.5 / lens.focal]), OPENING)[0])
    assert 45.0 < math.degrees(down) < 50.0
    high = 10.0 * math.sin(down)
    for share, seen in ((0.999, True), (1.001, False)):
        state = Kinematics(np.array([0.0, 0.0, -share * high]), np.zeros(3), level)
        assert ground_in_view(frame, state, 0.0) is seen
