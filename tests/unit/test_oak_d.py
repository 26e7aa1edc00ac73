"""OAK-D cameras: depthai itself, with nodes of the host's in place of the device."""

from __future__ import annotations

import queue
import subprocess
import sys
from collections.abc import Callable, Iterator
from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.core.clock import WallClock
from airl_mav.core.errors import FieldError
from airl_mav.profiles.vehicle import load_vehicle
from companion.addons.cameras.drivers import CameraThread, DepthImage
from companion.addons.cameras.fitting import Fitting, Lens
from companion.frame_source import open_named_camera

oak_d = pytest.importorskip("companion.addons.cameras.oak_d")  # No wheels for all that we run on.
dai = oak_d.dai

ROOT = Path(__file__).parents[2]

NOW = timedelta(hours=3)
INTRINSICS = [[441.25, 0.0, 318.0], [0.0, 441.5, 203.0], [0.0, 0.0, 1.0]]
LENS = Lens(640, 400, 441.25, 441.5, 318.0, 203.0)


class Matcher(dai.node.ThreadedHostNode):  # type: ignore[misc, name-defined]
    """Sends the frames that the test makes, as the camera's StereoDepth would."""

    def __init__(self) -> None:
        super().__init__()
        self.depth = self.createOutput()
        self.frames: queue.SimpleQueue[Any] = queue.SimpleQueue()

    def run(self) -> None:
        while self.isRunning():
            try:
                self.depth.send(self.frames.get(timeout=0.02))
            except queue.Empty:
                continue


def frame(
    mm: int | NDArray[np.uint16], number: int = 0, age: timedelta = timedelta(), **kind: Any
) -> Any:
    """Return a depth frame as depthai makes them: RAW16, with the intrinsics of its image."""
    pixels = np.full((400, 640), mm, np.uint16) if isinstance(mm, int) else mm
    made = dai.ImgFrame()
    made.setTransformation(kind.get("about", dai.ImgTransformation(640, 400, INTRINSICS)))
    made.setCvFrame(pixels, kind.get("type", dai.ImgFrame.Type.RAW16))
    made.setSequenceNum(number)
    made.setTimestamp(NOW - age)
    return made


Opener = Callable[..., Any]


@pytest.fixture
def opened() -> Iterator[Opener]:
    """Return what opens a camera whose first frame is the one given."""
    cameras = []

    def open_it(first: Any) -> Any:
        pipeline = dai.Pipeline(False)
        matcher = pipeline.create(Matcher)
        matcher.frames.put(first)
        camera = oak_d.OakD("oak-d", pipeline, matcher.depth, lambda: NOW)
        cameras.append(camera)
        return camera, matcher

    yield open_it
    for camera in cameras:
        camera.close()


def taken(camera: Any) -> DepthImage:
    image: DepthImage | None = camera.read(5.0)
    assert image is not None
    return image


def test_depth_in_millimetres_with_its_age_its_number_and_the_devices_own_lens(
    opened: Opener,
) -> None:
    camera, matcher = opened(frame(4000, 7, timedelta(milliseconds=40)))
    assert camera.lens == LENS
    first = taken(camera)
    assert first.depth_mm.shape == (400, 640)
    assert first.depth_mm.dtype == np.uint16
    assert np.all(first.depth_mm == 4000)
    assert (first.age_us, first.number) == (40_000, 7)
    assert camera.read(0.01) is None
    matcher.frames.put(frame(1234, 8, timedelta(milliseconds=55)))
    second = taken(camera)
    assert np.all(second.depth_mm == 1234)
    assert (second.age_us, second.number) == (55_000, 8)
    assert np.all(first.depth_mm == 4000), "an image stays what it was"


@pytest.mark.parametrize("age", [timedelta(milliseconds=-1), timedelta(days=1)])
def test_a_stamp_of_another_clock_says_nothing_of_the_age(opened: Opener, age: timedelta) -> None:
    camera, _ = opened(frame(1000, age=age))
    assert taken(camera).age_us == 0


def test_images_that_were_lost_are_counted_and_the_policy_gets_the_size_of_its_card(
    opened: Opener,
) -> None:
    thin = np.full((400, 640), 9000, np.uint16)
    thin[::2] = 0  # Holes of the matcher.
    thin[200, 320] = 1500
    camera, matcher = opened(frame(thin, 3))
    wanted = Intrinsics.of(load_vehicle("quad-oak-d").camera)
    fitting = Fitting(camera.lens, wanted)
    assert fitting.coverage > 0.95
    source = CameraThread("oak-d", camera, WallClock(), fitting)
    received = source.wait(-1, 30.0)
    assert received is not None
    assert received.frame.intrinsics == wanted
    assert set(np.unique(received.frame.depth_mm[2:-2, 2:-2])) == {1500, 9000}
    matcher.frames.put(frame(8000, 6))
    received = source.wait(0, 30.0)
    assert received is not None
    assert np.all(received.frame.depth_mm[2:-2, 2:-2] == 8000)
    assert source.dropped == 2
    assert source.failure is None
    source.close()


@pytest.mark.parametrize(
    ("first", "told"),
    [
        ({"about": dai.ImgTransformation()}, "without intrinsics: the device is not calibrated"),
        ({"type": dai.ImgFrame.Type.GRAY8}, "an image of type GRAY8; accepted: RAW16"),
    ],
)
def test_what_is_no_depth_camera_is_refused_in_one_line(
    opened: Opener, first: dict[str, Any], told: str
) -> None:
    pixels = np.full((400, 640), 9, np.uint8 if "type" in first else np.uint16)
    with pytest.raises(FieldError, match=told) as caught:
        opened(frame(pixels, **first))
    assert caught.value.field == "camera"
    assert "\n" not in str(caught.value)


def test_a_camera_that_is_unplugged_fails(opened: Opener) -> None:
    camera, _ = opened(frame(1000))
    taken(camera)
    for _ in range(4999):
        camera._silence.lasted(0.001)
    with pytest.raises(RuntimeError, match="no image for 5 s"):
        camera.read(0.002)
    camera.close()
    with pytest.raises(RuntimeError, match="the connection is closed"):
        camera.read(0.01)


def test_a_camera_that_is_not_there_is_one_line() -> None:
    if dai.Device.getAllAvailableDevices():
        pytest.skip("there is one")
    for name in ("oak-d", "oak-d:1944301001564D1300"):
        with pytest.raises(FieldError, match=f"{name}.: depthai finds no camera"):
            open_named_camera(name, WallClock(), Intrinsics.from_fov(64, 48, 1.2), "vehicle quad")


def test_depthai_takes_no_signals_over(tmp_path: Path) -> None:
    """A file that may not grow is an error of that file, as without depthai."""
    code = (
        "import resource, companion.addons.cameras.oak_d\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (10, 10))\n"
        "try: open('log', 'wb', buffering=0).write(b'x' * 11) == 10 and open('log', 'ab', "
        "buffering=0).write(b'x')\n"
        "except OSError as error: print(error.strerror)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=tmp_path,
        env={"PYTHONPATH": str(ROOT), "PATH": ""},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert (done.returncode, done.stdout.splitlines()[-1:]) == (0, ["File too large"]), done.stderr
