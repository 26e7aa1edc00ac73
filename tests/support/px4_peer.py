"""Behaves on the wire as PX4 SITL was measured to, and flies the built-in autopilot behind it.

    python -m tests.support.px4_peer -i INSTANCE [--fault KIND@SECONDS] ...

Connects to TCP 4560 + INSTANCE and flies whatever simulates for it, as `px4 -i INSTANCE` does; the
links are PX4's four. Written from the measurements, with pymavlink's own parser: nothing of the
bridge under test is used. It stays system 1 at every instance (PX4: instance + 1).
"""

from __future__ import annotations

import argparse
import math
import os
import random
import select
import shlex
import signal
import socket
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import common as dialect

from airl_mav.core.frames import Geodetic
from airl_mav.profiles.vehicle import VehicleProfile, load_vehicle
from firmware_sim.autopilot.autopilot import BuiltinAutopilot
from firmware_sim.interfaces import BatterySample, GpsFix, SensorSample
from firmware_sim.mavlink.endpoint import UdpEndpoint
from firmware_sim.mavlink.px4_links import LinkConfig, gcs_link, onboard_link
from firmware_sim.mavlink.server import MavlinkServer
from tests.support.ports import LOOPBACK
from tests.support.processes import ROOT
from tests.support.px4_frame import SWAPPED, Px4Parameters

SILENT_SAMPLES = 22
"""HIL_SENSOR messages without an answer while it boots."""

STATE_INTERVAL_US = 5_000
ANSWER_US = 8_000
"""Delay of a command's answer."""
RETRY_S = 0.005

BATTERY = BatterySample(voltage_v=16.2, current_a=5.0, consumed_mah=0.0, remaining=1.0)
"""PX4 simulates its own."""

MAG, BARO = 0b111000000, 0b1101000000000

PAYLOAD_HZ = {
    "HEARTBEAT": 1.0,
    "EXTENDED_SYS_STATE": 2.0,
    "SYS_STATUS": 2.0,
    "ATTITUDE": 14.0,
    "LOCAL_POSITION_NED": 4.0,
    "GLOBAL_POSITION_INT": 7.0,
    "GPS_RAW_INT": 8.0,
}
GIMBAL_HZ = {"HEARTBEAT": 1.0}

FAULTS = {
    "die": "the process ends",
    "stall": "it answers nothing any more",
    "idle": "disarmed, it answers every 13th sample only, as in Offboard without a setpoint",
    "restart": "it closes its connection, comes back and boots",
    "garbage": "answers become random bytes",
    "noise": "some random bytes before one answer",
    "old": "answers carry a time that has passed",
    "future": "answers carry a time that is to come",
    "twice": "every answer is sent twice",
    "nan": "motor commands are no numbers, while armed",
    "servo": "a motor command is negative, while armed",
    "spin": "motors are commanded while disarmed",
    "absent": "it never connects",
    "motors": "the rotors are in another order",
    "no-lockstep": "a build that does not wait for the simulator",
}


@dataclass
class Ports:
    """Ports of the simulator link (TCP) and of the MAVLink links (UDP): local and remote."""

    simulator: int
    api: tuple[int, int]
    gcs: tuple[int, int]
    payload: tuple[int, int]
    gimbal: tuple[int, int]


def ports_of(instance: int) -> Ports:
    """Return PX4's ports. It sends to one API port from instance 9 on, and to one GCS port."""
    return Ports(
        4560 + instance,
        (14580 + instance, 14540 + min(instance, 9)),
        (18570 + instance, 14550),
        (14280 + instance, 14030 + instance),
        (13030 + instance, 13280 + instance),
    )


@dataclass
class Px4Peer:
    """One PX4. `run` flies until the simulator or a fault ends it."""

    ports: Ports
    faults: dict[str, float] = field(default_factory=dict)
    """Kind -> seconds since boot, by the peer's clock."""
    vehicle: VehicleProfile = field(default_factory=lambda: load_vehicle("quad"))
    stop: threading.Event = field(default_factory=threading.Event)
    """Ends it, from another thread."""
    on_connect: Callable[[], None] = lambda: None
    """Called when it has connected."""
    links: list[LateAnswers] = field(default_factory=list)
    """Its ends of its links."""
    heard: deque[Any] = field(default_factory=lambda: deque(maxlen=2000))
    """The newest HIL messages that came."""

    def run(self) -> str:
        """Fly; return what ended it: the fault, "closed" or "stopped"."""
        if "absent" in self.faults:
            self.stop.wait()
            return "absent"
        server = self._server()
        try:
            while True:
                ended = self._boot(server)
                if ended != "restart":
                    return ended
                del self.faults["restart"]
        finally:
            server.close()

    def _boot(self, server: MavlinkServer) -> str:
        connection = self._connect()
        if connection is None:
            return "stopped"
        with connection:
            return Flying(self, connection, server).run()

    def _connect(self) -> socket.socket | None:
        while not self.stop.is_set():
            connection = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
            try:
                connection.connect((LOOPBACK, self.ports.simulator))
            except OSError:
                connection.close()
                time.sleep(RETRY_S)
                continue
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            connection.settimeout(0.1)
            self.on_connect()
            return connection
        return None

    def _server(self) -> MavlinkServer:
        def link(ports: tuple[int, int]) -> UdpEndpoint:
            local, remote = ((LOOPBACK, port) for port in ports)
            made = LateAnswers(local, remote, local_option="local", remote_option="remote")
            self.links.append(made)
            return made

        ports = self.ports
        links = [
            onboard_link(link(ports.api)),
            gcs_link(link(ports.gcs)),
            LinkConfig("payload", link(ports.payload), PAYLOAD_HZ),
            LinkConfig("gimbal", link(ports.gimbal), GIMBAL_HZ),
        ]
        return MavlinkServer(links, boot_unix_us=1_700_000_000_000_000)


