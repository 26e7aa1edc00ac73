"""The camera's video: real firmware, real MAVSDK as ground station, H.264 decoded by FFmpeg."""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from mavsdk import ComponentType, Configuration, Mavsdk
from mavsdk.plugins.camera import Camera, CameraError, CameraResult, VideoStreamInfo
from numpy.typing import NDArray

from airl_mav.addons.video.command import GIMBAL_PORT, video_words
from airl_mav.addons.video.stream import (
    RtpVideo,
    ShownCamera,
    picture_of,
    picture_size,
    show_video,
)
from airl_mav.camera.frame import Frame, FurtherImage, depth_to_z16
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.core.clock import WallClock
from airl_mav.core.errors import EXIT_INTERRUPTED, FieldError, UsageError
from airl_mav.profiles.vehicle import load_vehicle
from airl_mav.scenario.model import Scenario
from firmware_sim.mavlink.px4_links import GIMBAL_PORTS
from firmware_sim.plant.camera import CameraServer
from tests.support.command_line import airl
from tests.support.ports import TestPorts, choose_ports
from tests.support.processes import SITL_WITHOUT_REPORT, Running, running, wait_until

RANGE_M = 20.0

SDP = """v=0
o=- 0 0 IN IP4 127.0.0.1
s=camera
c=IN IP4 127.0.0.1
t=0 0
m=video {port} RTP/AVP 96
a=rtpmap:96 H264/90000
"""
"""Session description for a player (RFC 4566); the key frames contain the parameter sets."""


def depth_frame(depth_m: NDArray[np.floating], sequence: int = 0) -> Frame:
    height, width = depth_m.shape
    lens = Intrinsics.from_fov(width, height, 1.5)
    return Frame(sequence, 0, depth_to_z16(depth_m), lens)


def udp_port() -> int:
    """Return an even port, free for RTP, with the next one free for RTCP."""
    while True:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as first:
            first.bind(("127.0.0.1", 0))
            port = int(first.getsockname()[1])
            if port % 2 == 0 and port < 65_000:
                return port


def watched(folder: Path, port: int, least: int) -> list[NDArray[np.uint8]]:
    """Return the first pictures of a stream, RGB (h, w, 3)."""
    file = folder / "camera.sdp"
    file.write_text(SDP.format(port=port), "ascii")
    options = {"protocol_whitelist": "file,udp,rtp", "stimeout": "30000000"}
    with av.open(str(file), options=options) as container:
        found = []
        for picture in container.decode(video=0):
            found.append(picture.to_ndarray(format="rgb24"))
            if len(found) == least:
                break
        return found


def test_near_is_bright_and_nothing_is_black() -> None:
    depth = np.linspace(0.5, RANGE_M, 64)[None, :].repeat(48, axis=0)
    depth[0, 0] = 0.0
    picture = picture_of(depth_frame(depth), RANGE_M)
    assert picture.shape == (240, 320, 3)
    assert (picture[:5, :5] == 0).all()
    row = picture[100, ::5, 0].astype(int)
    assert (np.diff(row) <= 0).all()
    assert row[0] > 200
    assert 30 <= row[-1] < 40  # far is still distinct from no return


@pytest.mark.parametrize(("width", "height"), [(64, 48), (321, 241), (640, 480), (9, 7), (360, 1)])
def test_pictures_have_even_sides_and_the_size_that_is_told(width: int, height: int) -> None:
    frame = depth_frame(np.full((height, width), 3.0))
    picture = picture_of(frame, RANGE_M)
    assert picture.shape[1::-1] == picture_size(frame.intrinsics)
    assert picture.shape[0] % 2 == 0
    assert picture.shape[1] % 2 == 0
    assert picture.shape[1] >= 320


def test_colours_stay_what_they_are() -> None:
    image = np.zeros((48, 64, 3), np.uint8)
    image[:, 32:] = (200, 100, 50)
    lens = Intrinsics.from_fov(64, 48, 1.5, kind="rgb")
    picture = picture_of(Frame(0, 0, image, lens), RANGE_M)
    np.testing.assert_array_equal(picture[::5, ::5], image)


def test_a_player_sees_what_was_sent(tmp_path: Path) -> None:
    """A player that joins late sees a picture within a second of video, and the right one."""
    port = udp_port()
    depth = np.full((48, 64), 15.0)
    depth[10:30, 20:40] = 2.0
    picture = picture_of(depth_frame(depth), RANGE_M)
    video = RtpVideo("127.0.0.1", port, (320, 240), 20.0)
    stop = threading.Event()

    def send() -> None:
        sent = 0
        while not stop.wait(0.02):
            video.show(picture, sent * 50_000)
            sent += 1

    sending = threading.Thread(target=send)
    sending.start()
    try:
        found = watched(tmp_path, port, 3)
    finally:
        stop.set()
        sending.join()
        video.close()
    assert found[-1].shape == picture.shape
    difference = np.abs(found[-1].astype(int) - picture.astype(int))
    assert difference.mean() < 3.0
    assert abs(int(found[-1][100, 150, 0]) - int(picture[100, 150, 0])) < 10


