"""`airl render --camera VEHICLE`: images of a vehicle profile's camera."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageSequence
from rich.console import Console

from airl_mav.addons.colour.image_sensor import ImageFormation
from airl_mav.addons.colour.picture import render_picture
from airl_mav.addons.colour.pictures import _rates, optical_flow, velocities_of
from airl_mav.addons.view.replayed_flight import ReplayedRun
from airl_mav.arena.generate import generate
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.camera.render import Motion
from airl_mav.cli.options import carry_out
from airl_mav.core.errors import UsageError
from airl_mav.core.frames import quat_from_euler
from airl_mav.profiles.arena import ArenaSpec
from airl_mav.profiles.loading import load_profile
from airl_mav.profiles.vehicle import load_vehicle
from firmware_sim.plant.camera import SimulatedCamera
from tests.support.run_demo import write_demo_run

PROFILE = """
base = "quad-rgb"
description = "formed"
[camera.imaging]
exposure_ms = 20.0
samples = 4
full_well_e = 2000.0
jpeg_quality = 80
[camera.imaging.auto_exposure]
"""


@pytest.fixture
def vehicle(tmp_path: Path) -> Path:
    path = tmp_path / "formed.toml"
    path.write_text(PROFILE)
    return path


def render(*words: str) -> None:
    code = carry_out(
        "airl render", "airl_mav.addons.colour.command", list(words), console=Console(quiet=True)
    )
    assert code == 0


def test_a_picture_is_that_of_the_moving_vehicle_s_camera(vehicle: Path, tmp_path: Path) -> None:
    out = tmp_path / "x.png"
    words = ("--yaw-deg", "30", "--speed-m-s", "6", "--yaw-rate-deg-s", "45", "--height-m", "2")
    render("varied-looks", "--seed", "4", "--camera", str(vehicle), *words, "--out", str(out))
    spec = load_profile("arenas", "varied-looks", ArenaSpec)
    arena = generate(spec, 4, name="varied-looks", vehicle_width_m=0.55)
    yaw = math.radians(30.0)
    motion = Motion(
        np.array([0.0, 0.0, -2.0]),
        quat_from_euler(0.0, 0.0, yaw),
        6.0 * np.array([math.cos(yaw), math.sin(yaw), 0.0]),
        np.array([0.0, 0.0, math.radians(45.0)]),
    )
    wanted = ImageFormation(load_vehicle(str(vehicle)).camera).take(arena, 0, motion, 4, 0).image
    with Image.open(out) as image:
        np.testing.assert_array_equal(np.asarray(image), wanted)


def test_a_film_has_the_pictures_of_that_camera(vehicle: Path, tmp_path: Path) -> None:
    folder, _ = write_demo_run(tmp_path / "run", episodes=1, profile="dynamic-obstacles")
    out = tmp_path / "flight.webp"
    render(str(folder.path), "0", "--camera", str(vehicle), "--rate-hz", "2", "--out", str(out))
    with Image.open(out) as image:
        assert image.size == (64, 48)
        assert sum(1 for _ in ImageSequence.Iterator(image)) > 2
    # Integrated rates reproduce the attitudes.
    run = ReplayedRun(folder.path)
    flight = run.flight(run.record(0))
    path = flight.path
    headings = np.unwrap([
        math.atan2(2 * (q[0] * q[3] + q[1] * q[2]), 1 - 2 * (q[2] ** 2 + q[3] ** 2))
        for q in path.quaternion
    ])  # fmt: skip
    at = len(headings) // 2
    turned = (headings[at + 1] - headings[at - 1]) / (
        1e-6 * (path.time_us[at + 1] - path.time_us[at - 1])
    )
    assert _rates(flight, int(path.time_us[at]))[2] == pytest.approx(turned, abs=0.05)


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("--camera", "quad-rgb", "--show", "depth"), "--show depth: with --camera"),
        (("--camera", "quad-rgb", "--width-px", "64"), "--width-px 64: with --camera"),
        (("--speed-m-s", "3"), "--speed-m-s 3(.0)?: without --camera or --show flow"),
    ],
)
def test_what_the_profile_says_is_not_asked_for(words: tuple[str, ...], told: str) -> None:
    with pytest.raises(UsageError, match=told):
        render("no-obstacles", *words)


def test_ground_truth_is_written_as_numbers(tmp_path: Path) -> None:
    """Compare an arena's ground truth with the ray caster, and flow of a camera flying ahead."""
    spec = load_profile("arenas", "dynamic-obstacles", ArenaSpec)
    arena = generate(spec, 4, name="dynamic-obstacles", vehicle_width_m=0.55)
    k = Intrinsics.from_fov(64, 48, math.radians(90.0))
    at, north = np.array([0.0, 0.0, -2.0]), np.array([1.0, 0.0, 0.0, 0.0])
    picture = render_picture(arena, arena.centers_at(1_500_000), k, at, north)
    size = ("--width-px", "64", "--height-px", "48", "--height-m", "2", "--time-s", "1.5")
    found = {}
    for show in ("depth", "segmentation", "flow"):
        out, moves = tmp_path / f"{show}.npy", ("--speed-m-s", "4") if show == "flow" else ()
        words = ("--seed", "4", "--show", show, *size, *moves, "--out", str(out))
        render("dynamic-obstacles", *words)
        found[show] = np.load(out)
    np.testing.assert_array_equal(found["depth"], picture.depth_m)
    np.testing.assert_array_equal(found["segmentation"], picture.seen)
    motion = Motion(at, north, np.array([4.0, 0.0, 0.0]), np.zeros(3))
    flow = optical_flow(picture, k, motion, velocities_of(arena, 1_500_000))
    np.testing.assert_array_equal(found["flow"], flow)
    # As a picture, too: static surfaces are white.
    render("no-obstacles", *size, "--show", "flow", "--out", str(tmp_path / "flow.png"))
    with Image.open(tmp_path / "flow.png") as image:
        assert (np.asarray(image) == 255).all()


