"""Signing on the links: with pymavlink, with MAVSDK through the companion's proxy, and without."""

from __future__ import annotations

import socket
import threading
import time
from contextlib import closing
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
from companion.mavsdk_connection import SigningProxy, signed
from companion.mavsdk_link import MavsdkLink
from firmware_sim.autopilot.autopilot_state import Arming
from firmware_sim.mavlink.endpoint import UdpEndpoint
from firmware_sim.mavlink.px4_links import onboard_link
from firmware_sim.mavlink.server import MavlinkServer
from tests.support.kinematic_autopilot import KinematicAutopilot
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

    def __init__(self, path: Path, api: int) -> None:
        endpoint = UdpEndpoint(
            (LOOPBACK, 0), (LOOPBACK, api), local_option="--a", remote_option="--b"
        )
        self.autopilot = KinematicAutopilot()
        self.server = MavlinkServer(
            [onboard_link(endpoint)],
            self.autopilot,
            boot_unix_us=BOOT_UNIX_US,
            signing=StoredSigning(path),
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


def test_mavsdk_flies_through_the_signing_proxy(key: Path) -> None:
    (api,), _ = free_ports(1, 0)
    with (
        closing(SigningProxy(f"udpin://{LOOPBACK}:{api}", key)) as proxy,
        closing(Flying(key, api)) as flying,
    ):
        mavsdk = _new_mavsdk(ComponentType.COMPANION_COMPUTER)
        assert mavsdk.add_any_connection(proxy.url) == 0
        companion = Companion(mavsdk)
        try:
            wait_for(lambda: flying.autopilot.arming is Arming.STANDBY)
            companion.plugin(Action).arm()
            assert flying.autopilot.arming is Arming.ARMED
        finally:
            companion.destroy()
        counters = flying.server.counters()["onboard"]
        assert counters.rx > 0
        assert (counters.refused, proxy.refused) == (0, 0)


def test_a_companion_with_another_key_is_told_so(key: Path, tmp_path: Path) -> None:
    (api,), _ = free_ports(1, 0)
    other = tmp_path / "other"
    write_key(other, bytes(range(1, 33)))
    url = f"udpin://{LOOPBACK}:{api}"
    with (
        closing(Flying(key, api)),
        pytest.raises(LinkError, match=rf"heard on {url} in 1 s \(\d+ frames refused: bad sig"),
        signed(url, other) as proxied,
        closing(MavsdkLink(proxied, WallClock(), threading.Event())) as link,
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


def test_the_proxy_signs_for_mavsdk_alone(key: Path) -> None:
    """Else any program on the companion computer could command the vehicle without the key."""
    (api,), _ = free_ports(1, 0)
    with (
        closing(SigningProxy(f"udpin://{LOOPBACK}:{api}", key)) as proxy,
        closing(Flying(key, api)) as flying,
        closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as mavsdk,
        closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as other,
    ):
        mavsdk.bind((LOOPBACK, int(proxy.url.rpartition(":")[2])))
        mavsdk.settimeout(20.0)
        _, signer = mavsdk.recvfrom(4096)
        plain = dialect.MAVLink(None, 245, 190)
        arm = dialect.MAVLink_command_long_message(1, 1, 400, 0, 1, *[0] * 6)
        other.sendto(arm.pack(plain), signer)
        mavsdk.sendto(dialect.MAVLink_ping_message(1, 7, 0, 0).pack(plain), signer)
        wait_for(lambda: flying.server.counters()["onboard"].rx > 0)
        time.sleep(0.1)
        assert flying.server.counters()["onboard"].rx == 1
        assert flying.autopilot.arming is Arming.STANDBY


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
