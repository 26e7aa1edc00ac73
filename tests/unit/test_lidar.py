"""Planar lidar: single-row cylindrical camera, measurements, and receivers of its ranges."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

from airl_mav.arena.geometry import Arena, Bounds, Obstacles
from airl_mav.camera.frame import Frame
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.camera.noise import noise_of, noisy_frame, ranged_depth
from airl_mav.camera.render import expose
from airl_mav.core.errors import FieldError
from airl_mav.envs.spec import CameraChange
from airl_mav.policy.observation_spec import ObservationSpec
from airl_mav.profiles.camera import Camera, Ranging
from airl_mav.profiles.vehicle import SensorNoise, load_vehicle
from companion.addons.vehicle_reports.reports import UNKNOWN_CM, obstacle_distance
from tests.unit.test_scans import posts

LIDAR = load_vehicle("quad-lidar").camera
LENS = Intrinsics.of(LIDAR)
HERE = np.array([0.0, 0.0, -2.5])
LEVEL = np.array([1.0, 0.0, 0.0, 0.0])


def room(half: float) -> Arena:
    bounds = Bounds(-half, half, -half, half, 5.0)
    none = Obstacles(np.zeros(0, np.int8), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))
    return Arena("room", 0, bounds, (0, 0, 0), none, (), np.zeros(2))


def ranges(arena: Arena, attitude: np.ndarray = LEVEL, range_m: float = 12.0) -> np.ndarray:
    """Ranges (360,) [mm]."""
    return expose(arena, arena.centers_at(0), LENS, range_m, HERE, attitude)[0]


def test_ranges_are_those_to_the_walls_of_a_square_room() -> None:
    bearing = np.radians(np.arange(360) - 179.5)
    wanted = 5000.0 / np.maximum(np.abs(np.cos(bearing)), np.abs(np.sin(bearing)))
    assert np.abs(ranges(room(5.0)) - wanted).max() <= 0.6
    # Surfaces beyond the maximum range give no return.
    far = ranges(room(11.0))
    np.testing.assert_array_equal(far == 0, wanted * 11.0 / 5.0 > 12_000.0)


def test_it_tilts_with_the_vehicle() -> None:
    """20 degrees nose down, 2.5 m high: ahead it measures the floor."""
    attitude = np.roll(Rotation.from_euler("y", -20.0, degrees=True).as_quat(), 1)
    found = ranges(room(11.0), attitude)
    bearing = np.radians(np.arange(360) - 179.5)
    falls = math.sin(math.radians(20.0)) * np.cos(bearing)
    wanted = 2500.0 / np.where(falls > 0.0, falls, np.inf)
    floor = (wanted > 0.0) & (wanted < 10_000.0)
    assert floor.sum() > 50
    assert np.abs(found[floor] - wanted[floor]).max() <= 1.0


@pytest.mark.parametrize("at_m", [0.5, 8.0])
def test_noise_grows_with_the_range_as_asked(at_m: float) -> None:
    ranging = Ranging(noise_m=0.02, noise_share=0.01, lost_share=0.2, least_m=0.1)
    true = np.full((1, 200_000), round(1e3 * at_m), np.uint16)
    found = ranged_depth(true, ranging, 12.0, np.random.default_rng(1))
    kept = found[found > 0] / 1e3
    assert 1.0 - len(kept) / found.size == pytest.approx(0.2, abs=0.005)
    assert kept.mean() == pytest.approx(at_m, abs=1e-3)
    assert kept.std() == pytest.approx(math.hypot(0.02, 0.01 * at_m), rel=0.01)


def test_what_is_measured_too_near_or_too_far_is_no_return() -> None:
    ranging, rng = Ranging(noise_m=0.05, least_m=0.3), np.random.default_rng(2)
    near, far = (
        ranged_depth(np.full((1, 10_000), mm, np.uint16), ranging, 12.0, rng)
        for mm in (300, 12_000)
    )
    for found in (near, far):
        assert (found == 0).mean() == pytest.approx(0.5, abs=0.03)
    assert near[near > 0].min() >= 300
    assert far.max() <= 12_000
    assert not ranged_depth(np.zeros((1, 9), np.uint16), ranging, 12.0, rng).any()


def test_noise_is_that_of_seed_and_frame() -> None:
    noise = noise_of(LIDAR, SensorNoise())
    assert noise is not None
    true = ranges(room(5.0))[None]
    taken = [noisy_frame(true, noise, *key).tobytes() for key in ((1, 0), (1, 1), (2, 0), (1, 0))]
    assert taken[0] == taken[3]
    assert len(set(taken)) == 3
    assert "ranging" not in load_vehicle("quad").camera.model_dump()


def test_a_frame_of_one_row_goes_over_the_wire() -> None:
    frame = Frame(1, 2, ranges(room(5.0))[None], LENS)
    back = Frame.from_bytes(frame.to_bytes())
    assert back.intrinsics == LENS
    np.testing.assert_array_equal(back.image, frame.image)


@pytest.mark.parametrize("bearing_deg", [-177.5, -92.5, 2.5, 122.5])
def test_the_flight_controller_is_told_of_what_is_all_round(bearing_deg: float) -> None:
    """Through `ObstacleMap`'s bins of 5 degrees, none of which is unknown."""
    angle = math.radians(bearing_deg)
    arena = posts(np.array([[8.0 * math.cos(angle), 8.0 * math.sin(angle)]]))
    told = obstacle_distance(ranges(arena)[None], LENS, 12.0, LEVEL, 0.0, 7)
    distances = np.array(told["distances"])
    assert UNKNOWN_CM not in distances
    middle = told["angle_offset"] + told["increment_f"] * np.arange(72)
    nearest = int(np.argmin(distances))
    assert middle[nearest] == pytest.approx(bearing_deg, abs=0.1)
    # The post has a radius of 0.5 m; beams are a degree apart.
    assert distances[nearest] == pytest.approx(750, abs=8)
    aside = np.abs(np.mod(middle - bearing_deg + 180.0, 360.0) - 180.0) > 10.0
    assert set(distances[aside]) == {1201}


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"projection": "pinhole", "horizontal_fov_deg": 90.0}, "height_px.*value >= 6 px"),
        ({"kind": "rgb"}, "camera.kind.*'rgb'.*camera.ranging"),
    ],
)
def test_what_no_lidar_is_gets_refused(changes: dict[str, Any], told: str) -> None:
    with pytest.raises((FieldError, ValidationError), match=told):
        Camera.model_validate({**LIDAR.model_dump(), **changes})


def test_one_row_is_no_image_for_the_layouts_of_images() -> None:
    seen = {"height_px": 1, "width_px": 360, "projection": "cylindrical"}
    seen |= {"horizontal_fov_deg": 360.0, "range_m": 12.0}
    with pytest.raises(ValidationError, match="height_px = 1: accepted: 4 or more with layout"):
        ObservationSpec.model_validate(seen)
    assert ObservationSpec.model_validate({**seen, "layout": "scan"}).image_shape == (1, 450)
    with pytest.raises(FieldError, match="value >= 6 px with projection 'pinhole'"):
        CameraChange(height_px=5).of(load_vehicle("quad").camera)
