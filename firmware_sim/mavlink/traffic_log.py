"""Logs of a flight's MAVLink: one a client, both directions."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence

from firmware_sim.mavlink.clients import Client
from firmware_sim.mavlink.codec import WireMessage
from firmware_sim.mavlink.tlog import TlogWriter

MAX_LOGS = 16
"""Logs of a flight beside the main one."""


MAX_BYTES = 1 << 28
"""Size at which a log beside the main one ends: hours of telemetry, and a flood fills no disk."""


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
