"""Latency of setpoints and telemetry between a client's Python and the flight controller.

    python scripts/foreign_clients.py ~/foreign-clients        # separate Python for mavsdk-grpc
    python benchmarks/bench_mavsdk.py --grpc-python ~/foreign-clients/mavsdk-grpc/bin/python

The built-in flight controller runs here, on the ground, in real time, on real sockets of this host.
Each client is a separate process that sends 50 setpoints a second and receives 50 positions a
second. A setpoint's latency is from the call until the flight controller has the datagram. A
position's latency is from before its datagram is sent until the callback in Python. Both are
stamped by CLOCK_MONOTONIC and matched by their values. Each client is measured twice: undisturbed,
and beside one busy counting process per core. On a loaded host, use `--realtime` to keep other work
away (requires permission for SCHED_FIFO). It always applies to the flight controller, because an
aircraft has a processor for it, and to the client only while undisturbed. Each figure has the
load average of the last minute. Writes table.json, which results.py publishes.
"""

from __future__ import annotations

import json
import os
import shlex
import socket
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path

import numpy as np
import tyro
from numpy.typing import NDArray
from rich.console import Console

from airl_mav.core.constants import LOOPBACK
from airl_mav.core.machine import provenance, usable_cores
from airl_mav.latency.stages import summarize
from airl_mav.profiles.vehicle import load_vehicle
from airl_mav.report.document import (
    DURATION_COLUMNS,
    Column,
    TableView,
    duration_cells,
    print_table,
    write_table,
)
from firmware_sim.firmware import BuiltinFlightStack, Firmware
from firmware_sim.mavlink.codec import dialect
from firmware_sim.mavlink.endpoint import Address, Peer, UdpEndpoint, UdpPeer
from firmware_sim.mavlink.px4_links import onboard_link
from firmware_sim.mavlink.server import MavlinkServer
from firmware_sim.pacing import WallPacing
from firmware_sim.simulation import EpisodeSetup

CLIENT = Path(__file__).parent / "latency_client.py"
READY_S = 8.0
"""Until the vehicle's estimator is ready, and position streams."""
LONGEST_S = 120.0
REALTIME = 10
"""Priority, 1 to 99."""

_SETPOINT, _POSITION = (
    number.to_bytes(3, "little")
    for number in (
        dialect.MAVLINK_MSG_ID_SET_POSITION_TARGET_LOCAL_NED,
        dialect.MAVLINK_MSG_ID_LOCAL_POSITION_NED,
    )
)


@dataclass(frozen=True)
class Bench:
    """Measure the latency of MAVLink clients."""

    grpc_python: Path | None = None
    """Python with mavsdk-grpc, MAVSDK's older interface; None: without it."""

    setpoints: int = 1500
    """Number for each client, at 50 Hz, in each condition."""

    rate_hz: float = 50.0
    """Rate of setpoints and positions."""

    realtime: bool = False
    """Run the flight controller, and undisturbed clients, by SCHED_FIFO."""

    out: Path = Path("runs/mavsdk-latency")
    """Folder of table.json."""


class Tap:
    """Times of received setpoints and sent positions [ns, CLOCK_MONOTONIC]."""

    def __init__(self) -> None:
        self.got: dict[int, int] = {}
        """First arrival by the number of the setpoint; MAVSDK repeats the newest."""
        self.sent: dict[str, int] = {}
        """Send time by the bytes of the position."""

    def arrived(self, data: bytes) -> None:
        """Note the setpoints in a datagram."""
        now = time.monotonic_ns()
        for frame in frames(data):
            if frame[7:10] == _SETPOINT:
                (north,) = struct.unpack_from("<f", frame, 26)
                self.got.setdefault(round(north * 1024.0), now)

    def leaves(self, frame: bytes) -> None:
        """Note a position that is about to be sent."""
        if frame[7:10] == _POSITION:
            self.sent[frame[14:26].hex()] = time.monotonic_ns()


def frames(data: bytes) -> Iterator[bytes]:
    """Yield the frames (MAVLink 2, unsigned) of a datagram."""
    while len(data) >= 12 and data[0] == 0xFD:
        end = data[1] + 12
        yield data[:end]
        data = data[end:]


class TappedPeer(UdpPeer):
    """A peer whose frames are noted."""

    def __init__(self, bound: socket.socket, address: Address, tap: Tap) -> None:
        super().__init__(bound, address)
        self._tap = tap

    def send(self, data: bytes) -> None:
        self._tap.leaves(data)
        super().send(data)


class TappedEndpoint(UdpEndpoint):
    """The flight controller's socket, recording arrivals and departures."""

    def __init__(self, remote: Address, tap: Tap) -> None:
        super().__init__((LOOPBACK, 0), remote, local_option="local", remote_option="remote")
        self._tap = tap

    def arrivals(self) -> Iterator[tuple[Peer, bytes]]:
        for peer, data in super().arrivals():
            self._tap.arrived(data)
            yield peer, data

    def towards(self, peer: Peer) -> TappedPeer | None:
        address = self._remote if peer is None else peer
        return None if address is None else TappedPeer(self._socket, address, self._tap)


