"""RealSense cameras: librealsense itself, with its software device in place of the hardware."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.core.clock import SimClock
from airl_mav.core.errors import FieldError
from companion.addons.cameras.fitting import Fitting, Lens
from companion.frame_source import open_named_camera

# No wheels for all that we run on; where there is one it wants the system's libusb.
rs = pytest.importorskip("pyrealsense2", exc_type=ImportError)
realsense = pytest.importorskip("companion.addons.cameras.realsense")

NOW_US = 1_800_000_000_000_000


class SoftwareCamera:
    """A device of librealsense's whose images the test makes."""

    def __init__(self, *sizes: tuple[int, int], unit_m: float = 0.001) -> None:
        self.device = rs.software_device()
        self.sensor = self.device.add_sensor("Stereo Module")
        self.sensor.add_read_only_option(rs.option.depth_units, unit_m)
        self.unit_m = unit_m
        self.profiles = {}
        for k, (width, height) in enumerate(sizes):
            stream = rs.video_stream()
            stream.type, stream.fmt, stream.index, stream.uid = rs.stream.depth, rs.format.z16, 0, k
            stream.width, stream.height, stream.fps, stream.bpp = width, height, 30, 2
            lens = rs.intrinsics()
            lens.width, lens.height, lens.model = width, height, rs.distortion.brown_conrady
            lens.fx, lens.fy, lens.ppx, lens.ppy = 425.0, 426.0, width / 2, height / 2
            stream.intrinsics = lens
            profile = self.sensor.add_video_stream(stream)
            self.profiles[width] = profile.as_video_stream_profile()

    def take(self, number: int, pixels: NDArray[np.uint16], stamp_ms: float, domain: Any) -> None:
        frame = rs.software_video_frame()
        frame.pixels, frame.bpp, frame.stride = pixels, 2, 2 * pixels.shape[1]
        frame.timestamp, frame.frame_number, frame.domain = stamp_ms, number, domain
        frame.profile, frame.depth_units = self.profiles[pixels.shape[1]], self.unit_m
        self.sensor.on_video_frame(frame)


def image(mm: int, width: int = 848, height: int = 480) -> NDArray[np.uint16]:
    return np.full((height, width), mm, np.uint16)


def test_the_widest_matching_stream_is_read_newest_only_with_its_age() -> None:
    software = SoftwareCamera((640, 480), (848, 480), (1280, 720))
    camera = realsense.RealSense(software.device, lambda: NOW_US)
    assert camera.lens == Lens(848, 480, 425.0, 426.0, 424.0, 240.0)
    assert camera.read(0.01) is None
    system = rs.timestamp_domain.system_time
    software.take(1, image(1000), NOW_US / 1000 - 90.0, system)
    software.take(2, image(2000), NOW_US / 1000 - 40.0, system)
    newest = camera.read(5.0)
    assert newest is not None
    assert newest.depth_mm.shape == (480, 848)
    assert newest.depth_mm.dtype == np.uint16
    assert np.all(newest.depth_mm == 2000)
    assert abs(newest.age_us - 40_000) <= 1
    camera.close()


@pytest.mark.parametrize(
    ("stamp_ms", "domain"),
    [
        (1234.5, "hardware_clock"),
        (NOW_US / 1000 + 50.0, "global_time"),  # The calendar was set back.
        (NOW_US / 1000 - 86_400_000.0, "system_time"),  # A recording of yesterday.
    ],
)
def test_a_stamp_of_another_clock_says_nothing_of_the_age(stamp_ms: float, domain: str) -> None:
    software = SoftwareCamera((848, 480))
    camera = realsense.RealSense(software.device, lambda: NOW_US)
    software.take(1, image(1000), stamp_ms, getattr(rs.timestamp_domain, domain))
    taken = camera.read(5.0)
    assert taken is not None
    assert taken.age_us == 0
    camera.close()


def test_other_units_become_millimetres() -> None:
    software = SoftwareCamera((848, 480), unit_m=0.0001)
    camera = realsense.RealSense(software.device, lambda: NOW_US)
    pixels = image(12_344)
    pixels[0, :3] = 0, 65_532, 4
    software.take(1, pixels, 0.0, rs.timestamp_domain.hardware_clock)
    taken = camera.read(5.0)
    assert taken is not None
    assert taken.depth_mm[0, :4].tolist() == [0, 6553, 0, 1234]
    camera.close()


def test_an_image_stays_what_it_was_when_the_next_one_comes() -> None:
    software = SoftwareCamera((848, 480))
    camera = realsense.RealSense(software.device, lambda: NOW_US)
    kept = []
    for number in range(1, 40):
        software.take(number, image(number), 0.0, rs.timestamp_domain.hardware_clock)
        taken = camera.read(5.0)
        assert taken is not None
        kept.append(taken.depth_mm)
    assert [int(each.min()) for each in kept] == list(range(1, 40))
    assert [int(each.max()) for each in kept] == list(range(1, 40))
    camera.close()


def test_a_camera_that_was_unplugged_fails_after_five_seconds() -> None:
    camera = realsense.RealSense(SoftwareCamera((848, 480)).device, lambda: NOW_US)
    for _ in range(4999):
        assert camera.read(0.001) is None
    with pytest.raises(RuntimeError, match="no image for 5 s"):
        camera.read(0.002)
    camera.close()


def test_what_a_d435_sees_is_what_the_profile_of_it_sees() -> None:
    software = SoftwareCamera((848, 480))
    camera = realsense.RealSense(software.device, lambda: NOW_US)
    fitting = Fitting(camera.lens, Intrinsics.from_fov(64, 36, np.radians(87.0)))
    assert fitting.coverage > 0.95
    camera.close()


def test_no_camera_and_no_file_are_one_line() -> None:
    with pytest.raises(FieldError, match=r"realsense:none\.bag.: no such file"):
        realsense.open_realsense("none.bag")
    if not list(rs.context().query_devices()):
        for name in ("realsense", "realsense:0123"):
            with pytest.raises(FieldError, match=f"{name}.: librealsense finds no camera"):
                open_named_camera(
                    name, SimClock(), Intrinsics.from_fov(64, 48, 1.5), "vehicle quad"
                )


def test_a_device_without_depth_is_refused() -> None:
    device = rs.software_device()
    device.add_sensor("RGB")
    with pytest.raises(FieldError, match="no depth stream"):
        realsense.RealSense(device)
