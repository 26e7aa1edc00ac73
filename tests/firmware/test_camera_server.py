"""Frames from the plant to the companion: timing, content, and dropping of old frames."""

from __future__ import annotations

import math
import pickle
import select
import socket
import subprocess
import sys
from collections.abc import Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import zmq
from numpy.typing import NDArray
from PIL import Image

from airl_mav.addons.colour.picture import render_picture
from airl_mav.arena.geometry import Arena, Bounds, Obstacles, Shape, Tour
from airl_mav.camera.frame import MOST_BYTES, Frame
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.camera.render import Motion, expose
from airl_mav.core.clock import SimClock
from airl_mav.core.constants import TICK_US, US_PER_S
from airl_mav.core.errors import UsageError
from airl_mav.core.frames import quat_from_euler
from airl_mav.profiles.projections import CameraKind
from airl_mav.profiles.vehicle import SensorNoise, load_vehicle
from companion.frame_source import MESSAGES_PER_LOOK, ReceivedFrame, ZmqFrameSource
from firmware_sim.plant.camera import CameraServer, SimulatedCamera
from tests.support.flight_rig import quad

LENS = Intrinsics.from_fov(33, 25, math.pi / 2)
LOOPBACK = "tcp://127.0.0.1:0"


def room(half: float = 20.0, *, pillar_at: float | None = None) -> Arena:
    """Make a square room, with a pillar of 1 m radius to the north or empty."""
    n = 0 if pillar_at is None else 1
    pillars = Obstacles(
        np.full(n, Shape.CYLINDER, np.int8),
        np.array([[pillar_at or 0.0, 0.0, -2.0]])[:n],
        np.array([[1.0, 1.0, 2.0]])[:n],
        np.zeros(n),
    )
    bounds = Bounds(-half, half, -half, half, 5.0)
    return Arena("room", 0, bounds, (0, 0, 0), pillars, (), np.zeros(2))


def camera(
    rate_hz: float = 30.0, arena: Arena | None = None, *, start_us: int = 0, **mount: float
) -> SimulatedCamera:
    lens = {"width_px": 33, "height_px": 25, "horizontal_fov_deg": 90.0, "range_m": 60.0}
    level = {"forward_m": 0.0, "up_m": 0.0, "pitch_up_deg": 0.0}
    profile = quad(camera={**lens, **level, **mount, "rate_hz": rate_hz}).camera
    return SimulatedCamera(profile, arena or room(), start_us)


def take(cam: SimulatedCamera, time_us: int = 0, yaw: float = 0.0) -> Frame:
    return cam.take(time_us, Motion.at_rest(np.array([0.0, 0, -2]), quat_from_euler(0, 0, yaw)))


def frame(sequence: int) -> Frame:
    return Frame(sequence, sequence * 10, np.full((48, 64), sequence, np.uint16), FRAME_LENS)


FRAME_LENS = Intrinsics.from_fov(64, 48, math.pi / 2)


# --- the camera ----------------------------------------------------------------------------------


def test_images_are_drawn_when_they_are_read(monkeypatch: pytest.MonkeyPatch) -> None:
    """Late reads show the exposure's state, in any order and in another process."""
    arena, profile = (
        room(12.0, pillar_at=6.0),
        quad(camera={"width_px": 33, "height_px": 25}).camera,
    )
    north, turned = np.array([0.0, 0.0, -2.0]), quat_from_euler(0, 0, 0.3)
    noise = SensorNoise(depth_noise=0.02)
    cams = [SimulatedCamera(profile, arena, 0, noise, 5) for _ in range(2)]
    times_us = range(0, 400_000, 100_000)
    at_once = []
    for at_us in times_us:
        exposed = cams[0].take(at_us, Motion.at_rest(north + at_us * 1e-6, turned))
        at_once.append((exposed.image.copy(), exposed.capture_time_us, exposed.sequence))
    drawn: list[object] = []

    def drawing(*seen: Any) -> NDArray[Any]:
        drawn.append(seen)
        return expose(*seen)

    monkeypatch.setattr("firmware_sim.plant.camera.expose", drawing)
    frames = [
        cams[1].take(at_us, Motion.at_rest(north + at_us * 1e-6, turned)) for at_us in times_us
    ]
    assert not drawn
    assert len({image.tobytes() for image, *_ in at_once}) == len(at_once)
    for (image, *stamps), late in reversed(list(zip(at_once, frames, strict=True))):
        np.testing.assert_array_equal(late.image, image)
        assert [late.capture_time_us, late.sequence] == stamps
    _ = frames[0].image
    assert len(drawn) == len(frames)
    copied = pickle.loads(pickle.dumps(frames[0]))  # noqa: S301 (our own)
    assert copied.to_bytes() == frames[0].to_bytes()


