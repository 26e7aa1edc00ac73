"""MAVLink between a board's line and its clients: forwarding, filtering and rate limit."""

from __future__ import annotations

import select
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import common as dialect

from airl_mav.core.clock import SimClock, WallClock
from firmware_sim.addons.px4_hitl.line import BURST_BYTES, SIMULATOR_IDS, Router, TokenBucket
from firmware_sim.mavlink.codec import Encoder
from firmware_sim.mavlink.endpoint import MemoryEndpoint
from firmware_sim.mavlink.px4_links import bind_udp_links
from tests.support.ports import LOOPBACK, free_ports

PATIENCE_S = 60.0


class Line:
    """A line in memory."""

    def __init__(self) -> None:
        self.ours, self.theirs = socket.socketpair()
        self.ours.setblocking(False)
        self.sent = bytearray()
        self.full = False

    def read(self) -> bytes:
        try:
            return self.ours.recv(65536)
        except BlockingIOError:
            return b""

    def write(self, data: bytes) -> bool:
        if not self.full:
            self.sent += data
        return not self.full

    def drain(self) -> None: ...

    def fileno(self) -> int:
        return self.ours.fileno()

    def say(self, data: bytes) -> None:
        self.theirs.sendall(data)

    def close(self) -> None:
        self.ours.close()
        self.theirs.close()


HEARTBEAT = dialect.MAVLink_heartbeat_message(2, 12, 29 | 32, 0, 3, 3)


class Bench:
    """A router between a line and two clients in memory."""

    def __init__(self, budget_bytes_s: int = 10**6) -> None:
        self.line = Line()
        self.clock = SimClock()
        self.clients = {"onboard": MemoryEndpoint(), "gcs": MemoryEndpoint()}
        self.router = Router(self.clients, self.clock)
        self.heard: list[str] = []
        self.router.attach(self.line, budget_bytes_s)
        self.router.on_message = lambda m: self.heard.append(m.get_type())
        self.board = Encoder()
        self.station = Encoder(255, 190)

    def say(self, *messages: Any) -> list[bytes]:
        """Let the board say something; return its frames."""
        frames = [self.board.pack(message) for message in messages]
        self.line.say(b"".join(frames))
        self.router.pump()
        return frames


@pytest.fixture
def bench() -> Iterator[Bench]:
    bench = Bench()
    yield bench
    bench.router.close()
    bench.line.close()


UNKNOWN = bytes.fromhex("fd0300000701014e6100") + b"abc" + b"\x12\x34"
"""A frame of a message that the dialect lacks: id 0x00614e."""


def telemetry(rng: np.random.Generator, count: int) -> list[Any]:
    """Return messages of many lengths, as a board sends them."""
    kinds = [
        lambda: HEARTBEAT,
        lambda: dialect.MAVLink_attitude_message(int(rng.integers(2**32)), *rng.normal(size=6)),
        lambda: dialect.MAVLink_statustext_message(6, rng.bytes(50), 0, 0),
        lambda: dialect.MAVLink_ping_message(int(rng.integers(2**60)), 1, 0, 0),
    ]
    return [kinds[int(rng.integers(len(kinds)))]() for _ in range(count)]


def test_telemetry_passes_unchanged_however_the_line_cuts_it(bench: Bench) -> None:
    rng = np.random.default_rng(3)
    frames = [bench.board.pack(message) for message in telemetry(rng, 300)]
    frames.insert(100, UNKNOWN)
    stream = b"".join(frames)
    heard: list[bytes] = []
    while stream:
        count = int(rng.integers(1, 90))
        bench.line.say(stream[:count])
        stream = stream[count:]
        heard += bench.router.receive()
    for got in (heard, bench.clients["onboard"].take(), bench.clients["gcs"].take()):
        assert got == frames


def test_what_stands_between_frames_passes_to_nobody(bench: Bench) -> None:
    first, second = bench.board.pack(HEARTBEAT), bench.board.pack(HEARTBEAT)
    # Bytes that look like a header are held for at most a frame's length.
    more = [bench.board.pack(HEARTBEAT) for _ in range(20)]
    noisy = b"NuttShell (NSH)\n\xfd\x09" + first + b"\xfe\xfd\xff\r\n" + second + second
    bench.line.say(noisy + b"".join(more))
    bench.router.pump()
    assert bench.clients["gcs"].take() == [first, second, second, *more]


