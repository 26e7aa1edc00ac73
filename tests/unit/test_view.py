"""Live view without a browser: messages, display, pace, manual latency, the scene."""

from __future__ import annotations

import socket
import threading
from collections import deque
from collections.abc import Iterator
from contextlib import ExitStack, closing
from dataclasses import replace
from http.client import HTTPConnection
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from airl_mav.addons.view.panel import camera_picture, numbers_html, texts_html
from airl_mav.addons.view.taps import Hand, HandCompensator, HandLatency
from airl_mav.addons.view.view_messages import (
    STRIP_S,
    CameraImage,
    Decided,
    Episode,
    Flight,
    Said,
    Shown,
    Steering,
    VehicleShape,
    VehicleState,
    from_parts,
    to_parts,
)
from airl_mav.addons.view.viewer import QUEUED, Asked, Ends, Feed, Pace, Viewer, request_of
from airl_mav.arena.generate import generate
from airl_mav.arena.geometry import Arena, Bounds, Obstacles, Shape, Tour
from airl_mav.cli.evaluate_command import EvaluateOptions
from airl_mav.cli.evaluate_command import run as evaluate
from airl_mav.cli.options import check_installed, read_options
from airl_mav.cli.shared_options import view_of
from airl_mav.cli.sitl_command import SitlOptions
from airl_mav.core.clock import SimClock
from airl_mav.core.constants import CommandKind
from airl_mav.core.errors import FieldError, UsageError
from airl_mav.latency.injection import FixedSampler
from airl_mav.profiles.arena import ArenaSpec
from airl_mav.profiles.loading import load_profile
from airl_mav.profiles.vehicle import load_vehicle
from airl_mav.report.theme import NO_RETURN
from airl_mav.scenario.model import Scenario
from airl_mav.scenario.resolve import resolve
from tests.support.ports import free_ports
from tests.support.processes import run_alone, wait_until

DEPTH_MM = np.arange(12, dtype=np.uint16).reshape(3, 4) * 1000

START_US = 5_000_000


def some_arena() -> Arena:
    """A box, a sphere and a cylinder that moves."""
    obstacles = Obstacles(
        np.array([Shape.BOX, Shape.SPHERE, Shape.CYLINDER], np.int8),
        np.array([[5.0, 1.0, -2.0], [8.0, -3.0, -2.5], [12.0, 0.0, -1.5]]),
        np.array([[0.5, 1.0, 2.0], [1.0, 1.0, 1.0], [0.4, 0.4, 1.5]]),
        np.array([0.3, 0.0, 0.0]),
    )
    tour = Tour(np.array([0.0, 2.0, 4.0]), np.array([[12.0, 0.0], [12.0, 4.0], [12.0, 0.0]]))
    bounds = Bounds(-3.0, 30.0, -10.0, 10.0, 5.0)
    return Arena("some", 7, bounds, (200, 120, 130), obstacles, (tour,), np.array([20.0, 5.0]))


def episode(arena: Arena | None = None, vehicle: str = "quad") -> Episode:
    shape = VehicleShape.of(load_vehicle(vehicle))
    known = {"vehicle": shape, "goal": (20.0, 5.0), "goal_radius_m": 2.0}
    return Episode(seed=3, started_us=START_US, arena=arena or some_arena(), **known)


def vehicle(seconds: float, north: float = 0.0, mode: str = "offboard") -> VehicleState:
    return VehicleState(
        time_us=START_US + round(1e6 * seconds),
        position=(north, 1.0, -2.5),
        velocity=(3.0, 0.0, 0.0),
        quaternion=(1.0, 0.0, 0.0, 0.0),
        rotors=(0.5, 0.5, 0.5, 0.5),
        battery=0.9,
        mode=mode,
        armed=True,
        collision=None,
    )