def test_a_gain_that_follows_the_light_draws_every_image() -> None:
    """Each depends on the one before: a frame that is read has the gain of all of them."""
    slow = {"auto_exposure": {"time_constant_s": 0.5}}
    seen = {"width_px": 33, "height_px": 25, "kind": "grey", "imaging": slow}
    profile, arena = quad(camera=seen).camera, room(12.0, pillar_at=2.0)

    def last(yaws: Sequence[float]) -> Frame:
        cam = SimulatedCamera(profile, arena)
        frames = [take(cam, 400_000 + 33_000 * i, yaw) for i, yaw in enumerate(yaws)]
        return frames[-1]

    image = last([0.0, 1.5, 3.0]).image
    assert not np.array_equal(image, last([3.0]).image)
    cam = SimulatedCamera(profile, arena)
    for i, yaw in enumerate([0.0, 1.5, 3.0]):
        read = take(cam, 400_000 + 33_000 * i, yaw).image
    np.testing.assert_array_equal(image, read)


@pytest.mark.parametrize("rate_hz", [1.0, 7.0, 10.0, 29.97, 30.0, 60.0, 90.0, 125.0])
def test_rate_is_kept_on_average(rate_hz: float) -> None:
    cam, times = camera(rate_hz), []
    for time_us in range(0, 10 * US_PER_S, TICK_US):
        if time_us >= cam.next_us:
            take(cam, time_us)
            times.append(time_us)
    assert len(times) == math.ceil(10 * rate_hz)
    # Every frame within a tick of its nominal time.
    late = np.array(times) - np.arange(len(times)) * US_PER_S / rate_hz
    assert np.all((late >= 0) & (late < TICK_US + 1))


def test_missed_frames_are_not_made_up_for() -> None:
    cam = camera(10.0)
    take(cam, 0)
    assert cam.next_us == 100_000
    take(cam, 350_000)
    assert cam.next_us == 400_000


def test_sequence_counts_frames_and_goes_on_in_the_next_episode() -> None:
    cam = camera()
    assert [take(cam, t).sequence for t in (0, 40_000, 80_000)] == [0, 1, 2]
    cam.restart(1_000_000)
    assert cam.next_us == 1_000_000
    after = take(cam, 1_000_000)
    assert (after.sequence, after.capture_time_us) == (3, 1_000_000)
    assert cam.next_us == 1_033_334


def test_frame_shows_the_arena_in_millimetres() -> None:
    got = take(camera())
    assert got.intrinsics == LENS
    assert got.depth_mm.shape == (25, 33)
    assert np.all(got.depth_mm[12] == 20_000)


def test_mount_moves_and_tilts_the_camera() -> None:
    # 0.5 m ahead of the vehicle, which faces east; looking down 45 degrees from 2 m + 0.25 m.
    cam = camera(forward_m=0.5, up_m=0.25, pitch_up_deg=-45.0)
    floor = take(cam, yaw=math.pi / 2).depth_mm[12, 16]
    assert floor == round(2250 * math.sqrt(2.0))
    ahead = take(camera(forward_m=0.5), yaw=math.pi / 2)
    assert ahead.depth_mm[12, 16] == 19_500


def test_moving_obstacle_is_seen_where_it_is_now() -> None:
    arena = room(pillar_at=6.0)
    away = Tour(np.array([0.0, 1.0, 2.0]), np.array([[6.0, 0.0], [9.0, 0.0], [6.0, 0.0]]))
    cam = camera(arena=replace(arena, tours=(away,)), start_us=5_000_000)
    assert take(cam, 5_000_000).depth_mm[12, 16] == 5_000
    assert take(cam, 6_000_000).depth_mm[12, 16] == 8_000