def run_at_once(*, with_children: bool) -> None:
    """Run this process with real-time priority; `with_children` includes its child processes."""
    way = os.SCHED_FIFO if with_children else os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
    os.sched_setscheduler(0, way, os.sched_param(REALTIME))


@contextmanager
def load(processes: int) -> Iterator[None]:
    """Keep cores busy."""
    busy = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(processes)]
    try:
        yield
    finally:
        for each in busy:
            each.kill()
            each.wait()


def measured(
    asked: Bench, kind: str, python: str, firmware: Firmware, port: int, tap: Tap
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Fly with one client; return the latencies of its setpoints and of its positions [µs]."""
    tap.got.clear()
    tap.sent.clear()
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "stamps.json"
        words = [kind, f"{port}", f"{asked.setpoints}", f"{asked.rate_hz}", f"{out}"]
        client = subprocess.Popen(  # noqa: S603 (our own program)
            [python, f"{CLIENT}", *words], stdout=subprocess.DEVNULL
        )
        limit = time.monotonic() + LONGEST_S + asked.setpoints / asked.rate_hz
        while client.poll() is None and time.monotonic() < limit:
            firmware.step()
        if client.poll() != 0:
            client.kill()
            raise RuntimeError(f"{kind}: the client ended with {client.wait()}")
        stamps = json.loads(out.read_text())
    sent = [tap.got[n] - t for n, t in stamps["sent"] if n in tap.got]
    begun = stamps["sent"][0][1]
    heard = [t - tap.sent[p] for p, t in stamps["heard"] if p in tap.sent and t > begun]
    return np.array(sent) / 1e3, np.array(heard) / 1e3


def clients(asked: Bench) -> dict[str, tuple[str, str]]:
    """Return title and interpreter by kind."""
    own = sys.executable
    found = {
        "pymavlink": (f"pymavlink {version('pymavlink')}", own),
        "mavsdk": (f"MAVSDK {version('mavsdk')}, synchronous", own),
        "mavsdk-asyncio": (f"MAVSDK {version('mavsdk')}, asyncio", own),
    }
    if asked.grpc_python is not None:
        python = str(asked.grpc_python.expanduser())
        say = "from importlib.metadata import version; print(version('mavsdk-grpc'))"
        told = subprocess.run(  # noqa: S603 (the interpreter that was named)
            [python, "-c", say], capture_output=True, text=True, check=True
        )
        found["mavsdk-grpc"] = (f"MAVSDK over gRPC (mavsdk-grpc {told.stdout.strip()})", python)
    return found


def main(asked: Bench) -> None:
    tap, rows, cores = Tap(), [], usable_cores()
    ways = {"setpoint": 0, "telemetry": 1}
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        with closing(UdpEndpoint((LOOPBACK, 0), None, local_option="", remote_option="")) as free:
            port = free.local[1]
        pacing = WallPacing(1.0)
        server = MavlinkServer(
            [onboard_link(TappedEndpoint((LOOPBACK, port), tap))],
            boot_unix_us=0,
            clock=pacing.clock,
        )
        firmware = Firmware(BuiltinFlightStack(server), None, pacing, recording=False)
        stack.enter_context(closing(firmware))
        firmware.load(EpisodeSetup(load_vehicle("quad"), None, 1), folder / "flight.tlog", 0)
        ready = time.monotonic() + READY_S
        while time.monotonic() < ready:
            firmware.step()
        alone = "undisturbed" + (" (SCHED_FIFO)" if asked.realtime else "")
        for condition, busy in (alone, 0), (f"{cores} busy processes", cores):
            if asked.realtime:
                run_at_once(with_children=not busy)
            for kind, (title, python) in clients(asked).items():
                with load(busy):
                    flown = measured(asked, kind, python, firmware, port, tap)
                    others = os.getloadavg()[0]
                for way, which in ways.items():
                    rows.append(
                        (
                            way,
                            title,
                            condition,
                            *duration_cells(summarize(flown[which])),
                            f"{others:.1f}",
                        )
                    )
                    print(*rows[-1], sep="  ", flush=True)
    columns = (
        *(Column("what", number=False), Column("client", number=False)),
        Column("load", number=False),
        *(replace(each, unit="" if each.title == "n" else "ms") for each in DURATION_COLUMNS),
        Column("load average"),
    )
    rows.sort(key=lambda row: tuple(ways).index(row[0]))
    view = TableView("mavsdk-latency", "Latency of MAVLink clients", columns, tuple(rows))
    print_table(view, Console())
    command = shlex.join(["python", "benchmarks/bench_mavsdk.py", *sys.argv[1:]])
    write_table(view, asked.out, provenance(command))


if __name__ == "__main__":
    main(tyro.cli(Bench, description=__doc__))