class LateAnswers(UdpEndpoint):
    """A link on which commands are answered some milliseconds of simulated time later, as PX4's."""

    def __init__(self, *addresses: Any, **options: Any) -> None:
        super().__init__(*addresses, **options)
        self.now_us = 0
        self.held: deque[tuple[int, bytes]] = deque()

    def send(self, data: bytes) -> None:
        if int.from_bytes(data[7:10], "little") == dialect.MAVLINK_MSG_ID_COMMAND_ACK:
            self.held.append((self.now_us + ANSWER_US, data))
        else:
            super().send(data)

    def release(self, now_us: int) -> None:
        """Send the answers that are due."""
        self.now_us = now_us
        while self.held and self.held[0][0] <= now_us:
            super().send(self.held.popleft()[1])


class Flying:
    """From one boot to the end of its connection."""

    def __init__(self, peer: Px4Peer, connection: socket.socket, server: MavlinkServer) -> None:
        self.peer, self.connection, self.server = peer, connection, server
        self.mav = dialect.MAVLink(None, srcSystem=1, srcComponent=1)
        self.parser = dialect.MAVLink(None)
        self.now_us = 0
        self.waiter = select.poll()
        for readable in (connection.fileno(), *server.filenos()):
            self.waiter.register(readable, select.POLLIN)
        store = Px4Parameters(peer.vehicle, swapped="motors" in peer.faults)
        self.autopilot = BuiltinAutopilot(store)
        self.samples = 0
        self.first_us: int | None = None
        self.gps: GpsFix | None = None
        self.random = random.Random(1)

    def run(self) -> str:
        for_state = dialect.MAVLINK_MSG_ID_HIL_STATE_QUATERNION
        nothing = (0.0,) * 5
        ask = (dialect.MAV_CMD_SET_MESSAGE_INTERVAL, 0, for_state, STATE_INTERVAL_US, *nothing)
        self._send(dialect.MAVLink_command_long_message(0, 0, *ask))
        self._send(dialect.MAVLink_heartbeat_message(0, dialect.MAV_AUTOPILOT_PX4, 0, 0, 0, 3))
        while not self.peer.stop.is_set():
            ready = [number for number, _ in self.waiter.poll(100)]
            if self.connection.fileno() not in ready:
                # While its simulated time is stopped, MAVLink is received by the wall clock.
                if ready and self.samples > SILENT_SAMPLES + 1:
                    self.server.receive(self.now_us)
                continue
            try:
                data = self.connection.recv(65_536)
            except TimeoutError:
                continue
            except OSError:
                return "closed"
            if not data:
                return "closed"
            for message in self.parser.parse_buffer(data) or []:
                ended = self._take(message)
                if ended is not None:
                    return ended
        return "stopped"

    def _take(self, message: Any) -> str | None:
        kind = message.get_type()
        if kind == "HIL_GPS":
            self.gps = _fix(message)
        self.peer.heard.append(message)
        if kind != "HIL_SENSOR" or message.id != 0:
            return None
        if self.first_us is None:
            self.first_us = message.time_usec
        self.samples += 1
        if self.samples <= SILENT_SAMPLES:
            return None
        for fault in ("die", "restart", "stall"):
            if self._faulty(fault, message.time_usec):
                return self._end(fault)
        self._step(message)
        return None

    def _end(self, fault: str) -> str:
        if fault == "stall":
            self.peer.stop.wait()
        return fault

    def _faulty(self, kind: str, now_us: int) -> bool:
        at_s = self.peer.faults.get(kind)
        if at_s is None or self.first_us is None:
            return False
        return now_us - self.first_us >= at_s * 1e6

    def _step(self, message: Any) -> None:
        now_us = self.now_us = message.time_usec
        for link in self.peer.links:
            link.release(now_us)
        sample = _sample(message, self.gps)
        self.gps = None
        if self.samples > SILENT_SAMPLES + 1:
            self.server.receive(now_us)
        controls = self.autopilot.step(sample)
        if self.samples == SILENT_SAMPLES + 1:
            self.server.attach(self.autopilot)
        self.server.send(now_us)
        motors = list(controls.motors)
        if "motors" in self.peer.faults:
            motors = [motors[i] for i in SWAPPED]
        if self._faulty("spin", now_us) and not controls.armed:
            motors = [0.5] * 4
        if self._faulty("nan", now_us) and controls.armed:
            motors[1] = math.nan
        if self._faulty("servo", now_us) and controls.armed:
            motors[2] = -0.5
        self._answer(now_us, motors, armed=controls.armed)

    def _answer(self, now_us: int, motors: list[float], *, armed: bool) -> None:
        if self._faulty("garbage", now_us):
            self._out(self.random.randbytes(20_000))
            return
        if self._faulty("noise", now_us):
            del self.peer.faults["noise"]
            self._out(bytes(self.random.randrange(0xFD) for _ in range(300)))
        if self._faulty("idle", now_us) and not armed and self.samples % 13:
            return
        stamp_us = now_us
        if self._faulty("old", now_us):
            stamp_us -= 1_000_000
        if self._faulty("future", now_us):
            stamp_us += 1_000_000
        flags = 0 if "no-lockstep" in self.peer.faults else 1
        answer = dialect.MAVLink_hil_actuator_controls_message(
            stamp_us, [*motors, *[0.0] * 12], 129 if armed else 1, flags
        )
        self._send(answer)
        if self._faulty("twice", now_us):
            self._send(answer)

    def _send(self, message: Any) -> None:
        self._out(message.pack(self.mav))
        self.mav.seq = (self.mav.seq + 1) % 256

    def _out(self, data: bytes) -> None:
        try:
            self.connection.sendall(data)
        except OSError:
            return  # the next recv reports the error


