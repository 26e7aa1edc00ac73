"""tlog: raw MAVLink with receive times, readable by MAVProxy, QGroundControl and pymavlink.

A record is an 8-byte big-endian time [µs since 1970, UTC] and one frame.
"""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path

from airl_mav.core.log_file import LogFile
from firmware_sim.mavlink.clients import Client
from firmware_sim.mavlink.codec import WireMessage

_TIME = struct.Struct(">Q")
_LINK_BITS = 0b11
"""MAVProxy keeps a link number in a time's two lowest bits; ours is 0."""

MAX_LOGS = 16
"""Logs of a flight beside the main one."""

MAX_BYTES = 1 << 28
"""Size at which a log beside the main one ends: hours of telemetry, and a flood fills no disk."""


class TlogWriter(LogFile):
    """Writes a log of MAVLink frames."""

    def __init__(
        self, path: Path, start_unix_us: int, on_lost: Callable[[str], None] = lambda _: None
    ) -> None:
        """Open the file, whose final name is `path`; see `LogFile`.

        `start_unix_us` is the calendar time of simulated time 0 [µs since 1970, UTC].
        """
        super().__init__(path, on_lost)
        self._start_unix_us = start_unix_us

    def beside(self, name: str) -> TlogWriter:
        """Open another log of the same times: flight-001.NAME.tlog beside flight-001.tlog.

        Raises OSError.
        """
        path = self.path.with_name(f"{self.path.stem}.{name}{self.path.suffix}")
        return TlogWriter(path, self._start_unix_us, self.on_lost)

    def write(self, time_us: int, *frames: bytes) -> None:
        """Add frames, sent or received at simulated `time_us` [µs]."""
        stamp = _TIME.pack(self._start_unix_us + time_us & ~_LINK_BITS)
        self.add(time_us, *(part for frame in frames for part in (stamp, frame)))


class TrafficLog:
    """One tlog per client. The main one is that of the preset remote."""

    def __init__(self, now_us: Callable[[], int]) -> None:
        """Take what returns the simulated time [µs]."""
        self._now_us = now_us
        self._main: TlogWriter | None = None
        self._logged: dict[Client, TlogWriter] = {}
        """By client, in the order in which they were heard."""
        self._names: Counter[str] = Counter()

    def begin(self, tlog: TlogWriter, client: Client | None) -> None:
        """Log a client to `tlog`, which the caller closes, and all that speak beside it."""
        self.end()
        self._main = tlog
        if client is not None:
            self._names[client.link.name] += 1
            self._tap(client, tlog)

    def heard(self, client: Client, message: WireMessage) -> None:
        """Note what a client has said: with its first frame its log begins."""
        main = self._main
        if main is None or client in self._logged or len(self._logged) > MAX_LOGS:
            return
        name = client.link.name
        self._names[name] += 1
        number = self._names[name]
        try:
            tlog = main.beside(name if number == 1 else f"{name}-{number}")
        except OSError:
            self._main = None  # a full disk: the flight goes on, and no more logs are begun
            return
        tlog.write(self._now_us(), bytes(message.get_msgbuf()))
        self._tap(client, tlog)

    def end(self) -> None:
        """Stop, and complete the logs that were opened here."""
        for client, tlog in self._logged.items():
            client.link.tap = None
            if tlog is not self._main:
                tlog.close()
        self._main = None
        self._logged.clear()
        self._names.clear()

    def _tap(self, client: Client, tlog: TlogWriter) -> None:
        self._logged[client] = tlog

        def write(frames: Sequence[bytes]) -> None:
            if tlog is not self._main and tlog.size_bytes >= MAX_BYTES:
                client.link.tap = None
                return
            tlog.write(self._now_us(), *frames)

        client.link.tap = write
