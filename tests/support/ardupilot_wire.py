"""ArduPilot's end of its JSON simulator interface, as its SIM_JSON.cpp reads and writes."""

from __future__ import annotations

import re
import socket
import struct
from collections.abc import Callable
from typing import NamedTuple

MAGIC = 18_458
RESEND_S = 1.0
_NUMBER = r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)"
"""Number accepted by scanf's %f."""


class State(NamedTuple):
    """One state line as ArduPilot takes it."""

    timestamp_s: float
    gyro: tuple[float, ...]
    accel: tuple[float, ...]
    position: tuple[float, ...]
    quaternion: tuple[float, ...]
    velocity: tuple[float, ...]
    no_time_sync: bool


def read_state(line: str) -> State | None:
    """Read a line by ArduPilot's rules (strstr, then atof or sscanf); None when it would not do."""
    values = []
    for section, key, count in (
        ("", "timestamp", 0),
        ("imu", "gyro", 3),
        ("imu", "accel_body", 3),
        ("", "position", 3),
        ("", "quaternion", 4),
        ("", "velocity", 3),
    ):
        rest = _behind(line, section, key)
        if rest is None:
            return None
        found = _scan(rest, count) if count else re.match(_NUMBER, rest)
        if found is None:
            return None
        values.append(tuple(float(number) for number in found.groups()))
    sync = _behind(line, "", "no_time_sync")
    (stamp,), gyro, accel, position, quaternion, velocity = values
    no_time_sync = sync is not None and re.match(r"\s*0*[1-9]", sync) is not None
    return State(stamp, gyro, accel, position, quaternion, velocity, no_time_sync)


def _behind(line: str, section: str, key: str) -> str | None:
    """Return what follows a key and the two characters `":` behind it, as strstr finds it."""
    start = line.find(section)
    if start < 0:
        return None
    found = line.find(key, start + len(section) + 1)
    return None if found < 0 else line[found + len(key) + 2 :]


def _scan(rest: str, count: int) -> re.Match[str] | None:
    """sscanf "[%f, %f, %f]": the bracket stands at once, blanks only before numbers."""
    return re.match(r"\[" + ",".join([_NUMBER] * count), rest)


class JsonLink:
    """Sends servo packets and waits for state lines; the clock goes by their timestamps."""

    def __init__(self, port: int, rate_hz: int) -> None:
        self.address = ("127.0.0.1", port)
        self.rate_hz = rate_hz
        self.frame_count = 0
        self.time_us = 0
        """ArduPilot's own time."""
        self.stamps: list[float] = []
        """Timestamps of the lines that moved time."""
        self.resent = 0
        self.stalled_lines = 0
        """Lines that did not move time: less than 0, or 0.1 s and more."""
        self.stop: Callable[[], bool] = lambda: False
        """Callback: return True to stop waiting. Set by the caller."""
        self._last_s = 0.0
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.settimeout(0.1)

    def send(self, pwm: list[int], magic: int = MAGIC) -> None:
        """Send a servo packet of 16 channels."""
        channels = [*pwm, *[0] * (16 - len(pwm))]
        self.send_bytes(
            struct.pack("<HHI16H", magic, self.rate_hz, self.frame_count & 0xFFFFFFFF, *channels)
        )

    def send_bytes(self, data: bytes) -> None:
        self._socket.sendto(data, self.address)

    def exchange(self, pwm: list[int]) -> State | None:
        """Send a packet and wait for its line, asking again every second; None after a slice."""
        self.send(pwm)
        slices = 0
        while True:
            try:
                data = self._socket.recv(65_000)
                break
            except TimeoutError:
                slices += 1
                if slices * 0.1 >= RESEND_S:
                    slices = 0
                    self.resent += 1
                    self.send(pwm)
                if self.stop():
                    return None
        assert data[:1] == b"\n"
        assert data[-1:] == b"\n"
        state = read_state(data.strip(b"\n").decode("ascii"))
        assert state is not None, data
        step_s = state.timestamp_s - self._last_s
        self._last_s = state.timestamp_s
        if 0.0 < step_s < 0.1:
            self.time_us += round(step_s * 1e6)
            self.stamps.append(state.timestamp_s)
        else:
            self.stalled_lines += 1
        self.frame_count += 1
        return state

    def close(self) -> None:
        self._socket.close()
