"""Lateness of the flight controller with one client and with twenty, in alternating turns.

    python benchmarks/bench_clients.py

Two vehicles fly in real time, never both at once: one has one client, the other has twenty. Every
client commands at 50 Hz, and repeatedly downloads all parameters and a log. Clients run in a
separate process, on real sockets. Prints the lateness of ticks, their processor time, and whether
every command was acknowledged to its sender. Compare the two columns, not two runs: both columns
see the same load on the host.
"""

from __future__ import annotations

import math
import multiprocessing
import socket
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from airl_mav.core.clock import WallClock
from airl_mav.core.constants import TICK_US, US_PER_S
from airl_mav.profiles.vehicle import load_vehicle
from firmware_sim.firmware import BuiltinFlightStack, Firmware
from firmware_sim.mavlink.codec import dialect
from firmware_sim.mavlink.endpoint import UdpEndpoint
from firmware_sim.mavlink.px4_links import gcs_link, onboard_link
from firmware_sim.mavlink.server import MavlinkServer
from firmware_sim.pacing import WallPacing
from firmware_sim.simulation import EpisodeSetup
from firmware_sim.warm_up import warm_up

HOST = "127.0.0.1"
VEHICLE = "quad"
EVERY_S = 0.02
"""Between two commands of a client: 50 Hz."""
LOG_BYTES = 3_000_000
READY_TICKS = 1_750
"""After which the vehicle's estimator is ready."""

_ACK, _PARAM, _LOG, _ATTITUDE = (
    number.to_bytes(3, "little")
    for number in (
        dialect.MAVLINK_MSG_ID_COMMAND_ACK,
        dialect.MAVLINK_MSG_ID_PARAM_VALUE,
        dialect.MAVLINK_MSG_ID_LOG_DATA,
        dialect.MAVLINK_MSG_ID_ATTITUDE,
    )
)


@dataclass(frozen=True)
class Bench:
    """Measure what many clients cost."""

    clients: int = 20
    """Compared with one client."""
    seconds: float = 5.0
    """Duration of a turn."""
    turns: int = 4
    """Turns for each vehicle."""


@dataclass
class Tally:
    """Messages that one client has sent and received."""

    asked: int = 0
    acknowledged: int = 0
    strangers: int = 0
    """Acknowledgements of other clients' commands."""
    parameters: int = 0
    log_bytes: int = 0
    attitudes: int = 0


class Client:
    """A ground station that is in a hurry."""

    def __init__(self, number: int, vehicle: tuple[str, int]) -> None:
        self.tally = Tally()
        self._id = 100 + number
        self._vehicle = vehicle
        self._mav = dialect.MAVLink(None, self._id, 190)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 21)
        self._socket.setblocking(False)

    def _send(self, message: dialect.MAVLink_message) -> None:
        self._socket.sendto(message.pack(self._mav), self._vehicle)
        self._mav.seq = (self._mav.seq + 1) % 256

    def download(self) -> None:
        """Request all parameters and a log."""
        self._send(dialect.MAVLink_param_request_list_message(1, 1))
        self._send(dialect.MAVLink_log_request_data_message(1, 1, 0, 0, LOG_BYTES))

    def command(self) -> None:
        """Request a message."""
        more = [math.nan] * 5
        asked = dialect.MAVLINK_MSG_ID_MESSAGE_INTERVAL, dialect.MAVLINK_MSG_ID_ATTITUDE
        self._send(dialect.MAVLink_command_long_message(1, 1, 512, 0, *asked, *more))
        self.tally.asked += 1

    def listen(self) -> None:
        """Take what has come; by the bytes, so that the clients take little of the host."""
        tally = self.tally
        while True:
            try:
                frame = self._socket.recv(2_048)
            except OSError:
                return
            kind = frame[7:10]
            if kind == _ATTITUDE:
                tally.attitudes += 1
            elif kind == _LOG:
                tally.log_bytes += frame[16] if len(frame) > 18 else 0
            elif kind == _PARAM:
                tally.parameters += 1
            elif kind == _ACK:
                tally.acknowledged += 1
                (ack,) = self._mav.parse_buffer(frame)
                tally.strangers += ack.target_system != self._id


def serve(pipe: Connection) -> None:
    """Be the clients: take a vehicle's address, their number and a duration; answer with tallies.

    Ends when the pipe does.
    """
    known: dict[tuple[str, int], list[Client]] = {}
    while True:
        try:
            vehicle, number, seconds = pipe.recv()
        except EOFError:
            return
        clients = known.setdefault(vehicle, [Client(n, vehicle) for n in range(number)])
        for client in clients:
            client.listen()  # discard messages from between the turns
            client.tally = Tally()
            client.download()
        began = time.monotonic()
        turn = 0
        while (spent := time.monotonic() - began) < seconds:
            while turn * EVERY_S / number < spent:
                clients[turn % number].command()
                turn += 1
            for client in clients:
                client.listen()
            time.sleep(0.001)
        time.sleep(0.2)
        for client in clients:
            client.listen()
        pipe.send([client.tally for client in clients])


