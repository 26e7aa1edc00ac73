"""Cameras of the companion computer's: their images become frames of the policy's size."""

from __future__ import annotations

import math
import re
import sys
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from airl_mav.arena.generate import generate
from airl_mav.camera.frame import MAX_MM, depth_to_z16
from airl_mav.camera.intrinsics import Intrinsics, finer
from airl_mav.camera.render import render
from airl_mav.core.clock import SimClock, WallClock
from airl_mav.core.errors import FieldError
from airl_mav.profiles.arena import ArenaSpec
from airl_mav.profiles.loading import load_profile
from airl_mav.profiles.projections import UNDISTORTED
from airl_mav.profiles.vehicle import load_vehicle
from airl_mav.scenario.stand_alone import StandAloneCompanion, check_companion
from companion.addons.cameras.drivers import CameraThread, DepthImage
from companion.addons.cameras.fitting import Fitting, Lens, check_coverage
from companion.frame_source import open_named_camera
from tests.support.lenses import BARREL, OPENING, rays_of_fisheye

WANTED = Intrinsics.from_fov(64, 48, math.radians(90.0))
WIDE = Lens(848, 636, 424.0, 424.0, 423.5, 317.5)
"""Sees exactly what is wanted, in 13.25 times the pixels."""


def plane(lens: Lens, mm: int) -> NDArray[np.uint16]:
    return np.full((lens.height, lens.width), mm, np.uint16)


# --- fitting -------------------------------------------------------------------------------------


def test_a_camera_that_sees_the_same_is_returned_as_it_is() -> None:
    image = np.arange(48 * 64, dtype=np.uint16).reshape(48, 64)
    fitting = Fitting(Lens.of(WANTED), WANTED)
    assert fitting.coverage == 1.0
    np.testing.assert_array_equal(fitting.fit(image), image)


def test_what_is_nearest_in_a_pixel_wins_and_holes_do_not_count() -> None:
    image = plane(WIDE, 9000)
    image[::2] = 0
    image[300, 424] = 1500  # One thin return, in the wanted column 32 and row 22.
    image[:, :100] = 0  # Nothing to match at the left.
    image[5, 500] = MAX_MM
    fitted = Fitting(WIDE, WANTED).fit(image)
    assert set(np.unique(fitted[:, 8:])) <= {1500, 9000}
    assert np.argwhere(fitted == 1500).tolist() == [[22, 32]]
    assert not fitted[:, :7].any()


@pytest.mark.parametrize("dense", [WIDE, Lens(640, 480, 330.0, 330.0, 310.0, 245.0)])
def test_every_ray_of_the_arena_ends_where_the_wanted_camera_sees_it(dense: Lens) -> None:
    """The ray caster's image of the wanted camera is the reference."""
    spec = load_profile("arenas", "dense-obstacles", ArenaSpec)
    arena = generate(spec, 7, name="test", vehicle_width_m=0.6)
    pose = np.array([0.0, 0.0, -1.5]), np.array([1.0, 0.0, 0.0, 0.0])

    def drawn(camera: Intrinsics) -> NDArray[np.uint16]:
        return depth_to_z16(render(arena, arena.obstacles.center, camera, 20.0, *pose))

    fitted = Fitting(dense, WANTED).fit(
        drawn(Intrinsics(dense.width, dense.height, dense.fx, dense.cx, dense.cy))
    )
    centre = drawn(WANTED)
    known = (fitted > 0) & (centre > 0)
    assert known.mean() > 0.5
    nearer_mm = centre[known].astype(int) - fitted[known].astype(int)
    # The nearest depth in a pixel is not behind the depth at its centre, except for rounding to
    # rows and columns on receding surfaces.
    assert np.quantile(nearer_mm, 0.02) > -100
    assert np.median(np.abs(nearer_mm) / centre[known]) < 0.03


FISHEYE = Intrinsics(720, 720, 240.0, 355.0, 362.0, "fisheye", distortion=BARREL)
"""Sees to its circle's rim, at 95 degrees."""


def seen_by(camera: Intrinsics) -> NDArray[np.uint16]:
    """Return the depth image [mm] of an arena."""
    spec = load_profile("arenas", "dense-obstacles", ArenaSpec)
    arena = generate(spec, 7, name="test", vehicle_width_m=0.6)
    pose = np.array([0.0, 0.0, -1.5]), np.array([1.0, 0.0, 0.0, 0.0])
    return depth_to_z16(render(arena, arena.obstacles.center, camera, 20.0, *pose))