def decided(seconds: float, t2_ms: float, expires_s: float | None = None) -> Decided:
    """A decision that was sent at a time, on an image of 20 ms before it began."""
    sent_us = START_US + round(1e6 * seconds)
    began_us = sent_us - round(1e3 * t2_ms)
    return Decided(
        captured_us=began_us - 20_000,
        began_us=began_us,
        ready_us=sent_us,
        sent_us=sent_us,
        expires_us=None if expires_s is None else START_US + round(1e6 * expires_s),
        setpoint=(2.0, -1.0, 0.0, 0.5),
        compensated=False,
        shape=(3, 4),
    )


@pytest.fixture
def ends() -> Iterator[Ends]:
    made = Ends()
    yield made
    made.close()


class Watchers:
    """Viewer that repeats the same request continuously."""

    def __init__(self, ends: Ends) -> None:
        self.wanted = Steering(speed=None)
        self._ends, self._stop = ends, threading.Event()
        self._thread = threading.Thread(target=self._ask)

    def __enter__(self) -> Watchers:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()

    def _ask(self) -> None:
        while not self._stop.wait(0.01):
            self._ends.ask(self.wanted)


# --- messages


def test_an_arena_is_the_same_on_the_other_side() -> None:
    sent, arena = episode(), some_arena()
    read = from_parts(to_parts(sent))
    assert read is not None
    assert read[1] is None
    assert isinstance(read[0], Episode)
    again = read[0].arena
    assert again is not None
    gone = {"arena": None}
    assert read[0].model_copy(update=gone) == sent.model_copy(update=gone)
    for time_us in (0, 1_500_000, 9_000_000):
        np.testing.assert_array_equal(again.centers_at(time_us), arena.centers_at(time_us))
    np.testing.assert_array_equal(again.obstacles.half_size, arena.obstacles.half_size)
    assert (again.bounds, again.n_static) == (arena.bounds, arena.n_static)


def test_an_image_travels_with_its_message() -> None:
    read = from_parts(to_parts(CameraImage(captured_us=5, shape=(3, 4)), DEPTH_MM))
    assert read is not None
    np.testing.assert_array_equal(read[1], DEPTH_MM)


@pytest.mark.parametrize(
    "parts",
    [
        [],
        [b"nonsense"],
        [b'{"kind": "vehicle"}'],
        to_parts(CameraImage(captured_us=5, shape=(3, 4))),
        to_parts(CameraImage(captured_us=5, shape=(4, 4)), DEPTH_MM),
        to_parts(CameraImage(captured_us=5, shape=(0, 4)), DEPTH_MM[:0]),
    ],
)
def test_what_is_no_message_is_passed_over(parts: list[bytes]) -> None:
    assert from_parts(parts) is None


def test_a_view_that_is_gone_holds_nobody_up(ends: Ends) -> None:
    feed = Feed(ends.ends)
    feed.send(Flight(index=0, seed=1, goal=(1.0, 2.0)))
    (first,) = ends.take(10.0)
    assert first == (Flight(index=0, seed=1, goal=(1.0, 2.0)), None)
    for _ in range(100 * QUEUED):  # Without a receiver, messages beyond the queue are dropped.
        feed.send(CameraImage(captured_us=5, shape=(3, 4)), DEPTH_MM)
    feed.close()


def test_what_a_view_asks_for_holds_until_it_is_gone(ends: Ends) -> None:
    clock = SimClock()
    asked = Asked(ends.ends, Steering(speed=1.0), clock)
    assert asked.newest() == Steering(speed=1.0)
    with Watchers(ends) as watchers:
        watchers.wanted = Steering(paused=True, speed=2.0)
        wait_until(lambda: asked.newest(0.1) == watchers.wanted, "the steering")
    while asked._socket.poll(200):  # Messages still in transit.
        asked.newest()
    clock.advance(4_000_000)
    assert asked.newest().paused
    clock.advance(2_000_000)
    assert asked.newest() == Steering(speed=1.0)
    asked.close()


# --- display


