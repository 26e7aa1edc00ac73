"""`airl render` from the command line: written pictures and rejected options."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from rich.console import Console

from airl_mav.addons.colour.picture import render_picture
from airl_mav.arena.generate import generate
from airl_mav.camera.frame import depth_to_z16
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.cli.options import carry_out
from airl_mav.core.errors import UsageError
from airl_mav.core.frames import quat_from_euler
from airl_mav.profiles.arena import ArenaSpec
from airl_mav.profiles.loading import load_profile
from airl_mav.report.theme import coloured
from tests.support.lenses import BARREL

COMMAND = "airl_mav.addons.colour.command"

SMALL = ("--width-px", "64", "--height-px", "48")
POSE = ("--north-m", "8", "--east-m", "-2", "--height-m", "3", "--yaw-deg", "20")


def render(folder: Path, *words: str) -> np.ndarray:
    out = folder / "some.png"
    code = carry_out(
        "airl render", COMMAND, [*words, "--out", str(out)],
        console=Console(quiet=True),
    )  # fmt: skip
    assert code == 0
    with Image.open(out) as image:
        return np.asarray(image)


def sensor(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    spec = load_profile("arenas", "dense-obstacles", ArenaSpec)
    arena = generate(spec, seed, name="x", vehicle_width_m=0.55)
    camera = Intrinsics.from_fov(64, 48, math.pi / 2)
    attitude = quat_from_euler(0.0, 0.0, math.radians(20.0))
    place = np.array([8.0, -2.0, -3.0])
    picture = render_picture(arena, arena.centers_at(0), camera, place, attitude)
    return picture.rgb, picture.depth_m, picture.seen


@pytest.mark.nightly
def test_a_fisheye_has_its_coefficients(tmp_path: Path) -> None:
    words = ("--projection", "fisheye", "--fov-deg", "160", "--samples", "1", *POSE, *SMALL)
    told = ("--distortion", "-0.05", "0.008", "-0.0045", "0.0004")
    picture = render(tmp_path, "dense-obstacles", "--seed", "5", *words, *told)
    spec = load_profile("arenas", "dense-obstacles", ArenaSpec)
    arena = generate(spec, 5, name="x", vehicle_width_m=0.55)
    camera = Intrinsics.from_fov(64, 48, math.radians(160.0), "fisheye", distortion=BARREL)
    attitude, place = quat_from_euler(0.0, 0.0, math.radians(20.0)), np.array([8.0, -2.0, -3.0])
    expected = render_picture(arena, arena.centers_at(0), camera, place, attitude).rgb
    np.testing.assert_array_equal(picture, expected)
    with pytest.raises(UsageError, match=r"--distortion.*left out with projection 'pinhole'"):
        render(tmp_path, *told)


def test_one_ray_a_pixel_is_what_the_sensor_sees(tmp_path: Path) -> None:
    rgb, depth, _ = sensor(5)
    words = ("dense-obstacles", "--seed", "5", *POSE, *SMALL)
    np.testing.assert_array_equal(render(tmp_path, *words, "--samples", "1"), rgb)
    shown = render(tmp_path, *words, "--show", "depth", "--range-m", "30")
    np.testing.assert_array_equal(shown, coloured(depth_to_z16(depth), 30.0))


def test_many_rays_are_the_mean_of_light(tmp_path: Path) -> None:
    """Nearly the sensor's where nothing ends; smoother where something does."""
    rgb, _, _ = sensor(5)
    words = ("dense-obstacles", "--seed", "5", *POSE, *SMALL)
    smooth = render(tmp_path, *words)
    apart = np.abs(smooth.astype(int) - rgb)
    assert np.median(apart) < 6
    assert apart.max() > 20
    grey = render(tmp_path, *words, "--show", "grey")
    assert grey.shape == (48, 64)


def test_each_obstacle_has_a_colour_in_the_segmentation(tmp_path: Path) -> None:
    _, _, seen = sensor(5)
    words = ("dense-obstacles", "--seed", "5", *POSE, *SMALL)
    shown = render(tmp_path, *words, "--show", "segmentation")
    for number in np.unique(seen):
        assert len(np.unique(shown[seen == number], axis=0)) == 1
    near = [n for n in np.unique(seen) if n >= 4][:5]
    colours = {tuple(shown[seen == number][0]) for number in near}
    assert len(colours) == len(near) > 2


def test_moving_obstacles_move(tmp_path: Path) -> None:
    words = ("crowded", "--seed", "1", *SMALL)
    before, after = (render(tmp_path, *words, "--time-s", time) for time in ("0", "4"))
    assert (before != after).any()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("no-such",), "no arena profile 'no-such'"),
        (("--rate-hz", "5"), "--rate-hz 5: not for the picture of an arena"),
        (("--fov-deg", "175"), "--fov-deg 175: accepted: value < 170 deg"),
        (("--height-m", "-1"), "--height-m -1: accepted: 0 <= value <= 1000 m"),
        (("--samples", "0"), "--samples 0: accepted: 1 <= value <= 4096"),
    ],
)
def test_what_cannot_be_drawn_is_one_line(
    words: tuple[str, ...], message: str, tmp_path: Path
) -> None:
    with pytest.raises(UsageError) as caught:
        render(tmp_path, *words)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_only_png_files_are_written(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"accepted: a file name that ends in \.png or \.npy"):
        carry_out(
            "airl render", "airl_mav.addons.colour.command", ["--out", str(tmp_path / "x.jpg")]
        )
    assert not list(tmp_path.iterdir())
