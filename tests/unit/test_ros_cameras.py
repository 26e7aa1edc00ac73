"""Depth images of ROS 2: messages, a topic over real DDS from another process, and a recording."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.core.clock import SimClock, WallClock
from airl_mav.core.errors import FieldError, UsageError
from companion.addons.cameras.fitting import Lens
from companion.addons.cameras.rosbag import age_us, depth_mm, info_topic, lens_of
from companion.frame_source import open_named_camera
from tests.support.processes import ROOT

K = (57.5, 0.0, 39.5, 0.0, 58.5, 29.5, 0.0, 0.0, 1.0)
P = (50.0, 0.0, 40.0, 0.0, 0.0, 51.0, 30.0, 0.0, 0.0, 0.0, 1.0, 0.0)
LENS = Lens(80, 60, 57.5, 58.5, 39.5, 29.5)
WANTED = Intrinsics.from_fov(16, 12, np.deg2rad(60.0))


def image_of(pixels: NDArray[Any], encoding: str, **more: Any) -> SimpleNamespace:
    height, width = pixels.shape
    fields = {
        "header": SimpleNamespace(stamp=SimpleNamespace(sec=10, nanosec=250_000_999)),
        "height": height,
        "width": width,
        "encoding": encoding,
        "is_bigendian": 0,
        "step": width * pixels.itemsize,
        "data": pixels.tobytes(),
    }
    return SimpleNamespace(**{**fields, **more})


def info_of(**more: Any) -> SimpleNamespace:
    fields = {"width": 80, "height": 60, "d": [0.0] * 5, "k": K, "p": P}
    fields["distortion_model"] = "plumb_bob"
    fields |= {"binning_x": 0, "binning_y": 1, "roi": SimpleNamespace(width=0, height=0)}
    return SimpleNamespace(**{**fields, **more})


# --- messages ------------------------------------------------------------------------------------


@pytest.mark.parametrize("order", ["<", ">"])
def test_millimetres_are_taken_as_they_are(order: str) -> None:
    mm = np.array([[0, 1, 258], [5000, 65_534, 65_535]], f"{order}u2")
    message = image_of(mm, "16UC1", is_bigendian=int(order == ">"))
    np.testing.assert_array_equal(depth_mm(message), mm.astype(np.uint16))
    assert depth_mm(message).dtype == np.uint16


@pytest.mark.parametrize("order", ["<", ">"])
def test_metres_become_millimetres_and_what_is_no_depth_no_return(order: str) -> None:
    metres = np.array([[1.2344, 0.0004, 0.0006, np.nan], [np.inf, -np.inf, -1.0, 1e9]])
    message = image_of(metres.astype(f"{order}f4"), "32FC1", is_bigendian=int(order == ">"))
    assert depth_mm(message).tolist() == [[1234, 0, 1, 0], [0, 0, 0, 65_535]]


def test_rows_may_be_padded() -> None:
    padded = np.arange(24, dtype="<u2").reshape(3, 8)
    message = image_of(padded, "mono16", width=5)
    message.step = 16
    np.testing.assert_array_equal(depth_mm(message), padded[:, :5])


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"encoding": "rgb8"}, "encoding 'rgb8'; accepted: 16UC1, mono16, 32FC1"),
        ({"step": 3}, "in rows of 3 bytes"),
        ({"height": 3}, "are not 8 bytes"),
        ({"data": b""}, "are not 0 bytes"),
        ({"width": 0}, "0 x 2 pixels"),
    ],
)
def test_what_is_no_depth_image_is_refused(change: dict[str, Any], problem: str) -> None:
    with pytest.raises(ValueError, match=problem):
        depth_mm(image_of(**{"pixels": np.ones((2, 2), "<u2"), "encoding": "16UC1", **change}))


def test_a_lens_is_that_of_the_images_that_are_sent() -> None:
    assert lens_of(info_of()) == LENS
    assert lens_of(info_of(d=[])) == LENS
    # With distortion only its rectified images are a pinhole's, and P describes those.
    assert lens_of(info_of(d=[0.1, 0.0])) == Lens(80, 60, 50.0, 51.0, 40.0, 30.0)
    # A fisheye's own images are described by K and D, its rectified ones by P.
    bent = info_of(d=[-0.05, 0.008, -0.004, 0.0], distortion_model="equidistant")
    assert lens_of(bent, "/wide/depth/image_raw") == replace(
        LENS, distortion=(-0.05, 0.008, -0.004, 0.0)
    )
    rectified = Lens(80, 60, 50.0, 51.0, 40.0, 30.0)
    assert lens_of(bent, "/rect/depth/image_rect_raw") == rectified
    whole = SimpleNamespace(width=80, height=60)
    assert lens_of(info_of(roi=whole)) == LENS


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"k": (0.0,) * 9}, "no pinhole"),
        ({"k": (np.nan,) * 9}, "no pinhole"),
        ({"d": [0.1], "distortion_model": "equidistant"}, "accepted: four numbers from -100"),
        ({"d": [0.1, 0, 0, np.nan], "distortion_model": "equidistant"}, "accepted: four"),
        ({"binning_x": 2}, "binned or cropped"),
        ({"roi": SimpleNamespace(width=40, height=60)}, "binned or cropped"),
    ],
)
def test_what_describes_no_camera_of_ours_is_refused(change: dict[str, Any], problem: str) -> None:
    with pytest.raises(ValueError, match=problem):
        lens_of(info_of(**change))


def test_age_is_by_the_calendar_unless_the_stamp_is_of_another_clock() -> None:
    message = image_of(np.ones((1, 1), "<u2"), "16UC1")
    assert age_us(message, 10_300_000) == 50_000
    assert age_us(message, 10_250_000) == 0
    assert age_us(message, 10_249_000) == 0, "from the future"
    assert age_us(message, 12_000_000) == 0, "of a simulation's clock, or a recording"


def test_a_camera_is_described_beside_its_images() -> None:
    assert info_topic("/camera/depth/image_rect_raw") == "/camera/depth/camera_info"
    assert info_topic("/image") == "/camera_info"


# --- over DDS ------------------------------------------------------------------------------------

PUBLISHER = """
import sys, json, time
from cyclonedds.core import Policy, Qos
from cyclonedds.pub import DataWriter
from cyclonedds.topic import Topic
from companion.addons.cameras import ros2
topic, described = sys.argv[1:]
participant = ros2._participant()
reliable = Qos(Policy.Reliability.Reliable(0), Policy.History.KeepLast(5))
info = DataWriter(participant, Topic(participant, "rt" + described, ros2.CameraInfo), qos=reliable)
images = DataWriter(participant, Topic(participant, "rt" + topic, ros2.Image), qos=reliable)
k, p = json.loads(sys.stdin.readline())
roi = ros2.RegionOfInterest(0, 0, 0, 0, False)
count = 0
while True:
    now = time.time_ns()
    header = ros2.Header(ros2.Time(now // 10**9, now % 10**9), "camera_depth_optical_frame")
    info.write(ros2.CameraInfo(header, 60, 80, "plumb_bob", [0.0] * 5, k, k, p, 0, 0, roi))
    pixels = (1000 + 10 * count).to_bytes(2, "little") * 80 * 60
    images.write(ros2.Image(header, 60, 80, "16UC1", 0, 160, pixels))
    count += 1
    time.sleep(0.03)
"""


@pytest.fixture
def domain(monkeypatch: pytest.MonkeyPatch) -> int:
    pytest.importorskip("cyclonedds", reason="has no wheel for every machine")
    monkeypatch.setenv("ROS_LOCALHOST_ONLY", "1")
    monkeypatch.delenv("CYCLONEDDS_URI", raising=False)
    # Names of topics keep apart those that share a domain.
    number = 1 + os.getpid() % 100
    monkeypatch.setenv("ROS_DOMAIN_ID", str(number))
    return number


@pytest.fixture
def topic(domain: int) -> Iterator[str]:
    """A topic that another process publishes, in a domain of this computer alone."""
    name = f"/test_{os.getpid()}_{domain}/depth/image_rect_raw"
    with subprocess.Popen(
        [sys.executable, "-c", PUBLISHER, name, info_topic(name)],
        stdin=subprocess.PIPE,
        text=True,
        cwd=ROOT,
    ) as publisher:
        assert publisher.stdin is not None
        publisher.stdin.write(json.dumps([K, P]) + "\n")
        publisher.stdin.flush()
        yield name
        publisher.kill()


def test_a_topic_of_another_process_is_a_camera(topic: str) -> None:
    camera = open_named_camera(f"ros2:{topic}", WallClock(), WANTED, "vehicle mine")
    try:
        first = camera.wait(-1, 20.0)
        assert first is not None, camera.failure
        later = camera.wait(first.frame.sequence, 20.0)
        assert later is not None, camera.failure
        for received in (first, later):
            image = received.frame.depth_mm
            assert image.shape == (12, 16)
            assert np.unique(image).size == 1
            # It is stamped when it was taken: some time ago, by the calendar of both.
            assert 0 < received.received_us - received.frame.capture_time_us < 1_000_000
        assert later.frame.depth_mm[0, 0] > first.frame.depth_mm[0, 0] >= 1000
    finally:
        camera.close()


def test_a_topic_that_falls_silent_has_failed(topic: str) -> None:
    from companion.addons.cameras import ros2

    camera = ros2.Ros2Camera(topic)
    heard, silent = camera._images, camera._reader("/nobody/image", ros2.Image)
    try:
        camera._images = silent
        for _ in range(4):
            camera._silence.lasted(1.2)
        camera._images = heard
        while camera.read(1.0) is None:
            pass
        # An image resets the timeout.
        camera._images = silent
        assert camera.read(0.01) is None
        camera._silence.lasted(4.9)
        with pytest.raises(RuntimeError, match="no image for 5 s"):
            camera.read(0.2)
    finally:
        camera.close()


def test_a_topic_that_nobody_describes_is_one_line(
    domain: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    from companion.addons.cameras import ros2

    monkeypatch.setattr(ros2, "DESCRIBED_S", 0.2)
    line = rf"no sensor_msgs/CameraInfo on /nobody/camera_info .*ROS_DOMAIN_ID {domain}"
    with pytest.raises(FieldError, match=line):
        open_named_camera("ros2:/nobody/image", WallClock(), WANTED, "vehicle mine")


@pytest.mark.usefixtures("domain")
@pytest.mark.parametrize("told", ["233", "-1", "one"])
def test_a_domain_that_is_none_is_one_line(told: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", told)
    with pytest.raises(UsageError, match=f"ROS_DOMAIN_ID {told}: accepted: .* 0 to 232"):
        open_named_camera("ros2:/a/image", WallClock(), WANTED, "vehicle mine")


def test_cyclone_dds_and_rosbags_write_a_message_alike() -> None:
    """Two implementations of the same encoding, of the DDS foundation and of ROS' recordings."""
    pytest.importorskip("cyclonedds", reason="has no wheel for every machine")
    from rosbags.typesys import Stores, get_typestore

    from companion.addons.cameras import ros2

    store = get_typestore(Stores.ROS2_HUMBLE)
    kind = store.types
    header = ros2.Header(ros2.Time(7, 8), "optical")
    image: Any = ros2.Image
    ours = image(header, 1, 2, "16UC1", 0, 4, b"\x01\x02\x03\x04").serialize()
    theirs = store.serialize_cdr(
        kind["sensor_msgs/msg/Image"](
            kind["std_msgs/msg/Header"](kind["builtin_interfaces/msg/Time"](7, 8), "optical"),
            *(1, 2, "16UC1", 0, 4, np.array([1, 2, 3, 4], np.uint8)),
        ),
        "sensor_msgs/msg/Image",
    )
    # Cyclone DDS fills up to four bytes, and says by how many.
    assert bytes(ours)[4 : len(theirs)] == bytes(theirs)[4:]


# --- recordings ----------------------------------------------------------------------------------

START_NS = 1_700_000_000_000_000_000
PERIOD_NS = 33_000_000


def recording(folder: Path, topics: dict[str, str], described: bool = True) -> Path:
    """Write a recording of ten images on each topic, with this encoding, 40 ms old on arrival."""
    pytest.importorskip("rosbags", reason="needs the [ros2] extra")
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    kind = store.types
    image_type, info_type = (f"sensor_msgs/msg/{name}" for name in ("Image", "CameraInfo"))
    roi = kind["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
    with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        for topic, encoding in topics.items():
            images = bag.add_connection(topic, image_type, typestore=store)
            infos = (
                bag.add_connection(info_topic(topic), info_type, typestore=store)
                if described
                else None
            )
            for i in range(10):
                at_ns = START_NS + i * PERIOD_NS
                taken_ns = at_ns - 40_000_000
                stamp = kind["builtin_interfaces/msg/Time"](
                    taken_ns // 1_000_000_000, taken_ns % 1_000_000_000
                )
                header = kind["std_msgs/msg/Header"](stamp, "optical")
                size = 3 if encoding == "rgb8" else 2
                pixels = np.full((60, 80), 1000 + i, "<u2").view(np.uint8).ravel()
                data = np.resize(pixels, 60 * 80 * size)
                image = kind[image_type](header, 60, 80, encoding, 0, 80 * size, data)
                bag.write(images, at_ns, store.serialize_cdr(image, image_type))
                if infos is not None:
                    info = kind[info_type](
                        *(header, 60, 80, "plumb_bob", np.zeros(5), np.array(K)),
                        *(np.array(K), np.array(P), 0, 0, roi),
                    )
                    bag.write(infos, at_ns, store.serialize_cdr(info, info_type))
    return folder


def test_a_recording_is_played_at_its_own_pace(tmp_path: Path) -> None:
    bag = recording(
        tmp_path / "bag",
        {"/camera/depth/image_rect_raw": "16UC1", "/camera/color/image_raw": "rgb8"},
    )
    from companion.addons.cameras.rosbag import RosBag

    clock = SimClock(5_000_000)
    camera = RosBag(str(bag), clock)
    assert camera.lens == LENS
    times, values = [], []
    with pytest.raises(RuntimeError, match="the recording is over"):
        while True:
            image = camera.read(0.01)
            if image is not None:
                times.append(clock.time_us() - 5_000_000)
                values.append(int(image.depth_mm[0, 0]))
                assert image.age_us == 40_000
    camera.close()
    assert values == list(range(1000, 1010))
    assert times == [i * 33_000 for i in range(10)]


def test_a_recording_is_a_camera_by_its_name(tmp_path: Path) -> None:
    bag = recording(tmp_path / "bag", {"/a/image": "16UC1", "/b/image": "16UC1"})
    camera = open_named_camera(f"rosbag:{bag}:/b/image", WallClock(), WANTED, "vehicle mine")
    received = camera.wait(-1, 20.0)
    camera.close()
    assert received is not None
    assert set(np.unique(received.frame.depth_mm)) <= set(range(1000, 1010))


@pytest.mark.parametrize(
    ("topics", "described", "which", "line"),
    [
        ({"/a/image": "16UC1", "/b/image": "16UC1"}, True, "", "bag:/a/image or rosbag:.*:/b/im"),
        ({"/a/image": "16UC1"}, True, ":/c/image", "accepted: rosbag:.*bag:/a/image"),
        ({"/a/image": "rgb8"}, True, "", "no depth images"),
        ({"/a/image": "16UC1"}, False, "", "no sensor_msgs/CameraInfo on /a/camera_info"),
    ],
)
def test_a_recording_that_is_no_camera_is_one_line(
    tmp_path: Path, topics: dict[str, str], described: bool, which: str, line: str
) -> None:
    bag = recording(tmp_path / "bag", topics, described)
    with pytest.raises(FieldError, match=line):
        open_named_camera(f"rosbag:{bag}{which}", WallClock(), WANTED, "vehicle mine")


@pytest.mark.parametrize(
    ("name", "line"),
    [
        ("rosbag:/no/such/bag", "/no/such/bag: no such recording"),
        ("rosbag:", "ros2:/TOPIC or rosbag:PATH"),
        ("ros2:camera/image", "ros2:/TOPIC or rosbag:PATH"),
    ],
)
def test_a_name_that_is_none_is_one_line(name: str, line: str) -> None:
    pytest.importorskip("rosbags", reason="needs the [ros2] extra")
    with pytest.raises(FieldError, match=line):
        open_named_camera(name, WallClock(), WANTED, "vehicle mine")


def test_what_is_no_recording_is_one_line(tmp_path: Path) -> None:
    pytest.importorskip("rosbags", reason="needs the [ros2] extra")
    for path in (tmp_path / "empty", tmp_path / "file.mcap"):
        path.mkdir() if path.suffix == "" else path.write_bytes(b"no recording")
        with pytest.raises(FieldError, match="rosbag:"):
            open_named_camera(f"rosbag:{path}", WallClock(), WANTED, "vehicle mine")