def test_a_further_camera_is_shown_by_its_name(tmp_path: Path) -> None:
    """The grey image of a rig, which is twice as bright on its right."""
    port, stop = udp_port(), threading.Event()
    grey = np.full((48, 64, 1), 60, np.uint8)
    grey[:, 32:] = 180
    further = {"down": FurtherImage(grey, Intrinsics.from_fov(64, 48, 1.4, kind="grey"))}
    vehicle = load_vehicle("quad-rig")
    with contextlib.closing(CameraServer("tcp://127.0.0.1:*")) as server:

        def publish() -> None:
            frames = 0
            while not stop.wait(0.03):
                main = depth_frame(np.full((48, 64), 3.0), frames)
                server.publish(replace(main, further=further))
                frames += 1

        said: list[str] = []
        watcher = ("127.0.0.1", port)

        def show() -> None:
            camera = ShownCamera(server.endpoint, "quad-rig", vehicle, "down")
            show_video(camera, watcher, None, WallClock(), stop, said.append)

        threads = [threading.Thread(target=each) for each in (publish, show)]
        for thread in threads:
            thread.start()
        try:
            seen = watched(tmp_path, port, 3)[-1].astype(int)
        finally:
            stop.set()
            for thread in threads:
                thread.join()
        assert abs(seen[:, :150].mean() - 60) < 8
        assert abs(seen[:, 170:].mean() - 180) < 8
        wrong = ShownCamera(server.endpoint, "quad-rig", vehicle, "up")
        with pytest.raises(FieldError, match="down, left, right"):
            show_video(wrong, watcher, None, WallClock(), stop, said.append)


def test_a_picture_that_is_no_newer_is_left_out() -> None:
    video = RtpVideo("127.0.0.1", udp_port(), (320, 240), 20.0)
    picture = np.zeros((240, 320, 3), np.uint8)
    for time_us in (100, 100, 50, 200_000):  # x264 would refuse a time that it has seen
        video.show(picture, time_us)
    video.close()


def test_a_link_that_carries_nothing_ends_no_video() -> None:
    """The system rejects broadcasts from a socket without SO_BROADCAST."""
    port = udp_port()
    with contextlib.closing(CameraServer("tcp://127.0.0.1:*")) as server:
        said: list[str] = []
        stop = threading.Event()

        def publish() -> None:
            frames = 0
            while not stop.wait(0.02):
                server.publish(depth_frame(np.full((48, 64), 3.0), frames))
                frames += 1

        publishing = threading.Thread(target=publish)
        publishing.start()
        ending = threading.Timer(3.0, stop.set)
        ending.start()
        sent = show_video(
            ShownCamera(server.endpoint, "quad", load_vehicle("quad")),
            ("255.255.255.255", port),
            None,
            WallClock(),
            stop,
            said.append,
        )
        publishing.join()
        ending.join()
    assert sent == 0
    assert sum("cannot be sent" in line for line in said) == 1


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--to", "nowhere"], "--to"),
        (["--to", "127.0.0.1:70000"], "--to"),
        (["--to", "127.0.0.1:65535"], "--to"),
        (["--vehicle", "no-such"], "no-such"),
        (["--connect", "nonsense"], "--connect"),
    ],
)
def test_what_cannot_be_used_is_refused_in_one_line(words: list[str], said: str) -> None:
    with pytest.raises(UsageError) as refused:
        airl("video", *words)
    assert said in str(refused.value)
    assert "\n" not in str(refused.value)


def test_only_a_rehearsal_with_a_socket_has_video() -> None:
    with pytest.raises(FieldError, match="level sitl"):
        video_words(Scenario(level="lockstep"), "127.0.0.1:5600")
    scenario = Scenario()
    ports = scenario.ports.model_copy(update={"camera_port": 0})
    with pytest.raises(FieldError, match="camera port"):
        video_words(scenario.model_copy(update={"ports": ports}), "127.0.0.1:5600")


def test_the_port_is_that_of_the_link_for_a_gimbal() -> None:
    assert GIMBAL_PORTS[1] == GIMBAL_PORT
    scenario = Scenario(firmware="px4")
    real = scenario.real.model_copy(update={"instance": 3})
    words = video_words(scenario.model_copy(update={"real": real}), "127.0.0.1:5600")
    assert words[words.index("--connect") + 1] == f"udpin://127.0.0.1:{GIMBAL_PORT + 3}"


@contextlib.contextmanager
def ground_station(port: int) -> Iterator[Camera]:
    """Return the camera of the vehicle that a ground station hears."""
    mavsdk = Mavsdk(Configuration.create_with_component_type(ComponentType.GROUND_STATION))
    try:
        mavsdk.add_any_connection(f"udpin://127.0.0.1:{port}")
        system = mavsdk.first_autopilot(30.0)
        assert system is not None
        yield Camera(system)
    finally:
        mavsdk.destroy()


