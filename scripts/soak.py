"""Memory soak test of the flight controller: a simulated day of `airl-firmware`.

    python scripts/soak.py --hours 24

Runs the program alone, as fast as possible: a vehicle with a pack of a thousand ampere hours takes
off and is sent to changing positions by a client, which also downloads parameters, lists logs and
files, changes rates and uploads missions. Writes a line of JSON every half hour: resident memory,
open files, threads, and the client's message counts. Exit status 1 if the memory grows after the
first hour by more than allowed, the vehicle comes down, or the firmware stops answering.
"""

from __future__ import annotations

import json
import math
import re
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from firmware_sim.mavlink.codec import dialect

HOUR_S = 3_600.0
EVERY_S = 0.5 * HOUR_S
"""Interval between two lines [simulated s]."""
SETTLED_S = HOUR_S
"""Time until one-time allocations are complete: caches, kernels, the first lists [simulated s]."""

ALTITUDE_M = 30.0
RADIUS_M = 15.0
SILENT_S = 300.0
"""Timeout without answers, after which the soak fails [wall s]."""

Said = Any
"""MAVLink message."""


@dataclass(frozen=True)
class Soak:
    """Fly airl-firmware for a long time, and check for memory growth."""

    hours: float = 24.0
    """Simulated time [h]."""

    instance: int = 8
    """Instance number, which moves the ports."""

    allowed_mb: float = 4.0
    """Maximum growth of the resident memory after the first hour [MB]."""

    out: Path = Path("soak.jsonl")
    """Output file of the lines."""


class Client:
    """Ground station with continuous requests."""

    def __init__(self, instance: int) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._vehicle = "127.0.0.1", 18_570 + instance
        self._ids = instance + 1, 1
        self._mav = dialect.MAVLink(None, 255, 190)
        self._mav.robust_parsing = True
        self.got: Counter[str] = Counter()
        self.boot_s = 0.0
        """Simulated time of the newest message [s]."""
        self.altitude_m = 0.0
        """Altitude above home [m]."""
        self.home: tuple[int, int, int] | None = None
        """Latitude and longitude [1e-7 deg], altitude [mm]."""
        self.heard = time.monotonic()
        self._turn = 0

    def send(self, message: Said) -> None:
        """Send a message."""
        self._socket.sendto(message.pack(self._mav), self._vehicle)
        self._mav.seq = (self._mav.seq + 1) % 256

    def command(self, number: int, *params: float) -> None:
        """Send a COMMAND_LONG; parameters not given are NaN."""
        filled = [*params, *[math.nan] * (7 - len(params))]
        self.send(dialect.MAVLink_command_long_message(*self._ids, number, 0, *filled))

    def listen(self) -> None:
        """Process received messages."""
        while True:
            try:
                data = self._socket.recv(4_096)
            except OSError:
                return
            self.heard = time.monotonic()
            for message in self._mav.parse_buffer(data) or ():
                self._note(message)

    def _note(self, message: Said) -> None:
        kind = message.get_type()
        self.got[kind] += 1
        if kind == "GLOBAL_POSITION_INT":
            self.boot_s = message.time_boot_ms / 1e3
            self.altitude_m = message.relative_alt / 1e3
        elif kind == "HOME_POSITION" and self.home is None:
            self.home = message.latitude, message.longitude, message.altitude
        elif kind == "MISSION_REQUEST_INT":
            self._send_item(message.seq)

    def work(self) -> None:
        """Execute the next request in turn."""
        self._turn += 1
        self.send(dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3))
        turn = self._turn % 11
        ids = self._ids
        if turn == 0:
            self.send(dialect.MAVLink_param_request_list_message(*ids))
        elif turn == 1:
            self.send(dialect.MAVLink_mission_count_message(*ids, 4, 0))
        elif turn == 2:
            self.send(dialect.MAVLink_log_request_list_message(*ids, 0, 0xFFFF))
        elif turn == 3:
            body = bytes((self._turn & 0xFF, self._turn >> 8 & 0xFF, 0, 3, 1, 0, 0, 0, 0, 0, 0, 0))
            body = (body + b"/").ljust(251, b"\0")
            self.send(dialect.MAVLink_file_transfer_protocol_message(0, *ids, list(body)))
        elif turn == 4:
            self.command(511, dialect.MAVLINK_MSG_ID_ATTITUDE, 1e4 + self._turn % 100)
        elif turn == 5:
            self.send(dialect.MAVLink_mission_request_list_message(*ids, 0))
        elif turn == 6:
            value = 5.0 + self._turn % 5
            name = b"MPC_XY_VEL_MAX"
            self.send(dialect.MAVLink_param_set_message(*ids, name, value, 9))
        elif turn == 7:
            # Rejected with a text and an event, each time a different one.
            self.command(dialect.MAV_CMD_COMPONENT_ARM_DISARM, 2.0 + self._turn % 1000)
        elif turn == 8:
            self.send(dialect.MAVLink_request_event_message(*ids, 0, 0xFFFF))
        elif turn == 9:
            self.command(512, dialect.MAVLINK_MSG_ID_HIL_STATE_QUATERNION)
        elif self.home is not None:
            self._go_on(*self.home)

    def _go_on(self, latitude: int, longitude: int, altitude_mm: int) -> None:
        above_sea_m = altitude_mm / 1e3 + ALTITUDE_M
        if self.altitude_m < 0.5 * ALTITUDE_M:
            self.command(400, 1.0)
            self.command(
                22, math.nan, math.nan, math.nan, math.nan, math.nan, math.nan, above_sea_m
            )
            return
        angle = self._turn * 2.4
        metres = RADIUS_M / 1.113e-2  # 1e-7 deg of latitude
        east = metres / math.cos(math.radians(latitude / 1e7))
        self.send(
            dialect.MAVLink_command_int_message(
                *(*self._ids, 5, dialect.MAV_CMD_DO_REPOSITION, 0, 0, -1.0, 1.0, 0.0, math.nan),
                latitude + int(metres * math.cos(angle)),
                longitude + int(east * math.sin(angle)),
                above_sea_m,
            )
        )

    def _send_item(self, sequence: int) -> None:
        latitude, longitude, _ = self.home or (473977430, 85455940, 0)
        self.send(
            dialect.MAVLink_mission_item_int_message(
                *(*self._ids, sequence, 6, 16, 0, 1, 0.0, 1.0, 0.0, math.nan),
                *(latitude, longitude + 1000 * sequence, ALTITUDE_M, 0),
            )
        )


