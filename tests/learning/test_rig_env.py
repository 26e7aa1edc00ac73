"""Additional cameras in the vectorized simulator: images bit-identical to the plant's."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

from airl_mav.camera.render import Motion
from airl_mav.core.errors import FieldError, UsageError
from airl_mav.envs.navigation import Navigation
from airl_mav.envs.observations import COMPILED
from airl_mav.envs.spec import spec_of
from airl_mav.faults import Fault
from airl_mav.policy.images import NUMPY
from airl_mav.policy.layouts import encode_layout
from airl_mav.profiles.vehicle import SensorNoise
from firmware_sim.plant.camera import SimulatedCamera

RIG = """
base = "quad-rig"
description = "a rig whose cameras have all errors that there are"

[camera]
yaw_deg = 15.0

[cameras.down.imaging]
exposure_ms = 10.0
samples = 3
full_well_e = 3000.0
read_noise_e = 8.0
gain_spread_ev = 0.5

[cameras.left.ranging]
noise_m = 0.05
lost_share = 0.05

[cameras.right]
range_m = 20.0

[cameras.right.stereo]
baseline_m = 0.05
focal_px = 446.8
noise_px = 0.08
step_px = 0.03125
most_px = 126.0
"""

ALL: dict[str, Any] = {
    "down": {"image_width_px": 32, "image_height_px": 24, "frames": 2},
    "left": {"frames": 3},
    "right": {},
}


def rig_env(vehicle: Path | str = "quad-rig", n: int = 2, **more: Any) -> Navigation:
    knobs = {"vehicle": f"{vehicle}", "arena": "dynamic-obstacles", "cameras": ALL} | more
    return Navigation(spec_of(None, knobs), n)


def flown(env: Navigation, decisions: int = 3) -> Navigation:
    env.begin([0, 1], [5, 8])
    for _ in range(decisions):
        env.fly(np.array([[4.0, 0.0, 0.9], [2.0, 1.0, -0.7]]))
    return env


@pytest.fixture
def rig(tmp_path: Path) -> Path:
    path = tmp_path / "rig.toml"
    path.write_text(RIG)
    return path


@pytest.mark.timeout(600)  # compiles kernels, on a busy machine for minutes
@pytest.mark.parametrize(
    "arena", ["dynamic-obstacles", pytest.param("hills", marks=pytest.mark.nightly)]
)
def test_the_plant_s_cameras_take_the_same_images(rig: Path, arena: str) -> None:
    """Cover all error types: matching, ranging, exposure during motion, photon noise."""
    noise = SensorNoise(depth_noise=0.02, depth_dropout=0.02)
    env = flown(rig_env(rig, arena=arena, randomisation=noise.model_dump()))
    everyone, fleet = np.ones(2, np.bool_), env.fleet
    env.cameras.capture(fleet, env.places.batch, everyone, env.seeds)
    numbers = env.cameras._frames(fleet.time_us)
    for i, world in enumerate(env.arenas):
        assert world is not None
        motion = Motion(fleet.position[i], fleet.quaternion[i], fleet.velocity[i], fleet.omega[i])
        assert np.abs(motion.velocity).max() > 0.5
        seed = int(env.seeds[i])
        plant = SimulatedCamera(*(env.camera, world, 0, noise, seed, env.vehicle.cameras))
        taken = plant._eyes
        twin = {"": env.cameras._main, **env.cameras.further}
        assert taken.keys() == twin.keys() == {"", "down", "left", "right"}
        for name, eye in taken.items():
            wanted = eye.take(int(fleet.time_us[i]), motion, seed, int(numbers[i]))
            assert wanted.image.tobytes() == twin[name].image[i].tobytes(), name
            assert len(np.unique(wanted.image)) > 20


def test_further_cameras_change_nothing_of_what_there_was(rig: Path) -> None:
    noise = SensorNoise(depth_noise=0.02).model_dump()
    with_all = flown(rig_env(rig, randomisation=noise))
    alone = flown(rig_env(rig, randomisation=noise, cameras={}))
    assert not alone.cameras.further
    ours, theirs = with_all.observe(), alone.observe()
    assert theirs.keys() == {"depth", "velocity", "goal"}
    for key, array in theirs.items():
        np.testing.assert_array_equal(ours[key], array)
    for kept, other in zip(with_all.fleet, alone.fleet, strict=True):
        np.testing.assert_array_equal(kept, other)
    # A camera's random draws do not depend on the other cameras.
    few = flown(rig_env(rig, randomisation=noise, cameras={"right": {}}))
    np.testing.assert_array_equal(few.observe()["depth_right"], ours["depth_right"])


def test_each_image_has_its_key_size_and_stack() -> None:
    env = rig_env()
    env.begin([0, 1], [5, 8])
    seen = [env.observe()]
    for _ in range(3):
        env.fly(np.array([[4.0, 0.0, 0.9], [2.0, 1.0, -0.7]]))
        seen.append(env.observe())
    shapes = {key: array.shape for key, array in seen[0].items()}
    assert shapes == {
        "depth": (2, 1, 24, 32),
        "velocity": (2, 3),
        "goal": (2, 3),
        "depth_left": (2, 3, 24, 32),
        "depth_right": (2, 1, 24, 32),
        "grey_down": (2, 2, 24, 32),
    }
    for key in ("depth_left", "depth_right", "grey_down"):
        assert seen[0][key].dtype == np.uint8
        assert len(np.unique(seen[-1][key][:, 0])) > 3, key
    assert (seen[0]["grey_down"][:, 1] == 0).all()
    assert (seen[0]["depth_left"][:, 1:] == 255).all()
    for before, now in pairwise(seen):
        np.testing.assert_array_equal(now["grey_down"][:, 1], before["grey_down"][:, 0])
        np.testing.assert_array_equal(now["depth_left"][:, 1:], before["depth_left"][:, :2])
    looked = env.see()
    for key, array in encode_layout(env.observation, looked, NUMPY).items():
        np.testing.assert_array_equal(array, encode_layout(env.observation, looked, COMPILED)[key])
    alone = encode_layout(env.observation, looked.rows([1]), NUMPY)
    np.testing.assert_array_equal(alone["grey_down"][0], seen[-1]["grey_down"][1])
    np.testing.assert_array_equal(env.observe([1])["depth_left"][0], seen[-1]["depth_left"][1])


def test_a_saved_state_goes_on_with_all_images() -> None:
    env = flown(rig_env())
    again = rig_env()
    again.set_state(env.get_state())
    for each in (env, again):
        each.fly(np.array([[1.0, 0.5, 0.2], [2.0, 1.0, -0.7]]))
    for key, array in env.observe().items():
        np.testing.assert_array_equal(again.observe()[key], array)
    alone = rig_env(cameras={})
    assert not [key for key in alone.get_state() if "further" in key]


def test_a_stuck_camera_is_the_main_one() -> None:
    env = Navigation(rig_env().spec, 2, faults=[Fault.model_validate("camera stuck at offboard")])
    env.begin([0, 1], [5, 8])
    first = {name: each.image.copy() for name, each in env.cameras.further.items()}
    main = env.cameras.image.copy()
    env.fly(np.array([[4.0, 0.0, 0.9], [2.0, 1.0, -0.7]]))
    np.testing.assert_array_equal(env.cameras.image, main)
    for name, image in first.items():
        assert not np.array_equal(env.cameras.further[name].image, image), name


def test_gymnasium_s_environment_has_a_dict_of_them() -> None:
    env = gymnasium.make(
        "airl_mav:airl/Navigation-v0", vehicle="quad-rig", cameras={"down": {"frames": 2}}
    )
    seen, _ = env.reset(seed=7)
    assert set(seen) == {"depth", "velocity", "goal", "grey_down"}
    assert seen["grey_down"].shape == (2, 48, 64)
    assert env.observation_space.contains(seen)


@pytest.mark.parametrize(
    ("knobs", "told"),
    [
        (
            {"cameras": {"up": {}}},
            r"cameras\.up: vehicle quad-rig has no such camera; accepted: 'down', 'left', 'right'",
        ),
        (
            {"vehicle": "quad"},
            r"cameras\.down: vehicle quad has no such camera; accepted: none beside its main one",
        ),
        ({"cameras": {"down": {"image_width_px": 30}}}, "cameras: camera 'down': camera 64x48 px"),
        ({"layout": "paper"}, "accepted: none with layout 'paper'"),
        ({"compensate": True}, "compensate = true: accepted: false with further cameras"),
        ({"cameras": {"Down": {}}}, "cameras.*'Down': accepted: a name of a-z"),
        ({"cameras": {"down": {"width_px": 30}}}, r"cameras\.down\.width_px: unknown field"),
    ],
)
def test_what_cannot_be_seen_by_is_one_line(knobs: dict[str, Any], told: str) -> None:
    with pytest.raises(UsageError, match=told) as caught:
        rig_env(**knobs)
    assert "\n" not in str(caught.value)


def test_a_scan_takes_a_main_camera_that_looks_ahead(rig: Path) -> None:
    with pytest.raises(FieldError, match="layout 'scan': accepted: another with a camera that"):
        rig_env(rig, layout="scan")
    env = flown(rig_env(layout="scan", image_height_px=48, image_width_px=64))
    assert env.observe()["depth_left"].shape == (2, 3, 24, 32)


def test_what_is_noted_of_an_environment_of_one_camera_is_what_it_was() -> None:
    assert "cameras" not in spec_of(None, {}).model_dump()
    spec = spec_of(None, {"cameras": ALL})
    assert spec_of(None, spec.model_dump()) == spec


OWN = """
from airl_mav.policy.layouts import boxes, encode_layout

class Rig:
    def boxes(self, spec):
        return boxes(spec.model_copy(update={"layout": "body"}))
    def encode(self, spec, seen):
        return encode_layout(spec.model_copy(update={"layout": "body"}), seen)

class Blind(Rig):
    def boxes(self, spec):
        return {k: v for k, v in super().boxes(spec).items() if k != "grey_down"}
"""


def test_a_layout_of_the_users_has_their_images_too(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(OWN)
    env = flown(rig_env(layout=f"{tmp_path}/mine.py:Rig"))
    usual = flown(rig_env()).observe()
    for key, array in env.observe().items():
        np.testing.assert_array_equal(array, usual[key])
    blind = flown(rig_env(layout=f"{tmp_path}/mine.py:Blind"))
    with pytest.raises(FieldError, match="depth, depth_left, depth_right, grey_down uint8"):
        blind.observe()