# --- the wire ------------------------------------------------------------------------------------


def connected(
    server: CameraServer, source: ZmqFrameSource, sent: Frame | None = None
) -> ReceivedFrame:
    """Publish a frame, number 0 by default, until it arrives; return what did."""
    for _ in range(1000):
        server.publish(sent or frame(0))
        if (received := source.wait(-1, 0.02)) is not None:
            return received
    raise AssertionError("the subscriber never got a frame")


def test_a_jpeg_arrives_as_the_image_that_it_decodes_to() -> None:
    seen = {"kind": "rgb", "imaging": {"jpeg_quality": 50}}
    sent = take(SimulatedCamera(quad(camera=seen).camera, room(12.0, pillar_at=6.0)))
    assert sent.jpeg is not None
    server = CameraServer(LOOPBACK)
    source = ZmqFrameSource(server.endpoint, SimClock(5))
    try:
        received = connected(server, source, sent).frame
    finally:
        source.close()
        server.close()
    assert received.jpeg == sent.jpeg
    assert received.intrinsics == sent.intrinsics
    np.testing.assert_array_equal(received.image, sent.image)


@pytest.mark.parametrize("transport", ["tcp", "ipc"])
def test_frame_arrives_whole(transport: str, tmp_path: Path) -> None:
    endpoint = LOOPBACK if transport == "tcp" else f"ipc://{tmp_path}/camera"
    clock = SimClock(5)
    server = CameraServer(endpoint)
    source = ZmqFrameSource(server.endpoint, clock)
    try:
        assert source.latest() is None
        connected(server, source)
        clock.advance(70)
        server.publish(frame(9))
        received = source.wait(0, 10.0)
        assert received is not None
        assert received.frame.sequence == 9
        assert received.frame.capture_time_us == 90
        assert received.received_us == 75
        np.testing.assert_array_equal(received.frame.depth_mm, frame(9).depth_mm)
        assert source.latest() is received
        assert source.wait(9, 0.0) is None
    finally:
        source.close()
        server.close()


@pytest.mark.parametrize("transport", ["tcp", "ipc"])
def test_encrypted_frames_reach_the_owner_of_the_key_alone(transport: str, tmp_path: Path) -> None:
    endpoint = LOOPBACK if transport == "tcp" else f"ipc://{tmp_path}/camera"
    server = CameraServer(endpoint, key=bytes(range(1, 33)))
    keys = [bytes(range(1, 33)), None, bytes(range(2, 34))]
    owner, *others = [ZmqFrameSource(server.endpoint, SimClock(), key=key) for key in keys]
    try:
        np.testing.assert_array_equal(connected(server, owner).frame.depth_mm, frame(0).depth_mm)
        for sequence in range(1, 20):
            server.publish(frame(sequence))
            assert all(other.wait(-1, 0.01) is None for other in others)
        received = owner.wait(0, 10.0)
        assert received is not None and received.frame.sequence > 0
    finally:
        for source in (owner, *others):
            source.close()
        server.close()


def test_a_key_does_not_read_unencrypted_frames() -> None:
    """Else any program on the network could be the camera."""
    server = CameraServer(LOOPBACK)
    source = ZmqFrameSource(server.endpoint, SimClock(), key=bytes(range(1, 33)))
    try:
        for sequence in range(30):
            server.publish(frame(sequence))
            assert source.wait(-1, 0.01) is None
    finally:
        source.close()
        server.close()


def test_pixels_are_not_on_the_wire() -> None:
    """Bytes of an encrypted connection, between publisher and subscriber."""
    key, seen = bytes(range(1, 33)), bytearray()
    with (
        closing(CameraServer(LOOPBACK, key=key)) as server,
        closing(socket.create_server(("127.0.0.1", 0))) as listener,
        closing(
            ZmqFrameSource(f"tcp://127.0.0.1:{listener.getsockname()[1]}", SimClock(), key=key)
        ) as source,
        closing(listener.accept()[0]) as near,
        closing(
            socket.create_connection(("127.0.0.1", int(server.endpoint.rpartition(":")[2])))
        ) as far,
    ):
        for _ in range(1000):
            for here, there in ((near, far), (far, near)):
                if select.select([here], [], [], 0.002)[0]:
                    data = here.recv(65_536)
                    seen += data
                    there.sendall(data)
            server.publish(frame(7))
            if source.latest() is not None:
                break
        assert source.latest() is not None
    assert len(seen) > frame(7).depth_mm.nbytes
    assert frame(7).depth_mm.tobytes()[:64] not in seen