def test_the_command_ages_until_the_next_decision_acts() -> None:
    shown = Shown()
    shown.take(episode(), None)
    shown.take(vehicle(1.0), None)
    assert shown.ages == deque()
    assert shown.command is None
    shown.take(decided(1.0, t2_ms=400.0), DEPTH_MM)
    shown.take(vehicle(1.1), None)
    assert (shown.age_ms, shown.t2_ms) == (520.0, 400.0)
    shown.take(vehicle(1.2), None)
    shown.take(decided(1.2, t2_ms=100.0), DEPTH_MM)
    shown.take(vehicle(1.3), None)
    assert [age for _, age, _ in shown.ages] == [520.0, 620.0, 220.0]
    assert [t2 for _, _, t2 in shown.ages] == [400.0, 400.0, 100.0]
    shown.take(vehicle(1.3 + STRIP_S, mode="hold"), None)
    assert shown.age_ms is None
    assert not any(second < 1.3 for second, _, _ in shown.ages)


def test_an_expired_command_is_a_stop() -> None:
    shown = Shown()
    shown.take(episode(), None)
    shown.take(decided(1.0, t2_ms=1.0, expires_s=1.5), DEPTH_MM)
    for seconds, expected in ((1.4, (2.0, -1.0, 0.0)), (1.6, (0.0, 0.0, 0.0))):
        shown.take(vehicle(seconds), None)
        assert shown.command is not None
        assert tuple(shown.command) == expected


def test_a_new_episode_forgets_the_old_one() -> None:
    shown = Shown()
    shown.take(episode(), None)
    for step in range(5):
        shown.take(vehicle(0.1 * step, north=float(step)), None)
    shown.take(vehicle(0.5, north=4.01), None)  # Too near for a separate trail point.
    shown.take(decided(1.0, t2_ms=1.0), DEPTH_MM)
    assert len(shown.trail) == 5
    shown.take(episode(), None)
    assert (shown.trail, shown.vehicle, shown.decided, shown.decisions) == ([], None, None, 0)
    assert shown.episodes == 2


def test_near_is_bright_and_nothing_is_dark() -> None:
    picture = camera_picture(np.array([[0, 500, 9_000]], np.uint16), range_m=10.0)
    side = picture.shape[1] // 3
    nothing, near, far = picture[0, side // 2], picture[0, 3 * side // 2], picture[0, 5 * side // 2]
    assert "#{:02x}{:02x}{:02x}".format(*nothing) == NO_RETURN
    assert int(near.sum()) > int(far.sum()) + 100


def test_numbers_and_texts_are_told_and_escaped() -> None:
    shown = Shown()
    shown.take(episode(), None)
    shown.take(vehicle(2.0, north=20.0), None)
    shown.take(decided(2.0, t2_ms=150.0), DEPTH_MM)
    shown.take(Said(time_us=START_US + 1_500_000, severity=4, text="<b>low</b>"), None)
    told = numbers_html(shown)
    for part in ("offboard", "2.0 s, 4.0 m to the goal", "+2.0 forward", "150 ms", "90 %"):
        assert part in told
    assert "1.5 s &lt;b&gt;low" in texts_html(shown)


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("velocity", ("+0.1 forward, -0.2 right,", "+0.3 down [m/s], +29 °/s")),
        ("attitude", ("roll +6, pitch -11,", "yaw +17 °, thrust 0.50")),
        ("body_rates", ("roll +6, pitch -11,", "yaw +17 °/s, thrust 0.50")),
    ],
)
def test_the_panel_says_what_is_commanded(kind: CommandKind, words: tuple[str, str]) -> None:
    """And the scene has an arrow of a velocity alone."""
    shown = Shown()
    shown.take(episode(), None)
    shown.take(vehicle(2.0), None)
    known = decided(2.0, t2_ms=1.0).model_copy(
        update={"setpoint": (0.1, -0.2, 0.3, 0.5), "commands": kind}
    )
    shown.take(known, DEPTH_MM)
    panel = numbers_html(shown)
    assert all(word in panel for word in words)
    assert (shown.command is None) == (kind != "velocity")