@pytest.mark.parametrize(
    ("wanted", "least"),
    [
        (WANTED, 1.0),
        (Intrinsics.from_fov(64, 48, math.radians(150.0), "fisheye", distortion=OPENING), 1.0),
        (Intrinsics.from_fov(64, 64, math.radians(180.0), "fisheye"), 0.92),
        (Intrinsics.from_fov(64, 24, math.radians(140.0), "cylindrical"), 1.0),
    ],
    ids=["pinhole", "fisheye", "half", "cylinder"],
)
def test_a_fisheye_s_depth_along_its_axis_becomes_what_is_wanted(
    wanted: Intrinsics, least: float
) -> None:
    """The nearest return of 64 rays a pixel, by the ray caster, is the reference."""
    rays = np.nan_to_num(rays_of_fisheye(FISHEYE))
    # Images as from a ROS camera: depth along the axis, 0 to the side.
    along = np.rint(seen_by(FISHEYE) * np.maximum(rays[..., 0], 0.0)).astype(np.uint16)
    fitting = Fitting(Lens.of(FISHEYE), wanted)
    assert fitting.coverage >= least
    fitted, dense = fitting.fit(along), seen_by(finer(wanted, 8)).astype(int)
    blocks = np.where(dense > 0, dense, 1 << 20).reshape(wanted.height, 8, wanted.width, 8)
    nearest = blocks.min(axis=(1, 3))
    known = (fitted > 0) & (nearest < 1 << 20)
    assert known.mean() > 0.4
    apart = np.abs(nearest - fitted)[known] / nearest[known]
    assert np.median(apart) < 0.01
    # Close to 90 degrees from the axis a millimetre along it is much along the ray.
    assert np.quantile(apart, 0.8) < 0.05
    # As a pinhole's or an equidistant fisheye's it is farther off.
    for other in (None, UNDISTORTED):
        wrong = Fitting(replace(Lens.of(FISHEYE), distortion=other), wanted)
        shown = wrong.fit(along)
        off = np.abs(nearest - shown)[known] / nearest[known]
        assert wrong.coverage < 0.9 or off.mean() > 1.5 * apart.mean()


def test_a_pinhole_serves_a_narrow_cylinder_and_no_wide_one() -> None:
    narrow = Intrinsics.from_fov(60, 24, math.radians(80.0), "cylindrical")
    dense = Intrinsics(WIDE.width, WIDE.height, WIDE.fx, WIDE.cx, WIDE.cy)
    fitting = Fitting(WIDE, narrow)
    assert fitting.coverage == 1.0
    fitted, centre = fitting.fit(seen_by(dense)), seen_by(narrow)
    known = (fitted > 0) & (centre > 0)
    assert np.median(np.abs(fitted[known].astype(int) - centre[known]) / centre[known]) < 0.03
    round_about = Intrinsics.of(load_vehicle("quad-panorama").camera)
    with pytest.raises(FieldError, match=r"90 x 74 deg: 17 % of .* sees \(360 x 89 deg"):
        check_coverage("mine", WIDE, Fitting(WIDE, round_about), "vehicle quad-panorama")


def test_rows_and_columns_have_a_focal_length_of_their_own() -> None:
    lens = Lens(800, 500, 400.0, 300.0, 380.0, 260.0)
    columns, rows = np.arange(lens.width), np.arange(lens.height)
    # The pixel values encode the direction of each pixel.
    across = np.broadcast_to(30_000 + 10_000 * (columns - lens.cx) / lens.fx, (500, 800))
    down = np.broadcast_to((30_000 + 10_000 * (rows - lens.cy) / lens.fy)[:, None], (500, 800))
    fitting = Fitting(lens, WANTED)
    half = 0.5 * 10_000 / WANTED.focal + 10_000 / lens.fy  # Half a pixel, and a row of the lens.
    for told, at in (
        (across, (np.arange(64) - WANTED.cx)[None, :]),
        (down, (np.arange(48) - WANTED.cy)[:, None]),
    ):
        fitted = fitting.fit(np.rint(told).astype(np.uint16)).astype(int)
        wanted = np.broadcast_to(30_000 + 10_000 * at / WANTED.focal, fitted.shape)
        assert np.all(np.abs(fitted - wanted)[fitted > 0] <= half)
        assert (fitted > 0).mean() > 0.9


