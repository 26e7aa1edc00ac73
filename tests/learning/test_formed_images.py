"""Cameras with a table `imaging` in the batch twin: bit for bit the images of the rehearsal."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from airl_mav.addons.colour.image_sensor import ImageFormation
from airl_mav.camera.render import Motion
from airl_mav.core.errors import FieldError
from airl_mav.envs.evaluation import Trace
from airl_mav.envs.navigation import Navigation
from airl_mav.envs.spec import spec_of
from firmware_sim.plant.camera import SimulatedCamera

QUIET = """
exposure_ms = 20.0
samples = 4
gain_spread_ev = 0.5
vignetting = 0.4
bayer = true
jpeg_quality = 70
[camera.imaging.auto_exposure]
time_constant_s = 0.0
"""
"""Imaging settings except noise, which depends on the frame number."""

NOISY = "full_well_e = 3000.0\nread_noise_e = 8.0" + QUIET


def flown(folder: Path, imaging: str, **more: Any) -> Navigation:
    """Two vehicles that fly and turn among moving obstacles."""
    text = f'base = "quad-rgb"\ndescription = "formed"\n[camera.imaging]\n{imaging}'
    vehicle = folder / "formed.toml"
    vehicle.write_text(text)
    knobs = {"arena": "dynamic-obstacles", "vehicle": f"{vehicle}", "image_width_px": 32}
    env = Navigation(spec_of(None, {**knobs, "image_height_px": 24, **more}), 2)
    env.begin([0, 1], [5, 8])
    for _ in range(3):
        env.fly(np.array([[4.0, 0.0, 0.9], [2.0, 1.0, -0.7]]))
    return env


def motion_of(env: Navigation, i: int) -> Motion:
    fleet = env.fleet
    return Motion(fleet.position[i], fleet.quaternion[i], fleet.velocity[i], fleet.omega[i])


def captured(env: Navigation) -> np.ndarray:
    """Images of where the vehicles are now."""
    everyone = np.ones(2, np.bool_)
    env.cameras.capture(env.fleet, env.places.batch, everyone, env.seeds)
    return env.cameras.image.copy()


@pytest.mark.parametrize("shutter", ["", "readout_ms = 15.0\nreadout_bands = 6"])
def test_the_plant_s_camera_takes_the_same_image(tmp_path: Path, shutter: str) -> None:
    env = flown(tmp_path, shutter + QUIET)
    images = captured(env)
    for i, arena in enumerate(env.arenas):
        assert arena is not None
        assert np.abs(env.fleet.velocity[i]).max() > 0.5
        camera = SimulatedCamera(env.camera, arena, seed=int(env.seeds[i]))
        frame = camera.take(int(env.fleet.time_us[i]), motion_of(env, i))
        assert frame.image.tobytes() == images[i].tobytes()
    assert len(np.unique(images)) > 50


@pytest.mark.parametrize("imaging", ["exposure_ms = 20.0", "readout_ms = 20.0"])
def test_an_image_is_exposed_with_the_motion_of_its_moment(tmp_path: Path, imaging: str) -> None:
    """Flown in one go, as in training, or step by step, as where it is recorded."""
    path = tmp_path / "moving.toml"
    path.write_text(f'base = "quad-rgb"\ndescription = "moving"\n[camera.imaging]\n{imaging}')
    knobs = {"arena": "dynamic-obstacles", "vehicle": f"{path}"}
    images = []
    for trace in (None, Trace(2)):
        env = Navigation(spec_of(None, knobs), 2, trace=trace)
        env.begin([0, 1], [5, 8])
        for _ in range(3):
            env.fly(np.array([[4.0, 0.0, 0.9], [2.0, 1.0, -0.7]]))
        images.append(env.cameras.image.copy())
    np.testing.assert_array_equal(images[0], images[1])


def test_noise_is_that_of_the_frame_s_number(tmp_path: Path) -> None:
    env = flown(tmp_path, NOISY)
    images = captured(env)
    frames = env.cameras._frames(env.fleet.time_us)
    for i, arena in enumerate(env.arenas):
        assert arena is not None
        time_us, seed = int(env.fleet.time_us[i]), int(env.seeds[i])
        forming = ImageFormation(env.camera)
        wanted = forming.take(arena, time_us, motion_of(env, i), seed, int(frames[i]))
        assert wanted.image.tobytes() == images[i].tobytes()
        other = forming.take(arena, time_us, motion_of(env, i), seed, int(frames[i]) + 1)
        assert other.image.tobytes() != images[i].tobytes()


def test_what_was_trained_before_sees_no_difference(tmp_path: Path) -> None:
    """Compare an empty table with the images of the compiled loop over all vehicles."""
    formed, plain = flown(tmp_path, ""), flown(tmp_path, "", vehicle="quad-rgb")
    np.testing.assert_array_equal(captured(formed), captured(plain))


def test_a_mosaic_is_refused_where_training_makes_the_camera_grey(tmp_path: Path) -> None:
    with pytest.raises(FieldError, match=r"camera\.imaging\.bayer.*kind 'grey'"):
        flown(tmp_path, "bayer = true", camera={"kind": "grey"})


def test_a_gain_that_takes_time_is_refused_in_the_twin(tmp_path: Path) -> None:
    told = r"time_constant_s.*0.3.*0 in the vectorized simulator"
    with pytest.raises(FieldError, match=told):
        flown(tmp_path, "[camera.imaging.auto_exposure]\n")