# --- pace and latency


def test_a_paused_flight_goes_on_by_a_decision_or_for_good(ends: Ends) -> None:
    pace = Pace(ends.ends, None)
    ticks = [0]

    def fly() -> None:
        while ticks[0] >= 0:
            pace.tick(ticks[0] * 4_000)
            ticks[0] += 1
            if ticks[0] % 10 == 0:
                pace.decided()

    with Watchers(ends) as watchers:
        watchers.wanted = Steering(paused=True)
        wait_until(lambda: pace._steering.newest(0.1).paused, "the pause")
        thread = threading.Thread(target=fly)
        thread.start()
        watchers.wanted = Steering(paused=True, steps=1)
        wait_until(lambda: ticks[0] == 10, "a step")
        watchers.wanted = Steering(paused=True, steps=2)
        wait_until(lambda: ticks[0] == 20, "another one")
        watchers.wanted = Steering(paused=True, steps=5)
        wait_until(lambda: ticks[0] == 50, "three at once")
        watchers.wanted = Steering(paused=False, steps=5)
        wait_until(lambda: ticks[0] > 100, "the rest")
        ticks[0] = -1000
        thread.join()
    pace.close()


class FakeAsked:
    def __init__(self, steering: Steering) -> None:
        self.steering = steering

    def newest(self) -> Steering:
        return self.steering


def test_a_latency_by_hand_leaves_its_mark() -> None:
    asked = FakeAsked(Steering())
    hand = Hand(asked.newest, compensate=False)
    latency = HandLatency(hand, FixedSampler(1_000))
    assert (latency.sample_us(), hand.compensates(), hand.touched) == (1_000, False, False)
    asked.steering = Steering(t2_ms=250.0)
    assert (latency.sample_us(), hand.touched) == (250_000, True)
    assert HandLatency(hand, None).sample_us() == 250_000


def test_compensation_is_switched_in_flight() -> None:
    asked, scenario = FakeAsked(Steering(compensate=True)), resolve(Scenario())
    hand = Hand(asked.newest, compensate=False)
    compensator = HandCompensator(hand, scenario)
    shape = compensator.intrinsics.height, compensator.intrinsics.width
    depth_mm = np.full((1, *shape), 4_000, np.uint16)
    state: Any = SimpleNamespace(
        position=np.array([[0.0, 0.0, -2.5]]),
        velocity=np.array([[3.0, 0.0, 0.0]]),
        quaternion=np.array([[1.0, 0.0, 0.0, 0.0]]),
    )
    compensator.begin(0)
    one = np.zeros(1, np.intp)
    compensator.decided(one, np.array([[3.0, 0.0, 0.0, 0.0]]), np.array([400_000]), np.array([0]))

    def look() -> tuple[Any, Any]:
        hand.t2_us()  # As every decision begins.
        age, now = np.array([20_000]), np.array([1_000_000])
        return compensator.foresee(one, depth_mm, age, now, state)

    _, foreseen = look()
    assert foreseen.position[0, 0] > 0.5
    assert hand.touched
    asked.steering = Steering()
    images, seen = look()
    assert images is depth_mm
    assert seen is state


# --- access control


@pytest.mark.parametrize(
    ("origin", "taken"),
    [
        (None, True),
        ("http://127.0.0.1:{port}", True),
        ("http://localhost:{port}", True),
        ("http://example.org", False),
        ("http://127.0.0.1.example.org:{port}", False),
        ("https://example.org:{port}", False),
        ("null", False),  # A file, or a sandboxed frame of any page.
    ],
)
def test_pages_of_other_sites_are_turned_away(origin: str | None, taken: bool) -> None:
    client = pytest.importorskip("websockets.sync.client")
    viser = pytest.importorskip("viser")
    from websockets.exceptions import InvalidStatus

    from airl_mav.addons.view.view_server import LocalServer

    server = LocalServer(0)
    port = server.get_port()
    try:
        with ExitStack() as stack:
            if not taken:
                stack.enter_context(pytest.raises(InvalidStatus, match="HTTP 403"))
            with client.connect(
                f"ws://127.0.0.1:{port}",
                origin=origin and origin.format(port=port),
                subprotocols=[f"viser-v{viser.__version__}"],
                max_size=None,
            ) as socket:
                assert socket.recv(timeout=20)
    finally:
        server.stop()