@contextlib.contextmanager
def shown(folder: Path, ports: TestPorts, port: int, *more: str) -> Iterator[Running]:
    words = ["-m", "airl_mav.addons.video.command", "--camera", f"tcp://127.0.0.1:{ports.camera}"]
    words += ["--to", f"127.0.0.1:{port}", "--connect", f"udpout://127.0.0.1:{ports.gcs_local}"]
    with running([*words, *more], folder) as video:
        yield video


def ports_of(instance: int) -> tuple[TestPorts, TestPorts]:
    """Return ports for the command line, and where an instance number moves them to, all free."""
    while True:
        ports = choose_ports()
        moved = replace(
            ports,
            api=ports.api + instance,
            api_local=ports.api_local + instance,
            gcs_local=ports.gcs_local + instance,
            camera=ports.camera + instance,
        )
        with contextlib.ExitStack() as held:
            try:
                for kind, number in (
                    (socket.SOCK_STREAM, moved.camera),
                    (socket.SOCK_DGRAM, moved.gcs_local),
                    (socket.SOCK_DGRAM, moved.api_local),
                ):
                    held.enter_context(socket.socket(socket.AF_INET, kind)).bind(
                        ("127.0.0.1", number)
                    )
            except OSError:
                continue
        return ports, moved


def within(seconds: float, look: Any) -> Any:
    """Return what is found, once it is."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        with contextlib.suppress(CameraError):
            if found := look():
                return found
        time.sleep(0.1)
    raise AssertionError("not in time")


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.xdist_group("flight")
@pytest.mark.timeout(300)
@pytest.mark.parametrize("instance", [pytest.param(0, marks=pytest.mark.nightly), 2])
def test_a_ground_station_finds_the_camera_and_its_video(tmp_path: Path, instance: int) -> None:
    ports, moved = ports_of(instance)
    port = udp_port()
    vehicle, watcher = tmp_path / "vehicle", tmp_path / "watcher"
    vehicle.mkdir()
    watcher.mkdir()
    words = ["-m", "airl_mav.cli.firmware_command", "--arena", "static-obstacles", *ports.options()]
    with running([*words, "--instance", str(instance)], vehicle) as firmware:
        wait_until(lambda: "Ctrl-C ends it" in firmware.text(), "the vehicle")
        with (
            shown(watcher, moved, port) as video,
            ground_station(ports.gcs) as camera,
        ):
            (found,) = within(30.0, lambda: camera.camera_list().cameras)
            assert found.component_id == 100
            assert found.vendor_name == "airl-mav"
            assert found.model_name == "quad depth"

            def info() -> VideoStreamInfo | None:
                told = camera.get_video_stream_info(100)
                return told if told.settings.uri else None

            told = within(10.0, info)
            assert told.settings.uri == str(port)
            assert told.settings.horizontal_resolution_pix == 320
            assert told.settings.horizontal_fov_deg == pytest.approx(90.0)
            pictures = watched(watcher, port, 10)
            assert pictures[-1].shape == (240, 320, 3)
            # Level on the ground: near ground below, at its bottom brightest, sky above.
            assert pictures[-1][230:].mean() > 150.0 > 30.0 > pictures[-1][:60].mean()
            camera.stop_video_streaming(100, 1)
            with pytest.raises(CameraError) as refused:
                camera.take_photo(100)
            assert refused.value.result == CameraResult.ACTION_UNSUPPORTED
            assert silent(port)
            camera.start_video_streaming(100, 1)
            assert watched(watcher, port, 2)
            video.interrupt()
            assert video.wait(20.0) == 0, video.text()
            assert "pictures sent" in video.text()


def silent(port: int) -> bool:
    """Return whether no RTP comes for a second, after what was under way."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", port))
        receiver.settimeout(1.0)
        end = time.monotonic() + 10.0
        while time.monotonic() < end:
            try:
                receiver.recv(4096)
            except TimeoutError:
                return True
    return False


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.xdist_group("rehearsal")
@pytest.mark.timeout(300)
def test_a_rehearsal_shows_its_camera_and_takes_the_video_along_when_it_ends(
    tmp_path: Path,
) -> None:
    ports, port = choose_ports(), udp_port()
    words = [*SITL_WITHOUT_REPORT, *ports.options(), "--video", f"127.0.0.1:{port}"]
    with running([*words, "--out", str(tmp_path / "run")], tmp_path) as rehearsal:
        rehearsal.find_children("firmware", "companion")
        assert watched(tmp_path, port, 20)[-1].shape == (240, 320, 3)
        rehearsal.interrupt()
        assert rehearsal.wait(60.0) == EXIT_INTERRUPTED, rehearsal.text()
        rehearsal.no_child_left()
    assert silent(port)