def test_a_panorama_arrives_whole() -> None:
    """Through ZeroMQ: the image of all sides, and that it is one."""
    profile = load_vehicle("quad-panorama").camera
    sent = take(SimulatedCamera(profile, room(12.0, pillar_at=-6.0)), yaw=0.4)
    server = CameraServer(LOOPBACK)
    source = ZmqFrameSource(server.endpoint, SimClock())
    try:
        received = connected(server, source, sent)
        assert received.frame.intrinsics == sent.intrinsics == Intrinsics.of(profile)
        np.testing.assert_array_equal(received.frame.depth_mm, sent.depth_mm)
        assert np.all(sent.depth_mm[19] > 0)  # walls all round, and the pillar behind
        assert 4_990 <= int(sent.depth_mm[19].min()) <= 5_020
    finally:
        source.close()
        server.close()


@pytest.mark.parametrize("kind", ["rgb", "grey"])
def test_colours_arrive_whole(kind: CameraKind) -> None:
    """Frames through ZeroMQ keep the ray caster's image and the intrinsics."""
    profile = load_vehicle("quad").camera.model_copy(update={"kind": kind})
    scene = room(12.0, pillar_at=6.0)
    sent = take(SimulatedCamera(profile, scene))
    server = CameraServer(LOOPBACK)
    source = ZmqFrameSource(server.endpoint, SimClock())
    try:
        received = connected(server, source, sent)
        assert received.frame.intrinsics == sent.intrinsics == Intrinsics.of(profile)
        np.testing.assert_array_equal(received.frame.image, sent.image)
        where, level = (profile.forward_m, 0.0, -2.0 - profile.up_m), (1.0, 0.0, 0.0, 0.0)
        rgb = render_picture(scene, scene.centers_at(0), sent.intrinsics, where, level).rgb
        wanted = rgb if kind == "rgb" else np.array(Image.fromarray(rgb).convert("L"))[..., None]
        np.testing.assert_array_equal(sent.image, wanted)
    finally:
        source.close()
        server.close()


def test_slow_reader_gets_only_the_newest() -> None:
    # In-process: no transport buffers frames, only ZeroMQ's queue does.
    with zmq.Context() as context:
        server = CameraServer("inproc://camera", context)
        source = ZmqFrameSource("inproc://camera", SimClock(), context)
        connected(server, source)
        for sequence in range(1, 500):
            server.publish(frame(sequence))
        received = source.wait(0, 10.0)
        assert received is not None
        assert received.frame.sequence == 499
        assert source.wait(499, 0.05) is None
        source.close()
        server.close()


def test_stalled_network_cannot_hold_the_simulator() -> None:
    """A subscriber that stops reading fills the transport; the newest frame still gets through."""
    server = CameraServer(LOOPBACK)
    with zmq.Context() as context, context.socket(zmq.SUB) as stalled:
        stalled.setsockopt(zmq.RCVHWM, 1)
        stalled.setsockopt(zmq.RCVBUF, 4096)
        stalled.subscribe(b"")
        stalled.connect(server.endpoint)
        while not stalled.poll(20):
            server.publish(frame(0))
        n = 5_000  # 31 MB: far more than any socket buffer
        for sequence in range(1, n):
            server.publish(frame(sequence))
        seen: list[int] = []
        while not seen or seen[-1] < n - 1:
            assert stalled.poll(10_000), f"the newest frame never came, last {seen[-1:]}"
            seen.append(Frame.from_bytes(stalled.recv()).sequence)
        assert len(seen) < n
        assert seen == sorted(seen)
    server.close()