def tireless(folder: Path) -> Path:
    """Write a vehicle with a pack for days; return its file."""
    path = folder / "tireless.toml"
    path.write_text('base = "quad"\n[battery]\ncapacity_mah = 1_000_000.0\n', encoding="utf-8")
    return path


def memory_mb(pid: int) -> float:
    """Return a process' resident memory [MB]."""
    text = Path(f"/proc/{pid}/status").read_text(encoding="ascii")
    found = re.search(r"VmRSS:\s+(\d+) kB", text)
    if found is None:
        raise ProcessLookupError(f"process {pid} has ended")
    return int(found[1]) / 1_024.0


def entries(pid: int, folder: str) -> int:
    """Return the number of entries in a folder of a process in /proc."""
    return sum(1 for _ in Path(f"/proc/{pid}", folder).iterdir())


def line_of(pid: int, client: Client, wall_s: float) -> dict[str, float | int]:
    """Return the figures of the current moment."""
    got = client.got
    return {
        "simulated_h": round(client.boot_s / HOUR_S, 3),
        "wall_s": round(wall_s, 1),
        "memory_mb": round(memory_mb(pid), 2),
        "open_files": entries(pid, "fd"),
        "threads": entries(pid, "task"),
        "altitude_m": round(client.altitude_m, 1),
        "acks": got["COMMAND_ACK"] + got["MISSION_ACK"],
        "parameters": got["PARAM_VALUE"],
        "messages": got.total(),
    }


def verdict(lines: list[dict[str, float | int]], allowed_mb: float) -> str | None:
    """Return the problem, or None."""
    settled = [line for line in lines if line["simulated_h"] * HOUR_S >= SETTLED_S]
    if len(settled) < 2:
        return "less than an hour and a half was flown"
    grown = max(line["memory_mb"] for line in settled) - settled[0]["memory_mb"]
    if grown > allowed_mb:
        return f"the memory grew by {grown:.1f} MB"
    if max(line["open_files"] for line in settled) > settled[0]["open_files"] + 2:
        return "files are left open"
    if min(line["altitude_m"] for line in settled) < 0.5 * ALTITUDE_M:
        return "the vehicle came down"
    return None


def main(asked: Soak) -> int:
    # The vehicle ends with this program in any case.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.default_int_handler)
    lines: list[dict[str, float | int]] = []
    client = Client(asked.instance)
    with tempfile.TemporaryDirectory() as folder, asked.out.open("w", encoding="utf-8") as out:
        words = [
            sys.executable,
            "-m",
            "airl_mav.cli.firmware_command",
            f"--vehicle={tireless(Path(folder))}",
        ]
        words += ["--arena=no-obstacles", "--speed=max", f"--instance={asked.instance}"]
        program = subprocess.Popen(words, stdout=subprocess.DEVNULL)
        began = client.heard = time.monotonic()
        try:
            while client.boot_s < asked.hours * HOUR_S:
                client.work()
                for _ in range(50):  # Frequent reads prevent an overflow of the socket's buffer
                    client.listen()
                    time.sleep(0.002)
                now = time.monotonic()
                if program.poll() is not None or now - client.heard > SILENT_S:
                    print(f"nobody answers (exit status {program.returncode})")
                    return 1
                if client.boot_s >= len(lines) * EVERY_S and client.boot_s > 0.0:
                    lines.append(line_of(program.pid, client, now - began))
                    print(json.dumps(lines[-1]), file=out, flush=True)
                    print(lines[-1], flush=True)
        except KeyboardInterrupt:
            print("stopped")
        finally:
            program.send_signal(signal.SIGINT)
            program.wait()
    wrong = verdict(lines, asked.allowed_mb) if lines else "nothing was flown"
    print(wrong or f"flat over {lines[-1]['simulated_h']:.1f} h")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Soak)))