class Pacing:
    """Pacing at full speed until `paced`, then in real time; records the lateness of ticks."""

    quiet_until_us = 0.0
    arrivals = None

    def __init__(self) -> None:
        self._wall = WallPacing(1.0)
        self.slipped_us = 0
        self.late_us: list[int] = []
        self.worked_us: list[float] = []
        """Processor time of each tick."""
        self.paced = False
        self._began_s = 0.0

    @property
    def clock(self) -> WallClock:
        return self._wall.clock

    @property
    def epoch_ns(self) -> int:
        return self._wall.epoch_ns

    def restart(self, tick_us: int) -> None:
        self._wall.restart(tick_us)

    def wait(self, tick_us: int, sockets: Sequence[int], readable: Callable[[int], object]) -> int:
        if not self.paced:
            self._wall.restart(tick_us)
            return tick_us
        now_us = self._wall.wait(tick_us, sockets, readable)
        self.slipped_us = self._wall.slipped_us
        self.late_us.append(now_us - tick_us)
        self._began_s = time.thread_time()
        return now_us

    def read_by(self, began_us: int) -> int:
        return self._wall.read_by(began_us)

    def end_tick(self) -> None:
        """Note the processor time since the tick began."""
        self.worked_us.append(1e6 * (time.thread_time() - self._began_s))


@dataclass
class Vehicle:
    """A vehicle of the comparison, with its clients."""

    firmware: Firmware
    pacing: Pacing
    address: tuple[str, int]
    clients: int
    tallies: list[Tally] = field(default_factory=list)

    def turn(self, pipe: Connection, seconds: float) -> None:
        """Fly in real time with the clients; the last moments are for their last answers."""
        self.firmware.step()
        self.pacing.paced = True
        pipe.send((self.address, self.clients, seconds))
        while not pipe.poll():
            self.firmware.step()
            self.pacing.end_tick()
        self.pacing.paced = False
        self.tallies += pipe.recv()


def vehicle(clients: int, folder: Path) -> Vehicle:
    """Boot one."""
    (folder / "flight-000.ulg").write_bytes(bytes(range(256)) * (LOG_BYTES // 256))
    api, gcs = (
        UdpEndpoint((HOST, 0), None, local_option="local", remote_option="remote") for _ in range(2)
    )
    pacing = Pacing()
    links = [onboard_link(api), gcs_link(gcs)]
    server = MavlinkServer(links, boot_unix_us=0, clock=pacing.clock)
    firmware = Firmware(BuiltinFlightStack(server), None, pacing, recording=False)
    firmware.load(EpisodeSetup(load_vehicle(VEHICLE), None, 1), folder / "flight-001.tlog", 0)
    for _ in range(READY_TICKS):
        firmware.step()
    return Vehicle(firmware, pacing, gcs.local, clients)


def row(name: str, values: Callable[[Vehicle], str], flown: Sequence[Vehicle]) -> list[str]:
    return [name, *(values(each) for each in flown)]


def percentiles(values: Sequence[float]) -> str:
    p50, p99, most = np.percentile(values, (50, 99, 100)) / 1e3
    return f"{p50:.2f} / {p99:.2f} / {most:.2f} ms"


def main(asked: Bench) -> None:
    warm_up(load_vehicle(VEHICLE))
    with ExitStack() as stack:
        numbers = 1, asked.clients
        folders = [Path(stack.enter_context(tempfile.TemporaryDirectory())) for _ in numbers]
        flown = [vehicle(n, folder) for n, folder in zip(numbers, folders, strict=True)]
        for each in flown:
            stack.enter_context(closing(each.firmware))
        ours, theirs = multiprocessing.Pipe()
        process = multiprocessing.get_context("spawn").Process(target=serve, args=(theirs,))
        process.start()
        theirs.close()
        for _ in range(asked.turns):
            for each in flown:
                each.turn(ours, asked.seconds)
        ours.close()
        process.join()
    flown_s = asked.turns * asked.seconds
    table = Table("", *(f"{each.clients} clients" for each in flown))
    rows = (
        row("tick begins late (p50 / p99 / max)", lambda v: percentiles(v.pacing.late_us), flown),
        row("processor time (p50 / p99 / max)", lambda v: percentiles(v.pacing.worked_us), flown),
        row(
            f"begun more than a tick late ({TICK_US / 1e3:.0f} ms)",
            lambda v: f"{100 * np.mean(np.array(v.pacing.late_us) > TICK_US):.2f} %",
            flown,
        ),
        row(
            "commands acknowledged",
            lambda v: (
                f"{sum(t.acknowledged for t in v.tallies)} of {sum(t.asked for t in v.tallies)}"
            ),
            flown,
        ),
        row("to somebody else", lambda v: f"{sum(t.strangers for t in v.tallies)}", flown),
        row(
            "ATTITUDE, the slowest client",
            lambda v: f"{min(t.attitudes for t in v.tallies) / asked.seconds:.0f} Hz",
            flown,
        ),
        row("parameters, a turn", lambda v: f"{min(t.parameters for t in v.tallies)}", flown),
        row(
            "log, all clients",
            lambda v: f"{sum(t.log_bytes for t in v.tallies) / flown_s / 1e3:.0f} kB/s",
            flown,
        ),
        row("given up", lambda v: f"{v.firmware.slipped_us / US_PER_S:.2f} s", flown),
    )
    for line in rows:
        table.add_row(*line)
    Console().print(table)


if __name__ == "__main__":
    main(tyro.cli(Bench))