def test_restarted_simulator_is_heard_again() -> None:
    with zmq.Context() as context:
        server = CameraServer("inproc://camera", context)
        source = ZmqFrameSource("inproc://camera", SimClock(), context)
        connected(server, source)
        server.publish(frame(100))
        assert source.wait(0, 10.0) is not None
        server.publish(frame(1))  # counts from the beginning
        received = source.wait(100, 10.0)
        assert received is not None
        assert received.frame.sequence == 1
        source.close()
        server.close()


def test_malformed_messages_are_counted_and_ignored() -> None:
    with zmq.Context() as context, context.socket(zmq.PUB) as publisher:
        publisher.bind("inproc://camera")
        source = ZmqFrameSource("inproc://camera", SimClock(), context)
        while source.malformed == 0:
            publisher.send(b"no frame")
            assert source.wait(-1, 0.02) is None
        bad = source.malformed
        for data in (b"", frame(1).to_bytes()[:-1], b"\xff" * 10_000):
            publisher.send(data)
            assert source.wait(-1, 0.02) is None
            bad += 1
            assert source.malformed == bad
        publisher.send(frame(3).to_bytes())
        received = source.wait(-1, 10.0)
        assert received is not None
        assert received.frame.sequence == 3
        source.close()


def test_no_message_larger_than_a_frame_is_taken_in(monkeypatch: pytest.MonkeyPatch) -> None:
    """ZeroMQ ends the connection for good; a new one is made, and frames are heard again."""
    monkeypatch.setattr("companion.frame_source.REDIAL_S", 0.3)
    with zmq.Context() as context, context.socket(zmq.PUB) as publisher:
        port = publisher.bind_to_random_port("tcp://127.0.0.1")
        source = ZmqFrameSource(f"tcp://127.0.0.1:{port}", SimClock())
        while source.wait(-1, 0.02) is None:
            publisher.send(frame(1).to_bytes())
        publisher.send(bytes(MOST_BYTES + 1))
        for _ in range(500):
            if source.wait(1, 0.02) is not None:
                break
            publisher.send(frame(2).to_bytes())
        newest = source.latest()
        assert newest is not None and newest.frame.sequence == 2
        assert source.malformed == 0  # the oversized message was not delivered
        source.close()


def test_a_flood_of_messages_does_not_hold_the_reader() -> None:
    class Flood:
        """A socket on which the next message is always there."""

        def poll(self, _timeout: int) -> int:
            return 1

        def recv(self) -> bytes:
            return b"no frame"

    source = ZmqFrameSource("tcp://127.0.0.1:9", SimClock())
    real, source._socket = source._socket, cast(Any, Flood())
    assert source.latest() is None
    assert source.malformed == MESSAGES_PER_LOOK
    source._socket = real
    source.close()


def test_waiting_without_a_server_times_out() -> None:
    source = ZmqFrameSource("tcp://127.0.0.1:9", SimClock())
    assert source.wait(-1, 0.02) is None
    source.close()


# --- mistakes of the user ------------------------------------------------------------------------


def test_taken_port_is_named_with_the_option() -> None:
    first = CameraServer(LOOPBACK)
    port = first.endpoint.rsplit(":", 1)[1]
    assert int(port) > 0
    with pytest.raises(UsageError, match=rf"camera port {port} is taken.*--camera-port"):
        CameraServer(f"tcp://127.0.0.1:{port}")
    first.close()
    CameraServer(f"tcp://127.0.0.1:{port}").close()  # and it is free again


@pytest.mark.parametrize("endpoint", ["here", "smoke://signals", "tcp://127.0.0.1"])
def test_bad_server_endpoint_is_refused(endpoint: str) -> None:
    with pytest.raises(UsageError, match=r"camera endpoint .*accepted: tcp://"):
        CameraServer(endpoint)


@pytest.mark.parametrize("endpoint", ["here", "smoke://signals", "tcp://127.0.0.1"])
def test_bad_source_endpoint_is_refused(endpoint: str) -> None:
    with pytest.raises(UsageError, match=r"accepted: tcp://"):
        ZmqFrameSource(endpoint, SimClock())


def test_companion_side_needs_no_simulator_package() -> None:
    code = (
        "import sys, companion.frame_source\n"
        "heavy = {'numba', 'pybullet', 'scipy', 'torch', 'matplotlib'}\n"
        "print(sorted(heavy & set(sys.modules)))"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert result.stdout.strip() == "[]"
