"""tlog: raw MAVLink with receive times, for MAVProxy, QGroundControl and pymavlink.

A record is an 8-byte big-endian time [µs since 1970, UTC] and one frame.
"""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path

from airl_mav.core.files import LogFile
from firmware_sim.mavlink.clients import Client
from firmware_sim.mavlink.codec import WireMessage

_TIME = struct.Struct(">Q")
_LINK_BITS = 0b11
"""Low bits of a time stamp, where MAVProxy stores a link number; always 0 here."""

MAX_LOGS = 16
"""Maximum number of additional logs per flight."""

MAX_BYTES = 1 << 28
"""Maximum size of an additional log [bytes]: hours of telemetry. A flood cannot fill the disk."""


class TlogWriter(LogFile):
    """Writer of a log of MAVLink frames."""

    def __init__(
        self, path: Path, start_unix_us: int, on_lost: Callable[[str], None] = lambda _: None
    ) -> None:
        """Open the file with final name `path`; see `LogFile`.

        `start_unix_us` is the calendar time of simulated time 0 [µs since 1970, UTC].
        """
        super().__init__(path, on_lost)
        self._start_unix_us = start_unix_us

    def beside(self, name: str) -> TlogWriter:
        """Open an additional log: flight-001.NAME.tlog next to flight-001.tlog.

        Raises OSError.
        """
        path = self.path.with_name(f"{self.path.stem}.{name}{self.path.suffix}")
        return TlogWriter(path, self._start_unix_us, self.on_lost)

    def write(self, time_us: int, *frames: bytes) -> None:
        """Add frames sent or received at simulated `time_us` [µs]."""
        stamp = _TIME.pack(self._start_unix_us + time_us & ~_LINK_BITS)
        self.add(time_us, *(part for frame in frames for part in (stamp, frame)))


class TrafficLog:
    """Set of tlogs, one per client. The main log belongs to the preset remote."""

    def __init__(self, now_us: Callable[[], int]) -> None:
        """Store the callable that returns the simulated time [µs]."""
        self._now_us = now_us
        self._main: TlogWriter | None = None
        self._logged: dict[Client, TlogWriter] = {}
        """Writers by client, in order of arrival."""
        self._names: Counter[str] = Counter()

    def begin(self, tlog: TlogWriter, client: Client | None) -> None:
        """Log `client` to `tlog`, which the caller closes, and other clients to additional logs."""
        self.end()
        self._main = tlog
        if client is not None:
            self._names[client.link.name] += 1
            self._tap(client, tlog)

    def heard(self, client: Client, message: WireMessage) -> None:
        """Start a client's log at its first frame."""
        main = self._main
        # The limit bounds the open files during a flood of clients.
        if main is None or client in self._logged or len(self._logged) > MAX_LOGS:
            return
        name = client.link.name
        self._names[name] += 1
        number = self._names[name]
        try:
            tlog = main.beside(name if number == 1 else f"{name}-{number}")
        except OSError:
            self._main = None  # disk full: the flight continues without new logs
            return
        # The client's first frame came before the tap was set.
        tlog.write(self._now_us(), bytes(message.get_msgbuf()))
        self._tap(client, tlog)

    def end(self) -> None:
        """Stop logging and close the additional logs."""
        for client, tlog in self._logged.items():
            # The tap ends first, so that no frame reaches a closed file.
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