def test_ground_truth_of_a_flight_is_one_array(tmp_path: Path) -> None:
    folder, _ = write_demo_run(tmp_path / "run", episodes=1, profile="dynamic-obstacles")
    size = ("--width-px", "32", "--height-px", "24", "--rate-hz", "2")
    out = tmp_path / "flow.npy"
    render(str(folder.path), "0", *size, "--show", "flow", "--out", str(out))
    flows = np.load(out)
    assert flows.shape[1:] == (24, 32, 2)
    assert flows.dtype == np.float32
    assert len(flows) > 2
    assert np.isfinite(flows).all()
    assert np.abs(flows).max() > 1.0
    render(str(folder.path), "0", *size, "--show", "flow", "--out", str(tmp_path / "flow.webp"))
    with pytest.raises(UsageError, match=r"accepted: depth, segmentation or flow in a file \.npy"):
        render(str(folder.path), "--out", str(tmp_path / "x.npy"))


def test_a_further_camera_is_named(tmp_path: Path) -> None:
    out = tmp_path / "down.png"
    words = ("--camera", "quad-rig", "--camera-name", "down", "--height-m", "3")
    render("varied-looks", "--seed", "4", *words, "--out", str(out))
    arena = generate(
        load_profile("arenas", "varied-looks", ArenaSpec), 4, name="x", vehicle_width_m=0.55
    )
    rig = load_vehicle("quad-rig")
    cameras = SimulatedCamera(rig.camera, arena, further=rig.cameras)
    level = np.array([1.0, 0.0, 0.0, 0.0])
    wanted = (
        cameras.take(0, Motion.at_rest(np.array([0.0, 0.0, -3.0]), level)).further["down"].image
    )
    with Image.open(out) as image:
        np.testing.assert_array_equal(np.asarray(image), wanted[..., 0])


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("--camera", "quad-rig", "--camera-name", "up"), "--camera-name up: .*down, left, right"),
        (("--camera", "quad", "--camera-name", "up"), "none: vehicle quad has its main camera"),
        (("--camera-name", "down"), "--camera-name down: without --camera"),
        (("--camera-name", "down", "--show", "flow"), "--camera-name down: without --camera"),
    ],
)
def test_a_camera_that_is_not_there_is_refused(words: tuple[str, ...], told: str) -> None:
    with pytest.raises(UsageError, match=told):
        render("no-obstacles", *words)