@pytest.mark.parametrize("headers", [{}, {"Accept-Encoding": "gzip, br"}])
def test_the_page_is_not_compressed_once_more(headers: dict[str, str]) -> None:
    pytest.importorskip("viser")
    from airl_mav.addons.view.view_server import LocalServer

    server = LocalServer(0)
    try:
        with closing(HTTPConnection("127.0.0.1", server.get_port(), timeout=20.0)) as connection:
            connection.request("GET", "/", headers=headers)
            reply = connection.getresponse()
            assert reply.headers["Content-Encoding"] == "identity"
            assert reply.read().lstrip().startswith(b"<!doctype html>")
    finally:
        server.stop()


def test_no_tunnel_is_opened_whoever_asks(monkeypatch: pytest.MonkeyPatch) -> None:
    viser = pytest.importorskip("viser")
    client = pytest.importorskip("websockets.sync.client")
    import msgspec
    from viser import _messages, _viser

    from airl_mav.addons.view.view_server import LocalServer

    opened, answered = threading.Event(), threading.Event()
    answer = LocalServer.request_share_url

    def open_tunnel(*_: Any) -> None:
        opened.set()
        raise RuntimeError("no network here")

    def request_share_url(self: LocalServer, verbose: bool = True) -> None:
        answer(self, verbose)
        answered.set()

    monkeypatch.setattr(_viser, "ViserTunnel", open_tunnel)
    monkeypatch.setattr(LocalServer, "request_share_url", request_share_url)

    def ask(server: Any) -> Any:
        return client.connect(
            f"ws://127.0.0.1:{server.get_port()}",
            subprotocols=[f"viser-v{viser.__version__}"],
            max_size=None,
        )

    request = msgspec.msgpack.encode(_messages.ShareUrlRequest().as_serializable_dict())
    for server, done in (
        (viser.ViserServer("127.0.0.1", 0, verbose=False), opened),
        (LocalServer(0), answered),
    ):
        with ask(server) as socket:
            socket.send(request)
            assert done.wait(20.0)
        server.stop()
        if done is opened:
            opened.clear()
    assert not opened.is_set()


# --- the scene, on a server without viewers


def test_an_image_of_all_sides_hangs_unrolled_above_the_vehicle() -> None:
    viser = pytest.importorskip("viser")
    from airl_mav.addons.view.viser_scene import UNROLLED_M, FlightScene

    server = viser.ViserServer("127.0.0.1", 0, verbose=False)
    try:
        scene, shown = FlightScene(server), Shown()
        shown.take(episode(vehicle="quad-panorama"), None)
        shown.take(vehicle(0.0), None)
        shown.take(CameraImage(captured_us=5, shape=(3, 4)), DEPTH_MM)
        scene.draw(shown, picture=True)
        drawn = server.scene.get_handle_by_name("/flight/vehicle/camera")
        assert drawn.image.shape[:2] != (1, 1)
        assert (drawn.render_width, drawn.render_height) == (UNROLLED_M, UNROLLED_M * 40 / 128)
        assert drawn.position[2] < -0.5
    finally:
        server.stop()