def _fix(message: Any) -> GpsFix:
    return GpsFix(
        Geodetic(message.lat / 1e7, message.lon / 1e7, message.alt / 1e3),
        np.array([message.vn, message.ve, message.vd]) / 100.0,
        message.eph / 100.0,
        message.epv / 100.0,
        message.satellites_visible,
        message.fix_type,
    )


def _sample(message: Any, gps: GpsFix | None) -> SensorSample:
    fields = message.fields_updated
    assert fields & 0b111111 == 0b111111
    m = message
    return SensorSample(
        m.time_usec,
        np.array([m.xacc, m.yacc, m.zacc]),
        np.array([m.xgyro, m.ygyro, m.zgyro]),
        m.temperature,
        BATTERY,
        np.array([m.xmag, m.ymag, m.zmag]) if fields & MAG == MAG else None,
        m.abs_pressure if fields & BARO == BARO else None,
        gps,
    )


def write_build(folder: Path, *options: str) -> Path:
    """Write what looks like PX4's build folder and starts a peer; return it."""
    program = folder / "bin" / "px4"
    program.parent.mkdir(parents=True)
    script = folder / "etc" / "init.d-posix" / "rcS"
    script.parent.mkdir(parents=True)
    script.touch()
    words = [f"PYTHONPATH={ROOT}", sys.executable, str(Path(__file__).resolve()), *options]
    program.write_text(f'#!/bin/sh\nexec env {shlex.join(words)} "$@"\n')
    program.chmod(0o755)
    return folder


def fault(word: str) -> tuple[str, float]:
    """Return kind and time of KIND[@SECONDS]."""
    kind, _, seconds = word.partition("@")
    if kind not in FAULTS:
        raise argparse.ArgumentTypeError(f"{kind}: choose from {', '.join(FAULTS)}")
    return kind, float(seconds or 0.0)


def pair(word: str) -> tuple[int, int]:
    """Return a local and a remote port, LOCAL:REMOTE."""
    local, _, remote = word.partition(":")
    return int(local), int(remote)


def leave_when_told() -> None:
    """End at SIGTERM from now on, at once and in order."""
    signal.signal(signal.SIGTERM, lambda *_: os._exit(0))


def say(text: str) -> None:
    """Print a line at once."""
    sys.stdout.write(f"peer: {text}\n")
    sys.stdout.flush()


def main() -> None:
    """Run until the end of the world, as PX4 does: it outlives its simulator."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-i", dest="instance", type=int, default=0)
    for ignored in ("-w", "-s"):
        parser.add_argument(ignored, help="as px4; ignored")
    parser.add_argument("-d", action="store_true", help="as px4; ignored")
    parser.add_argument("etc", nargs="?", help="as px4; ignored")
    parser.add_argument("--port", type=int, help="TCP port of the simulator")
    for link in ("api", "gcs", "payload", "gimbal"):
        parser.add_argument(f"--{link}", type=pair, metavar="LOCAL:REMOTE")
    parser.add_argument("--fault", type=fault, action="append", default=[], metavar="KIND@SECONDS")
    options = parser.parse_args()
    ports = ports_of(options.instance)
    if options.port is not None:
        ports.simulator = options.port
    for link in ("api", "gcs", "payload", "gimbal"):
        if getattr(options, link) is not None:
            setattr(ports, link, getattr(options, link))
    # As PX4: while it waits for its simulator it cannot be ended in order.
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    say(f"simulator on TCP port {ports.simulator}")
    ended = Px4Peer(ports, dict(options.fault), on_connect=leave_when_told).run()
    say(ended)
    if ended == "die":
        os._exit(1)
    threading.Event().wait()


if __name__ == "__main__":
    main()