def test_the_simulators_messages_stay(bench: Bench) -> None:
    controls = dialect.MAVLink_hil_actuator_controls_message(1, [0.5] * 16, 161, 0)
    gps = dialect.MAVLink_hil_gps_message(1, 3, 0, 0, 0, 1, 1, 0, 0, 0, 0, 0, 9)
    frames = bench.say(HEARTBEAT, controls, gps)
    assert bench.heard == ["HEARTBEAT", "HIL_ACTUATOR_CONTROLS", "HIL_GPS"]
    assert bench.router.receive() == frames[:1]
    assert bench.clients["onboard"].take() == bench.clients["gcs"].take() == frames[:1]
    # Nor does anybody but us simulate for the board.
    bench.clients["gcs"].inbox.append(bench.station.pack(gps))
    bench.router.pump()
    assert bench.line.sent == b""
    assert bench.router.counters()["gcs"].ignored == 1
    assert {"HIL_SENSOR", "HIL_STATE_QUATERNION"} <= {
        dialect.mavlink_map[number].msgname for number in SIMULATOR_IDS
    }


def test_clients_reach_the_board_unchanged_and_in_order(bench: Bench) -> None:
    bench.say(HEARTBEAT)
    frames = [bench.station.pack(message) for message in telemetry(np.random.default_rng(4), 40)]
    bench.clients["onboard"].inbox.append(b"".join(frames[:20]))  # some join frames
    bench.clients["onboard"].inbox.extend(frames[20:])
    bench.clients["onboard"].inbox.append(b"no MAVLink")
    bench.router.pump()
    assert bytes(bench.line.sent) == b"".join(frames)
    counters = bench.router.counters()["onboard"]
    assert (counters.rx, counters.malformed, counters.ignored) == (40, 1, 0)


def test_a_boot_loader_is_told_nothing(bench: Bench) -> None:
    frame = bench.station.pack(HEARTBEAT)

    def offer() -> bytes:
        bench.clients["gcs"].inbox.append(frame)
        bench.router.send(frame)
        bench.router.send_ahead(frame)
        bench.router.pump()
        return bytes(bench.line.sent)

    assert offer() == b""
    bench.line.say(b"\x12\x10 boot loader" + UNKNOWN)  # no checksum of this can be known
    assert offer() == b""
    bench.say(HEARTBEAT)
    assert offer() == frame * 3
    bench.line.sent.clear()
    bench.router.attach(bench.line, 10**6)  # it came back, and may be a boot loader again
    assert offer() == b""
    assert bench.router.send_errors == 3


def test_clients_cannot_flood_the_line() -> None:
    bench = Bench(budget_bytes_s=2_000)
    bench.say(HEARTBEAT)
    frame = bench.station.pack(dialect.MAVLink_attitude_message(1, *np.ones(6)))

    def flood() -> int:
        before = len(bench.line.sent)
        bench.clients["gcs"].inbox.extend([frame] * 2_000)
        bench.router.pump()
        return len(bench.line.sent) - before

    assert BURST_BYTES - len(frame) < flood() <= BURST_BYTES
    assert flood() == 0
    bench.clock.advance(1_000_000)
    assert 2_000 - len(frame) < flood() <= 2_000 + len(frame)
    # The simulator's own messages are outside this budget.
    before = len(bench.line.sent)
    assert bench.router.send_ahead(frame)
    assert len(bench.line.sent) == before + len(frame)
    bench.line.full = True
    assert not bench.router.send_ahead(frame)
    bench.router.close()
    bench.line.close()


def test_a_budget_saves_no_more_than_a_burst() -> None:
    clock = SimClock()
    budget = TokenBucket(1_000, clock)
    clock.advance(10**9)
    assert budget.take(BURST_BYTES)
    assert not budget.take(1)
    clock.advance(1_000)
    assert budget.take(1)


def test_the_router_wakes_whoever_waits_for_it(tmp_path: Path) -> None:
    (api, api_local, gcs, gcs_local), _ = free_ports(4, 0)
    ends = bind_udp_links(
        bind=LOOPBACK,
        api_remote=(LOOPBACK, api),
        api_local_port=api_local,
        gcs_remote=(LOOPBACK, gcs),
        gcs_local_port=gcs_local,
        insecure=False,
    )
    router, line = Router(ends.by_name(), WallClock()), Line()

    def wakes() -> bool:
        number = router.fileno()
        assert number is not None
        return bool(select.select([number], [], [], 0.0)[0])

    router.attach(line, 10**6)
    assert not wakes()
    line.say(b"x")
    assert wakes()
    router.receive()
    assert not wakes()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as station:
        station.bind((LOOPBACK, gcs))
        line.say(Encoder().pack(HEARTBEAT))
        router.receive()
        station.settimeout(PATIENCE_S)
        data, address = station.recvfrom(2048)
        assert data[7:10] == b"\0\0\0"
        assert address == (LOOPBACK, gcs_local)
        station.sendto(Encoder(255, 190).pack(HEARTBEAT), address)
        number = router.fileno()
        assert number is not None
        assert select.select([number], [], [], PATIENCE_S)[0]
        router.receive()
    assert line.sent
    router.detach()
    assert not wakes()
    router.close()
    router.close()
    assert router.fileno() is None
    assert router.receive() == []
    line.close()