@pytest.mark.parametrize(
    ("lens", "least", "most"),
    [
        (Lens(848, 480, 446.8, 446.8, 423.5, 239.5), 0.66, 0.74),  # D435: 87 x 56 degrees.
        (Lens(1280, 720, 446.8, 446.8, 639.5, 359.5), 1.0, 1.0),
        (Lens(64, 48, 32.0, 64.0, 31.5, 23.5), 0.49, 0.51),  # Half as high.
    ],
)
def test_coverage_is_the_share_of_rays_inside_the_image(
    lens: Lens, least: float, most: float
) -> None:
    assert least <= Fitting(lens, WANTED).coverage <= most


def test_a_camera_that_sees_too_little_is_refused_with_both_fields_of_view() -> None:
    lens = Lens(848, 480, 446.8, 446.8, 423.5, 239.5)
    fitting = Fitting(lens, WANTED)
    with pytest.raises(FieldError, match=r"87 x 56 deg: 68 % of .* quad sees \(90 x 74 deg\)"):
        check_coverage("mine", lens, fitting, "vehicle quad")
    d435 = Intrinsics.of(load_vehicle("quad-d435").camera)
    check_coverage("mine", lens, Fitting(lens, d435), "vehicle quad-d435")
    three_degrees_less = 0.5 * 848 / math.tan(math.radians(0.5 * 84.0))
    worst = Lens(848, 480, three_degrees_less, three_degrees_less, 423.5, 239.5)
    check_coverage("mine", worst, Fitting(worst, d435), "vehicle quad-d435")


@pytest.mark.parametrize(
    "image", [np.zeros((480, 848), np.uint16), np.zeros((636, 848), np.float32)]
)
def test_an_image_of_another_size_or_type_is_no_image(image: NDArray[Any]) -> None:
    with pytest.raises(ValueError, match=r"accepted: uint16 \(636, 848\)"):
        Fitting(WIDE, WANTED).fit(image)


# --- the thread ----------------------------------------------------------------------------------


class Scripted:
    """Driver that returns the images passed to `give`."""

    lens = WIDE

    def __init__(self) -> None:
        self.images: list[DepthImage | Exception] = []
        self.told = threading.Event()
        self.closed = False

    def give(self, *images: DepthImage | Exception) -> None:
        self.images += images
        self.told.set()

    def read(self, timeout_s: float) -> DepthImage | None:
        if not self.told.wait(timeout_s):
            return None
        image = self.images.pop(0)
        if not self.images:
            self.told.clear()
        if isinstance(image, Exception):
            raise image
        return image

    def close(self) -> None:
        self.closed = True


@pytest.fixture
def scripted() -> Iterator[tuple[Scripted, CameraThread, SimClock]]:
    camera, clock = Scripted(), SimClock(1_000_000)
    source = CameraThread("mine", camera, clock, Fitting(WIDE, WANTED))
    yield camera, source, clock
    source.close()
    assert camera.closed


def test_the_newest_image_becomes_a_frame_stamped_when_it_was_taken(
    scripted: tuple[Scripted, CameraThread, SimClock],
) -> None:
    camera, source, _ = scripted
    assert source.latest() is None
    assert source.wait(-1, 0.01) is None
    camera.give(DepthImage(plane(WIDE, 4000), age_us=30_000))
    received = source.wait(-1, 30.0)
    assert received is not None
    assert received.frame.sequence == 0
    assert received.frame.capture_time_us == 970_000
    assert received.received_us == 1_000_000
    assert received.frame.intrinsics == WANTED
    np.testing.assert_array_equal(received.frame.depth_mm, np.full((48, 64), 4000))
    assert source.wait(0, 0.01) is None, "the same is not new"
    camera.give(*(DepthImage(plane(WIDE, mm), 0) for mm in (3000, 2000)))
    while received.frame.sequence < 2:
        newer = source.wait(received.frame.sequence, 30.0)
        assert newer is not None
        received = newer
    assert received.frame.depth_mm[0, 0] == 2000


