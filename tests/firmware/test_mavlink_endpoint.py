"""UDP as PX4 does it: preset remote, learned peer, refusals."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from typing import Any

import pytest

from airl_mav.core.errors import UsageError
from firmware_sim.mavlink.endpoint import Address, Endpoint, MemoryEndpoint, UdpEndpoint

LOOPBACK = "127.0.0.1"
FRAME = b"\xfd frame"


@pytest.fixture
def sockets() -> Iterator[list[socket.socket]]:
    """Sockets of a test, closed at its end."""
    opened: list[socket.socket] = []
    yield opened
    for item in opened:
        item.close()


@pytest.fixture
def endpoints() -> Iterator[list[UdpEndpoint]]:
    opened: list[UdpEndpoint] = []
    yield opened
    for item in opened:
        item.close()


def client(sockets: list[socket.socket]) -> socket.socket:
    item = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    item.settimeout(5.0)
    item.bind((LOOPBACK, 0))
    sockets.append(item)
    return item


def endpoint(
    endpoints: list[UdpEndpoint],
    remote: Address | None,
    local: Address = (LOOPBACK, 0),
    **options: Any,
) -> UdpEndpoint:
    item = UdpEndpoint(
        local, remote, local_option="--api-local-port", remote_option="--api-remote", **options
    )
    endpoints.append(item)
    return item


def drain(item: UdpEndpoint) -> list[bytes]:
    """Loopback delivers before sendto returns, so one call suffices."""
    return item.receive()


def test_the_preset_remote_hears_us_without_having_spoken(
    sockets: list[socket.socket], endpoints: list[UdpEndpoint]
) -> None:
    companion = client(sockets)
    vehicle = endpoint(endpoints, companion.getsockname())
    vehicle.send(FRAME)
    assert companion.recvfrom(100) == (FRAME, vehicle.local)
    companion.sendto(FRAME, vehicle.local)
    assert drain(vehicle) == [FRAME]
    assert vehicle.peer is None


def test_the_newest_other_talker_hears_us_too(
    sockets: list[socket.socket], endpoints: list[UdpEndpoint]
) -> None:
    companion, first, second = (client(sockets) for _ in range(3))
    vehicle = endpoint(endpoints, companion.getsockname())
    first.sendto(FRAME, vehicle.local)
    drain(vehicle)
    vehicle.send(b"\xfd 1")
    assert (companion.recv(9), first.recv(9)) == (b"\xfd 1", b"\xfd 1")
    second.sendto(FRAME, vehicle.local)
    companion.sendto(FRAME, vehicle.local)  # the preset remote displaces no client
    assert len(drain(vehicle)) == 2
    assert vehicle.peer == second.getsockname()
    vehicle.send(b"\xfd 2")
    assert (companion.recv(9), second.recv(9)) == (b"\xfd 2", b"\xfd 2")
    first.setblocking(False)
    with pytest.raises(BlockingIOError):
        first.recv(9)


def test_who_does_not_speak_mavlink_is_no_peer(
    sockets: list[socket.socket], endpoints: list[UdpEndpoint]
) -> None:
    stranger = client(sockets)
    vehicle = endpoint(endpoints, None)
    stranger.sendto(b"GET / HTTP/1.1", vehicle.local)
    stranger.sendto(b"", vehicle.local)
    assert drain(vehicle) == [b"GET / HTTP/1.1", b""]
    assert vehicle.peer is None
    vehicle.send(FRAME)
    assert vehicle.send_errors == 0


def test_receive_is_bounded_and_in_order(
    sockets: list[socket.socket], endpoints: list[UdpEndpoint], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("firmware_sim.mavlink.endpoint.MAX_DATAGRAMS_PER_CALL", 5)
    talker = client(sockets)
    vehicle = endpoint(endpoints, None)
    for i in range(7):
        talker.sendto(bytes([0xFD, i]), vehicle.local)
    assert [chunk[1] for chunk in vehicle.receive()] == [0, 1, 2, 3, 4]
    assert [chunk[1] for chunk in vehicle.receive()] == [5, 6]
    assert vehicle.receive() == []


def test_send_errors_are_counted_not_raised(endpoints: list[UdpEndpoint]) -> None:
    vehicle = endpoint(endpoints, (LOOPBACK, 9))
    vehicle.send(b"x" * 70_000)  # longer than a datagram can be
    assert vehicle.send_errors == 1
    vehicle.close()
    vehicle.send(FRAME)
    assert vehicle.send_errors == 2
    assert vehicle.fileno() is None
    vehicle.close()


def test_nobody_listening_is_harmless(
    sockets: list[socket.socket], endpoints: list[UdpEndpoint]
) -> None:
    gone = client(sockets)
    address = gone.getsockname()
    gone.close()
    vehicle = endpoint(endpoints, address)
    for _ in range(3):
        vehicle.send(FRAME)
        assert vehicle.receive() == []


def test_a_taken_port_names_itself_and_the_way_out(endpoints: list[UdpEndpoint]) -> None:
    first = endpoint(endpoints, None)
    with pytest.raises(UsageError, match=rf"UDP port {first.local[1]} .*taken.*--api-local-port"):
        endpoint(endpoints, None, local=first.local)


@pytest.mark.parametrize(
    ("local", "remote", "named"),
    [
        (("0.0.0.0", 0), None, "--api-local-port: 0.0.0.0"),  # noqa: S104
        ((LOOPBACK, 0), ("192.168.1.7", 14540), "--api-remote: 192.168.1.7:14540"),
    ],
)
def test_reachable_from_outside_only_when_asked_for(
    endpoints: list[UdpEndpoint], local: Address, remote: Address | None, named: str
) -> None:
    with pytest.raises(UsageError, match=named) as caught:
        endpoint(endpoints, remote, local=local)
    assert "--insecure" in str(caught.value)
    assert "unauthenticated" in str(caught.value)
    assert endpoint(endpoints, remote, local=local, insecure=True).local[0] == local[0]


@pytest.mark.parametrize(
    ("local", "remote", "message"),
    [
        ((LOOPBACK, 70_000), None, "--api-local-port: port 70000: must be in 0..65535"),
        ((LOOPBACK, 0), (LOOPBACK, 0), "--api-remote: port 0: must be in 1..65535"),
        (("no.such.host.invalid", 1), None, "--api-local-port: host 'no.such.host.invalid'"),
        (("127.0.0.1", 0), ("::1", 5), "--api-remote: host '::1': no such IPv4 host"),
        (("x" * 300, 0), None, "no such IPv4 host"),
    ],
)
def test_unusable_addresses(
    endpoints: list[UdpEndpoint], local: Address, remote: Address | None, message: str
) -> None:
    with pytest.raises(UsageError, match=message):
        endpoint(endpoints, remote, local=local)


def test_host_names_are_resolved(endpoints: list[UdpEndpoint]) -> None:
    assert endpoint(endpoints, ("localhost", 5), local=("localhost", 0)).local[0] == LOOPBACK


def test_an_address_of_another_machine_cannot_be_bound(endpoints: list[UdpEndpoint]) -> None:
    with pytest.raises(UsageError, match=r"192\.0\.2\.1 cannot be used"):
        endpoint(endpoints, None, local=("192.0.2.1", 0), insecure=True)


def test_telemetry_goes_frame_by_frame(
    sockets: list[socket.socket], endpoints: list[UdpEndpoint]
) -> None:
    companion = client(sockets)
    endpoint(endpoints, companion.getsockname()).send_streams([b"\xfd 1", b"\xfd 2"])
    assert [companion.recv(9) for _ in range(2)] == [b"\xfd 1", b"\xfd 2"]


def test_memory_endpoint_is_two_queues() -> None:
    memory = MemoryEndpoint()
    memory.inbox.extend([b"a", b"b"])
    assert memory.receive() == [b"a", b"b"]
    assert memory.receive() == []
    memory.send(b"c")
    memory.send(b"d")
    memory.send_streams([b"e", b"f"])
    assert memory.take() == [b"c", b"d", b"e", b"f"]
    assert memory.take() == []
    endpoint: Endpoint = memory
    assert endpoint.fileno() is None
