"""Additional cameras of a vehicle profile, and camera mounting."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from airl_mav.arena.generate import generate
from airl_mav.camera.frame import Frame
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.camera.render import Motion, Mount, camera_pose
from airl_mav.core.errors import FieldError, UsageError
from airl_mav.core.streams import Stream, stream, words_of
from airl_mav.policy.observation import Kinematics
from airl_mav.policy.registry import PolicyInfo, camera_refused
from airl_mav.profiles.arena import ArenaSpec
from airl_mav.profiles.camera import Camera, check_gym_imaging, check_noise
from airl_mav.profiles.loading import list_profiles, load_profile
from airl_mav.profiles.vehicle import SensorNoise, VehicleProfile, load_vehicle
from companion.limits import ground_in_view
from firmware_sim.plant.camera import SimulatedCamera

RIG = load_vehicle("quad-rig")

MADE: dict[str, Any] = {"name": "dense-obstacles", "vehicle_width_m": 0.6}

DOWN = """
[cameras.down]
width_px = 32
height_px = 24
horizontal_fov_deg = 80.0
range_m = 10.0
forward_m = 0.0
up_m = 0.0
pitch_up_deg = -90.0
"""


def profile(folder: Path, text: str) -> VehicleProfile:
    path = folder / "mine.toml"
    path.write_text(f'base = "quad"\ndescription = "mine"\n{text}')
    return load_vehicle(str(path))


# --- profiles


def test_all_cameras_are_triggered_together(tmp_path: Path) -> None:
    vehicle = profile(tmp_path, f"[camera]\nrate_hz = 12.5\n{DOWN}")
    assert vehicle.cameras["down"].rate_hz == 12.5
    assert profile(tmp_path, f"{DOWN}rate_hz = 30.0").cameras["down"].rate_hz == 30.0
    with pytest.raises(
        UsageError,
        match=r"mine\.toml: cameras\.down\.rate_hz = 15: accepted: 30 Hz, the main camera's, or",
    ):
        profile(tmp_path, f"{DOWN}rate_hz = 15.0")


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (DOWN.replace("down", "Down"), r"mine\.toml: cameras = 'Down': accepted: a name of a-z"),
        (DOWN.replace("down", "name"), r"mine\.toml: cameras = 'name': accepted: a name of a-z"),
        (f"{DOWN}bitrate = 3", r"mine\.toml: cameras\.down\.bitrate: unknown field; fields: kind"),
        (
            DOWN.replace("80.0", "175.0"),
            r"mine\.toml: cameras\.down\.horizontal_fov_deg = 175: accepted: .*170",
        ),
        (
            f'{DOWN}kind = "rgb"\n[cameras.down.ranging]\nnoise_m = 0.1',
            r"mine\.toml: cameras\.down\.kind = 'rgb': with a table camera\.ranging",
        ),
        (f"{DOWN}yaw_deg = 200.0", r"cameras\.down\.yaw_deg = 200: accepted: -180 <= value <= 180"),
        (DOWN.replace("height_px = 24", ""), r"mine\.toml: cameras\.down\.height_px: missing"),
        ("cameras = 3", r"mine\.toml: cameras = 3: accepted: a table"),
    ],
)
def test_a_wrong_further_camera_is_one_line_that_names_it(
    text: str, told: str, tmp_path: Path
) -> None:
    with pytest.raises(UsageError, match=told) as caught:
        profile(tmp_path, text)
    assert "\n" not in str(caught.value)


def test_too_many_are_refused(tmp_path: Path) -> None:
    many = "".join(DOWN.replace("down", f"c{k}") for k in range(33))
    with pytest.raises(UsageError, match="cameras = 33: accepted: at most 32"):
        profile(tmp_path, many)


def test_what_was_written_before_reads_as_it_did() -> None:
    """A profile with a single forward camera omits the fields of additional cameras."""
    for name in list_profiles("vehicles"):
        vehicle = load_vehicle(name)
        dumped = vehicle.model_dump()
        assert VehicleProfile.model_validate(dumped) == vehicle
        assert ("cameras" in dumped) == (name == "quad-rig")
        assert not {"yaw_deg", "right_m"} & dumped["camera"].keys()


def test_a_rig_comes_back_from_json() -> None:
    again = VehicleProfile.model_validate_json(RIG.model_dump_json())
    assert again == RIG
    assert list(again.cameras) == ["down", "left", "right"]
    assert again.cameras["left"].yaw_deg == -90.0


# --- mounts


@pytest.mark.parametrize(("pitch_deg", "yaw_deg"), [(0, 90), (-90, 0), (12, -135), (-30, 40)])
def test_a_mount_turns_by_its_heading_then_up(pitch_deg: float, yaw_deg: float) -> None:
    changed = {"pitch_up_deg": pitch_deg, "yaw_deg": yaw_deg, "right_m": 0.3}
    camera = RIG.camera.model_copy(update=changed)
    vehicle = Rotation.from_euler("ZYX", [40.0, -10.0, 20.0], degrees=True)
    position, quaternion = np.array([3.0, -2.0, -5.0]), np.roll(vehicle.as_quat(), 1)
    at, attitude = camera_pose(position, quaternion, Mount.of(camera))
    offset = [camera.forward_m, 0.3, -camera.up_m]
    np.testing.assert_allclose(at, position + vehicle.apply(offset), atol=1e-12)
    wanted = vehicle * Rotation.from_euler("ZYX", [yaw_deg, pitch_deg, 0.0], degrees=True)
    found = Rotation.from_quat(np.roll(attitude, -1))
    assert (wanted.inv() * found).magnitude() < 1e-9


def test_a_camera_that_looks_right_sees_what_a_turned_vehicle_sees_ahead() -> None:
    arena = generate(load_profile("arenas", "dense-obstacles", ArenaSpec), 3, **MADE)
    centre = {"forward_m": 0.0, "up_m": 0.0}
    ahead = RIG.camera.model_copy(update=centre)
    right = RIG.camera.model_copy(update=centre | {"yaw_deg": 90.0})
    at, level = np.array([0.0, 0.0, -2.0]), np.array([1.0, 0.0, 0.0, 0.0])
    turned = np.array([math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)])
    seen = SimulatedCamera(right, arena).take(0, Motion.at_rest(at, level)).depth_mm.astype(int)
    wanted = SimulatedCamera(ahead, arena).take(0, Motion.at_rest(at, turned)).depth_mm.astype(int)
    assert (wanted > 0).mean() > 0.3
    # To rounding: a ray at an edge may fall to either side.
    assert (np.abs(seen - wanted) <= 1).mean() > 0.98


def test_the_ground_that_must_be_in_view_is_that_where_the_camera_looks() -> None:
    lens = Intrinsics.from_fov(64, 48, math.radians(90.0))
    frame = Frame(0, 0, np.zeros((48, 64), np.uint16), lens)

    def in_view(roll_deg: float, pitch_deg: float, yaw_deg: float) -> bool:
        turn = Rotation.from_euler("ZYX", [30.0, pitch_deg, roll_deg], degrees=True)
        state = Kinematics(np.array([0.0, 0.0, -2.0]), np.zeros(3), np.roll(turn.as_quat(), 1))
        return ground_in_view(frame, state, 0.0, math.radians(yaw_deg))

    assert in_view(0.0, 0.0, 0.0)
    assert in_view(0.0, 0.0, 90.0)
    # The nose up by 40 degrees: ahead nothing but sky, to the side the ground as before.
    assert not in_view(0.0, 40.0, 0.0)
    assert in_view(0.0, 40.0, 90.0)
    # Rolled to the left, its right side looks at the sky.
    assert not in_view(-40.0, 0.0, 90.0)
    assert in_view(-40.0, 0.0, -90.0)


# --- noise, conditions


def test_streams_of_further_cameras_are_their_own_by_name() -> None:
    assert words_of("") == ()
    draws = [stream(5, Stream.DEPTH, 7, *words_of(name)).random() for name in ("", "left", "right")]
    assert len(set(draws)) == 3
    assert draws[0] == stream(5, Stream.DEPTH, 7).random()


def test_noise_is_drawn_for_each_camera_and_changes_no_other_s() -> None:
    arena = generate(load_profile("arenas", "dense-obstacles", ArenaSpec), 3, **MADE)
    noise = SensorNoise(depth_noise=0.1, depth_dropout=0.1)
    twins = {"a": RIG.camera, "b": RIG.camera}
    motion = Motion.at_rest(np.array([0.0, 0.0, -2.0]), np.array([1.0, 0.0, 0.0, 0.0]))
    alone = SimulatedCamera(RIG.camera, arena, 0, noise, 4).take(0, motion)
    some = SimulatedCamera(RIG.camera, arena, 0, noise, 4, further={"b": RIG.camera})
    both = SimulatedCamera(RIG.camera, arena, 0, noise, 4, further=twins).take(0, motion)
    assert not alone.further
    np.testing.assert_array_equal(alone.image, both.image)
    images = [both.image, both.further["a"].image, both.further["b"].image]
    for k in range(3):
        assert not np.array_equal(images[k], images[k - 1])
    np.testing.assert_array_equal(some.take(0, motion).further["b"].image, images[2])


GREY, COLOUR = RIG.cameras["down"], load_vehicle("quad-rgb").camera


def test_conditions_of_depth_are_refused_where_no_camera_gives_any() -> None:
    noise = SensorNoise(depth_noise=0.1)
    check_noise(COLOUR, noise, (), further=[GREY, RIG.camera])
    with pytest.raises(FieldError, match=r"sensors\.depth_noise 0\.1: accepted: 0 with a camera"):
        check_noise(COLOUR, noise, (), further=[GREY])


def test_a_gain_that_takes_time_names_its_camera() -> None:
    table = {**GREY.model_dump(), "imaging": {"auto_exposure": {"time_constant_s": 0.3}}}
    with pytest.raises(FieldError, match=r"cameras\.down\.imaging\.auto_exposure\.time_const"):
        check_gym_imaging(Camera.model_validate(table), "down")


def test_what_takes_the_main_camera_to_look_ahead_is_refused_where_it_does_not() -> None:
    aside: dict[str, Any] = {"camera": RIG.camera.model_copy(update={"yaw_deg": 90.0})}
    reason = camera_refused(PolicyInfo("greedy", ""), RIG.model_copy(update=aside))
    assert reason == "camera with yaw_deg = 90; accepted: 0, one that looks ahead"