def test_the_scene_holds_arena_vehicle_and_trail() -> None:
    viser = pytest.importorskip("viser")
    from airl_mav.addons.view.viser_scene import CHUNK, FlightScene

    server = viser.ViserServer("127.0.0.1", 0, verbose=False)
    try:
        scene, shown = FlightScene(server), Shown()

        def node(name: str) -> Any:
            return server.scene.get_handle_by_name(f"/flight{name}")

        shown.take(episode(), None)
        for step in range(2 * CHUNK + 50):
            shown.take(vehicle(0.04 * step, north=0.1 * step), None)
        shown.take(decided(2.0, t2_ms=150.0), DEPTH_MM)
        shown.take(CameraImage(captured_us=5, shape=(3, 4)), DEPTH_MM)
        scene.draw(shown, picture=True)
        last = 0.1 * (2 * CHUNK + 49)
        np.testing.assert_allclose(node("/vehicle").position, (last, 1.0, -2.5))
        assert [len(node(f"/trail/{part}").points) for part in range(3)] == [CHUNK, CHUNK, 49]
        assert node("/vehicle/camera").image is not None
        for name, tip in (("flown", [1.8, 0.0, 0.0]), ("commanded", [1.2, -0.6, 0.0])):
            drawn = np.array([[np.zeros(3), tip]])
            np.testing.assert_allclose(node(f"/place/{name}").points, drawn, 1e-6)
        # The cylinder is where its tour has it.
        seconds = 0.04 * (2 * CHUNK + 49)
        expected = some_arena().centers_at(round(1e6 * seconds))[2]
        np.testing.assert_allclose(node("/arena/obstacle/2").position, expected)
        before = node("/arena/obstacle/0")
        scene.draw(shown, picture=False)
        assert node("/arena/obstacle/0") is before
        # Another episode, another scene; nothing of the old one is left.
        empty = some_arena()
        nothing = Obstacles(*(array[:0] for array in vars(empty.obstacles).values()))
        shown.take(episode(replace(empty, obstacles=nothing, tours=())), None)
        scene.draw(shown, picture=True)
        assert node("/arena/obstacle/0") is None
        assert node("/trail/0") is None
        assert node("/goal/disc") is not None
    finally:
        server.stop()


def test_the_scene_holds_meshes_or_where_their_file_is_gone_their_boxes(tmp_path: Path) -> None:
    viser = pytest.importorskip("viser")
    pytest.importorskip("trimesh")
    from airl_mav.addons.view.viser_scene import FlightScene
    from airl_mav.arena.triangles import standing
    from tests.support.meshes import kept, ring, scene_of, triangles

    file = kept(triangles(ring()), tmp_path / "ring.npz")
    arena = scene_of(file, [(3.0, 2.0, 0.5, 1.5)])
    gone = file.model_copy(update={"file": str(tmp_path / "gone.npz")})
    server = viser.ViserServer("127.0.0.1", 0, verbose=False)
    try:
        scene, shown = FlightScene(server), Shown()
        shown.take(episode(arena), None)
        shown.take(vehicle(0.0), None)
        scene.draw(shown, picture=False)
        drawn = server.scene.get_handle_by_name("/flight/arena/mesh/0")
        places, faces = standing(arena.meshes[0])
        np.testing.assert_allclose(drawn.vertices, places, atol=1e-5)
        np.testing.assert_array_equal(drawn.faces, faces)
        assert server.scene.get_handle_by_name("/flight/arena/obstacle/0") is None
        lost = replace(arena, meshes=(replace(arena.meshes[0], file=gone),))
        shown.take(episode(lost), None)
        scene.draw(shown, picture=False)
        assert server.scene.get_handle_by_name("/flight/arena/mesh/0") is None
        assert server.scene.get_handle_by_name("/flight/arena/obstacle/0") is not None
    finally:
        server.stop()


def test_meshes_are_told_by_their_file(tmp_path: Path) -> None:
    pytest.importorskip("trimesh")
    from tests.support.meshes import kept, ring, scene_of, triangles

    file = kept(triangles(ring()), tmp_path / "ring.npz")
    arena = scene_of(file, [(3.0, 2.0, 0.5, 1.5), (-1.0, 4.0, -2.0, 1.0)])
    parts = to_parts(episode(arena))
    assert sum(map(len, parts)) < 4000
    read = from_parts(parts)
    assert read is not None
    assert isinstance(read[0], Episode)
    assert read[0].arena is not None
    assert read[0].arena.meshes == arena.meshes