@pytest.mark.parametrize(
    ("bad", "told"),
    [
        (OSError("unplugged"), "camera mine failed: OSError: unplugged"),
        (
            DepthImage(np.zeros((2, 2), np.uint16), 0),
            r"camera mine failed: ValueError: an image of uint16 \(2, 2\); accepted: .*",
        ),
    ],
)
def test_a_driver_that_raises_falls_silent_and_says_why(
    bad: Any, told: str, capsys: pytest.CaptureFixture[str]
) -> None:
    camera = Scripted()
    source = CameraThread("mine", camera, WallClock(), Fitting(WIDE, WANTED))
    camera.give(bad)
    source._thread.join(30.0)
    assert source.failure is not None
    assert re.fullmatch(told, source.failure)
    assert source.wait(-1, 0.01) is None
    source.close()


# --- by name -------------------------------------------------------------------------------------

OWN = """
import numpy as np
from companion.addons.cameras.drivers import DepthImage
from companion.addons.cameras.fitting import Lens

class Mine:
    lens = Lens(128, 96, 64.0, 64.0, 63.5, 47.5)
    def read(self, timeout_s):
        return DepthImage(np.full((96, 128), 1234, np.uint16), 0)
    def close(self):
        pass

class Narrow(Mine):
    lens = Lens(128, 96, 128.0, 128.0, 63.5, 47.5)

class Unplugged(Mine):
    def __init__(self):
        raise OSError("no such device")

class Blind:
    pass
"""


def test_a_driver_of_the_users_is_opened_by_its_file(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(OWN)
    source = open_named_camera(f"{tmp_path}/mine.py:Mine", SimClock(), WANTED, "vehicle quad")
    received = source.wait(-1, 30.0)
    source.close()
    assert received is not None
    assert received.frame.intrinsics == WANTED
    assert np.all(received.frame.depth_mm == 1234)


def test_in_lockstep_the_camera_is_an_address() -> None:
    asked = StandAloneCompanion.model_validate({"camera": "realsense", "lockstep": True})
    with pytest.raises(FieldError, match=r"in lockstep the address .*tcp://HOST:PORT"):
        check_companion(asked)


@pytest.mark.parametrize(
    ("name", "told"),
    [
        (
            "usb",
            "accepted: tcp://HOST:PORT, ipc://PATH, realsense, oak-d, ros2:/TOPIC, rosbag:PATH, FI",
        ),
        ("udp://1.2.3.4:5", "accepted: tcp://HOST:PORT, ipc://PATH"),
        ("{}/none.py:Mine", "none.py: no such file"),
        ("{}/mine.py:Blind", "a class with a lens and a method read"),
        ("{}/mine.py:Unplugged", "OSError: no such device"),
        ("{}/mine.py:Narrow", r"53 x 41 deg: 25 % of what the camera of vehicle quad sees"),
    ],
)
def test_a_camera_that_cannot_be_opened_is_one_line(name: str, told: str, tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(OWN)
    with pytest.raises(FieldError, match=told) as caught:
        open_named_camera(name.format(tmp_path), SimClock(), WANTED, "vehicle quad")
    assert caught.value.field == "camera"
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "library", "driver", "told"),
    [
        ("oak-d", "depthai", "oak_d", r"needs depthai \(pip install 'airl-mav\[oak\]'\)"),
        ("realsense", "pyrealsense2", "realsense", "needs librealsense"),
    ],
)
def test_a_library_that_is_not_installed_is_named(
    name: str, library: str, driver: str, told: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, library, None)
    monkeypatch.delitem(sys.modules, f"companion.addons.cameras.{driver}", raising=False)
    with pytest.raises(FieldError, match=told) as caught:
        open_named_camera(name, SimClock(), WANTED, "vehicle quad")
    assert "\n" not in str(caught.value)


def test_a_driver_is_refused_where_colour_is_wanted(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(OWN)
    wanted = Intrinsics.of(load_vehicle("quad-rgb").camera)
    told = "drivers give depth images, the camera of vehicle quad-rgb is of kind 'rgb'; accepted"
    with pytest.raises(FieldError, match=told):
        open_named_camera(f"{tmp_path}/mine.py:Unplugged", SimClock(), wanted, "vehicle quad-rgb")
