"""Signing on the links: with pymavlink, with MAVSDK through the companion's proxy, and without."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Iterator
from contextlib import closing
from itertools import count
from pathlib import Path
from typing import Any

import pytest
from mavsdk import ComponentType
from mavsdk.plugins.action import Action
from pymavlink import mavutil
from pymavlink.dialects.v20 import common as dialect

from airl_mav.core.clock import WallClock
from airl_mav.core.constants import LOOPBACK
from airl_mav.core.signing import StoredSigning, read_key, write_key
from companion.link_interface import LinkError
from companion.mavsdk_connection import SigningProxy, autopilots
from companion.mavsdk_link import MavsdkLink
from firmware_sim.autopilot.autopilot_state import Arming
from firmware_sim.autopilot.flight_modes import Mode
from firmware_sim.mavlink.endpoint import UdpEndpoint
from firmware_sim.mavlink.px4_links import onboard_link
from firmware_sim.mavlink.server import MavlinkServer
from tests.support.forged_frames import ForgedFrames
from tests.support.kinematic_autopilot import DEFAULT_PARAMETERS, KinematicAutopilot, Parameters
from tests.support.mavlink_clients import (
    BOOT_UNIX_US,
    Companion,
    RawClient,
    Rig,
    _new_mavsdk,
    wait_for,
)
from tests.support.ports import free_ports

KEY = bytes(range(7, 39))
NOW = (BOOT_UNIX_US - 1_420_070_400_000_000) // 10


def setup(key: bytes) -> Any:
    return dialect.MAVLink_setup_signing_message(1, 1, list(key), NOW)


def sign_with(client: RawClient, key: bytes | None = KEY, timestamp: int = NOW + 10_000) -> None:
    """Make a client sign, and demand signatures."""
    client.mav.signing.secret_key = key
    client.mav.signing.timestamp = timestamp
    client.mav.signing.link_id = 9
    client.mav.signing.sign_outgoing = key is not None
    client.mav.signing.allow_unsigned_callback = None


@pytest.fixture
def rig() -> Rig:
    rig = Rig()
    rig.client.send(setup(KEY))
    rig.bench.tick()
    rig.client.endpoint.take()
    rig.station.endpoint.take()
    return rig


def test_a_key_over_one_link_holds_on_all(rig: Rig) -> None:
    for client in (rig.client, rig.station):
        sign_with(client)
    rig.bench.run(0.5)
    for client in (rig.client, rig.station):
        seen = client.received("ATTITUDE")  # an unsigned one would not be decoded
        assert seen and all(m.get_signed() for m in seen)
        assert client.mav.signing.badsig_count == client.mav.signing.reject_count == 0
    rig.client.command(400, 1)
    rig.bench.tick()
    assert rig.client.received("COMMAND_ACK")[0].result == 0
    assert rig.autopilot.arming is Arming.ARMED


def test_without_the_key_nobody_is_obeyed_or_heard(rig: Rig) -> None:
    before = rig.bench.server.counters()["gcs"]
    rig.station.mav.signing.sign_outgoing = False
    rig.station.command(400, 1)
    sign_with(rig.station, bytes(32 * [1]))
    rig.station.command(400, 1)
    rig.station.send(setup(bytes(32)))  # would end the signing
    rig.bench.tick()
    assert rig.autopilot.arming is Arming.STANDBY
    after = rig.bench.server.counters()["gcs"]
    assert (after.refused - before.refused, after.rx - before.rx) == (3, 0)
    # Heartbeats are let through, as on PX4.
    sign_with(rig.station, None)
    rig.station.send(dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 0, 3))
    rig.bench.tick()
    assert rig.bench.server.counters()["gcs"].rx == after.rx + 1


def test_a_replayed_command_is_refused_on_every_link(rig: Rig) -> None:
    sign_with(rig.client)
    frame = rig.client.pack(dialect.MAVLink_command_long_message(1, 1, 400, 0, 1, 0, 0, 0, 0, 0, 0))
    rig.client.endpoint.inbox.append(frame)
    rig.bench.tick()
    assert rig.autopilot.arming is Arming.ARMED
    rig.autopilot.arming = Arming.STANDBY
    rig.client.endpoint.inbox.append(frame)
    rig.station.endpoint.inbox.append(frame)
    rig.bench.tick()
    assert rig.autopilot.arming is Arming.STANDBY
    assert sum(link.refused for link in rig.bench.server.counters().values()) == 2


def test_ten_thousand_frames_without_the_key_have_no_effect(rig: Rig) -> None:
    """From the address of the companion, whose one signed frame ends the unsigned HEARTBEATs."""
    sign_with(rig.client)
    rig.client.command(400, 1)
    rig.bench.tick()
    counters, heartbeats = rig.bench.server.counters, list(rig.autopilot.gcs_heartbeats)
    heard = {name: link.rx for name, link in counters().items()}
    forged = ForgedFrames()
    forged.hear(b"".join(rig.client.endpoint.take()))
    for _ in range(100):
        for frame in forged.take(100):
            rig.client.endpoint.inbox.append(frame)
            rig.station.endpoint.inbox.append(frame)
        rig.bench.tick()
    assert {name: link.rx for name, link in counters().items()} == heard
    assert rig.autopilot.commands == ["arm force=False"]
    assert rig.autopilot.gcs_heartbeats == heartbeats
    assert not rig.autopilot.received and not rig.autopilot.setpoints


def test_the_key_changes_with_the_key_alone_and_not_in_flight(rig: Rig) -> None:
    other = bytes(range(50, 82))
    sign_with(rig.client)
    rig.autopilot.arming = Arming.ARMED
    rig.client.send(setup(other))
    rig.bench.tick()
    rig.autopilot.arming = Arming.STANDBY
    assert rig.bench.server._signing.key == KEY
    rig.client.send(setup(other))
    rig.bench.tick()
    assert rig.bench.server._signing.key == other
    sign_with(rig.client, other)
    rig.client.send(setup(bytes(32)))
    rig.bench.tick()
    assert rig.bench.server._signing.key is None
    sign_with(rig.client, None)
    rig.client.endpoint.take()
    rig.client.command(400, 1)
    rig.bench.tick()
    assert rig.client.received("COMMAND_ACK")[0].result == 0


class Flying:
    """A server on UDP with a key file, ticking on a thread."""

    def __init__(self, path: Path | None, api: int, system_id: int = 1) -> None:
        endpoint = UdpEndpoint(
            (LOOPBACK, 0), (LOOPBACK, api), local_option="--a", remote_option="--b"
        )
        self.autopilot = KinematicAutopilot(
            Parameters(DEFAULT_PARAMETERS | {"MAV_SYS_ID": system_id})
        )
        self.server = MavlinkServer(
            [onboard_link(endpoint)],
            self.autopilot,
            boot_unix_us=BOOT_UNIX_US,
            signing=None if path is None else StoredSigning(path),
        )
        self.lock = threading.Lock()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while not self._stop.is_set():
            with self.lock:
                self.server.receive(self.autopilot.time_us)
                self.autopilot.step()
                self.server.send(self.autopilot.time_us)
            time.sleep(0.001)

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
        self.server.close()


@pytest.fixture
def key(tmp_path: Path) -> Path:
    path = tmp_path / "key"
    write_key(path, KEY)
    return path


def test_mavutil_with_setup_signing(key: Path) -> None:
    (api,), _ = free_ports(1, 0)
    with (
        closing(Flying(key, api)) as flying,
        closing(mavutil.mavlink_connection(f"udpin:{LOOPBACK}:{api}", dialect="common")) as client,
    ):
        client.wait_heartbeat(timeout=20)  # mavutil changes to MAVLink 2, and forgets any key
        client.setup_signing(KEY)
        beat = client.recv_match(type="HEARTBEAT", blocking=True, timeout=20)
        assert beat.get_signed()
        client.mav.command_long_send(1, 1, 400, 0, 1, 0, 0, 0, 0, 0, 0)
        ack = client.recv_match(type="COMMAND_ACK", blocking=True, timeout=20)
        assert (ack.result, ack.get_signed()) == (0, True)
        assert flying.autopilot.arming is Arming.ARMED
    assert int((key.parent / "key.timestamp").read_text()) > 0
    assert read_key(key) == KEY


def link_to(api: int, key: Path | None, **options: Any) -> MavsdkLink:
    url = f"udpin://{LOOPBACK}:{api}"
    return MavsdkLink(url, WallClock(), threading.Event(), signing_key=key, **options)


def test_mavsdk_flies_through_the_signing_proxy(key: Path) -> None:
    (api,), _ = free_ports(1, 0)
    with closing(Flying(key, api)) as flying, closing(link_to(api, key)) as link:
        link.connect(20.0)
        wait_for(lambda: flying.autopilot.arming is Arming.STANDBY)
        link._action.arm()
        assert flying.autopilot.arming is Arming.ARMED
        counters = flying.server.counters()["onboard"]
        assert counters.rx > 0
        assert link._proxy is not None
        assert (counters.refused, link._proxy.refused) == (0, 0)


class Vehicle:
    """A vehicle's frames, made by pymavlink, for a companion's proxy."""

    def __init__(self, key: Path) -> None:
        (api,), _ = free_ports(1, 0)
        self.proxy = SigningProxy(f"udpin://{LOOPBACK}:{api}", key)
        now = self.proxy._stored.signing._now()
        self.stamps = count(now)

    def frame(self, system: int = 1, link: int = 0, key: bytes | None = KEY) -> bytes:
        mav = dialect.MAVLink(None, system, 1)
        mav.signing.secret_key, mav.signing.sign_outgoing = key, key is not None
        mav.signing.link_id, mav.signing.timestamp = link, next(self.stamps)
        frame: bytes = dialect.MAVLink_heartbeat_message(2, 12, 1, 0, 3, 3).pack(mav)
        return frame

    def passes(self, frame: bytes, port: int = 14580) -> bool:
        return self.proxy._accepts(frame, (LOOPBACK, port))

    def close(self) -> None:
        self.proxy.close()


@pytest.fixture
def vehicle(key: Path) -> Iterator[Vehicle]:
    with closing(Vehicle(key)) as made:
        yield made


def test_the_proxy_passes_nothing_unsigned(vehicle: Vehicle) -> None:
    """Also before the vehicle is heard: MAVSDK connects to the first flight controller."""
    for system in (7, 1):
        assert not vehicle.passes(vehicle.frame(system, key=None), 9)
        assert not vehicle.passes(vehicle.frame(system, key=bytes(32 * [1])), 9)
    assert vehicle.passes(vehicle.frame())
    assert not vehicle.passes(vehicle.frame(key=None), 9)
    assert vehicle.proxy._vehicles == {1: (LOOPBACK, 14580)}


def test_a_replayed_frame_neither_passes_nor_diverts_the_companion(vehicle: Vehicle) -> None:
    frames = [vehicle.frame() for _ in range(3)]
    # To a ground station, and signed: it may be older than the newest telemetry here.
    other = [vehicle.frame(link=1) for _ in range(2)]
    assert vehicle.passes(frames[1])
    assert not any(vehicle.passes(frame, 9) for frame in (*frames[:2], *other))
    assert vehicle.proxy._vehicles == {1: (LOOPBACK, 14580)}
    assert vehicle.passes(frames[2])
    assert vehicle.proxy.refused == 4


def test_the_companion_sends_to_the_named_vehicle_alone(key: Path) -> None:
    with closing(Vehicle(key)) as vehicle:
        vehicle.proxy._system_id = 2
        assert vehicle.passes(vehicle.frame(1), 14580)
        assert vehicle.passes(vehicle.frame(2), 14581)
        assert vehicle.proxy._vehicles == {2: (LOOPBACK, 14581)}


def test_a_third_sender_neither_ends_a_flight_nor_hides_a_takeover(key: Path) -> None:
    (api,), _ = free_ports(1, 0)
    forged, stop = ForgedFrames(), threading.Event()

    def attack() -> None:
        with closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as sender:
            while not stop.wait(0.002):
                for frame in forged.take(5):
                    sender.sendto(frame, (LOOPBACK, api))

    attacker = threading.Thread(target=attack)
    with closing(link_to(api, key)) as link:
        attacker.start()
        try:
            time.sleep(0.2)  # An invented vehicle speaks first.
            with closing(Flying(key, api)) as flying:
                link.connect(20.0)
                assert list(autopilots(link._mavsdk)) == [1]
                wait_for(lambda: flying.autopilot.arming is Arming.STANDBY)
                link._action.arm()
                wait_for(lambda: link.status().armed)
                # The lies: disarmed, Offboard, Position.
                told = set()
                for _ in range(100):
                    told.add((link.connected, link.armed, link.status().mode))
                    time.sleep(0.005)
                assert told == {(True, True, "hold")}
                with flying.lock:
                    flying.autopilot.mode = Mode.STABILIZED
                wait_for(lambda: link.status().mode == "stabilized")
                for _ in range(50):
                    assert link.status().mode == "stabilized"
                    time.sleep(0.005)
        finally:
            stop.set()
            attacker.join()
    assert forged.sent.total() > 500


@pytest.mark.parametrize("signed", [False, True])
def test_of_two_vehicles_the_named_one_is_flown(signed: bool, key: Path, tmp_path: Path) -> None:
    (api,), _ = free_ports(1, 0)
    keys = [tmp_path / name if signed else None for name in "012"]
    for path in keys:
        if path is not None:
            write_key(path, KEY)
    with (
        closing(Flying(keys[0], api, 1)) as first,
        closing(Flying(keys[1], api, 2)) as second,
    ):
        with closing(link_to(api, keys[2])) as link:
            link.connect(20.0)
            with pytest.raises(LinkError, match=r"systems 1, 2; choose one with .*--system-id"):
                link.check_alone(1.5)
        with closing(link_to(api, keys[2], system_id=2)) as link:
            link.connect(20.0)
            link.check_alone(1.5)
            link._action.arm()
        assert second.autopilot.arming is Arming.ARMED
        assert first.autopilot.arming is Arming.STANDBY
        with (
            closing(link_to(api, keys[2], system_id=3)) as link,
            pytest.raises(LinkError, match="no system 3 heard on "),
        ):
            link.connect(0.5)


def test_a_companion_with_another_key_is_told_so(key: Path, tmp_path: Path) -> None:
    (api,), _ = free_ports(1, 0)
    other = tmp_path / "other"
    write_key(other, bytes(range(1, 33)))
    url = f"udpin://{LOOPBACK}:{api}"
    with (
        closing(Flying(key, api)),
        closing(link_to(api, other)) as link,
        pytest.raises(LinkError, match=rf"heard on {url} in 1 s \(\d+ frames refused: bad sig"),
    ):
        link.connect(1.0)


def test_a_companion_without_the_key_is_told_so(key: Path) -> None:
    (api,), _ = free_ports(1, 0)
    url = f"udpin://{LOOPBACK}:{api}"
    with (
        closing(Flying(key, api)),
        closing(MavsdkLink(url, WallClock(), threading.Event())) as link,
        pytest.raises(LinkError, match=r"^no telemetry: .* wants signed messages .--signing-key."),
    ):
        link.connect(20.0)


def test_a_proxy_without_a_host_is_on_this_machine_alone(key: Path) -> None:
    (api,), _ = free_ports(1, 0)
    with (
        closing(SigningProxy(f"udpin://:{api}", key)),
        closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as beside,
    ):
        beside.bind(("127.0.0.2", api))  # which all interfaces would hold


def test_mavsdk_without_the_proxy_is_not_obeyed(key: Path) -> None:
    (api,), _ = free_ports(1, 0)
    with closing(Flying(key, api)) as flying:
        mavsdk = _new_mavsdk(ComponentType.COMPANION_COMPUTER)
        assert mavsdk.add_any_connection(f"udpin://{LOOPBACK}:{api}") == 0
        companion = Companion(mavsdk)
        try:
            wait_for(lambda: flying.autopilot.arming is Arming.STANDBY)
            with pytest.raises(Exception, match="TIMEOUT"):
                companion.plugin(Action).arm()
            assert flying.autopilot.arming is Arming.STANDBY
        finally:
            companion.destroy()