def test_hills_are_told_and_shown_as_they_are() -> None:
    viser = pytest.importorskip("viser")
    from airl_mav.addons.view.viser_scene import FlightScene

    spec = load_profile("arenas", "hills", ArenaSpec)
    arena = generate(spec, 3, name="hills", vehicle_width_m=0.6)
    assert arena.ground is not None
    read = from_parts(to_parts(episode(arena)))
    assert read is not None
    assert isinstance(read[0], Episode)
    assert read[0].arena is not None
    told = read[0].arena.ground
    assert told is not None
    np.testing.assert_array_equal(told.heights, arena.ground.heights)
    np.testing.assert_array_equal(told.relief.grid, arena.ground.relief.grid)
    server = viser.ViserServer("127.0.0.1", 0, verbose=False)
    try:
        scene, shown = FlightScene(server), Shown()
        shown.take(episode(arena), None)
        shown.take(vehicle(0.0), None)
        scene.draw(shown, picture=False)
        drawn = server.scene.get_handle_by_name("/flight/arena/ground")
        np.testing.assert_allclose(drawn.vertices, arena.ground.points, atol=1e-5)
        np.testing.assert_array_equal(drawn.faces, arena.ground.faces)
        goal = server.scene.get_handle_by_name("/flight/goal/disc").position
        below = arena.ground.height_at(goal[0], goal[1])
        assert goal[2] == pytest.approx(-below - 0.03)
    finally:
        server.stop()


def test_walls_are_seen_from_inside() -> None:
    pytest.importorskip("viser")
    from airl_mav.report.scene import walls

    inside = np.array([10.0, 0.0, -2.0])
    for ceiling, count in ((False, 8), (True, 10)):
        corners, faces = walls(Bounds(-3.0, 30.0, -10.0, 10.0, 5.0, ceiling))
        assert len(faces) == count
        for a, b, c in corners[faces]:
            assert np.cross(b - a, c - a) @ (inside - a) > 0.0


# --- the command line


def test_what_is_lacking_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("airl_mav.cli.options.find_spec", lambda _name: None)
    with pytest.raises(UsageError, match=r"^not installed: viser; pip install 'airl-mav\[view\]'$"):
        check_installed("view")


def test_a_port_wants_a_view() -> None:
    options = read_options(SitlOptions, "airl-sitl", ["--view-port", "8080"])
    with pytest.raises(FieldError, match="together with --view"):
        view_of(options)
    assert view_of(read_options(SitlOptions, "airl-sitl", [])) is None


def test_the_twin_and_several_runs_are_not_watched() -> None:
    pytest.importorskip("viser")
    for words in (
        ["static-obstacles"],
        ["static-obstacles", "no-obstacles", "--level", "lockstep"],
    ):
        options = read_options(EvaluateOptions, "airl evaluate", [*words, "--view"])
        with pytest.raises(FieldError) as raised:
            evaluate(options)
        assert raised.value.field == "view"
        assert "level lockstep or sitl" in str(raised.value)


def test_a_taken_port_is_one_line() -> None:
    pytest.importorskip("viser")
    _, (port,) = free_ports(0, 1)
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", port))
        taken.listen()
        with pytest.raises(FieldError, match="the port is taken") as raised:
            Viewer(request_of(resolve(Scenario(level="lockstep")), "a run", port))
    assert raised.value.field == "view_port"


def test_who_is_not_watched_loads_nothing(tmp_path: Path) -> None:
    done = run_alone(
        "import sys\n"
        "import airl_mav.rehearsal.firmware_process, airl_mav.rehearsal.companion_process\n"
        "import airl_mav.lockstep.lockstep_flight, airl_mav.cli.sitl_command\n"
        "views = 'airl_mav.addons.view.', 'viser'\n"
        "print(sorted(name for name in sys.modules if name.startswith(views)))\n",
        tmp_path,
    )
    assert done.stdout.strip() == "[]", done.stderr
