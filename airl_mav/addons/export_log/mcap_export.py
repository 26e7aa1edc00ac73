"""MCAP file of a flight, and its messages on a live Foxglove server."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import foxglove
import numpy as np
from foxglove.websocket import ChannelView, Client, ServerListener

from airl_mav.addons.export_log.recorded import RecordedFlight
from airl_mav.addons.export_log.told import FlightMessages
from airl_mav.black_box.mcap_file import McapFile
from airl_mav.black_box.messages import Channel
from airl_mav.core.clock import NS_PER_US, Clock, WallClock
from airl_mav.core.constants import LOOPBACK, US_PER_S
from airl_mav.core.errors import FieldError
from airl_mav.core.files import replacing
from airl_mav.rehearsal.run_folder import info_data

PAUSE_US = 2_000_000
"""Pause between repetitions of a flight [wall µs]."""


SETTLED_S = 0.3
"""Time without a new subscription after which a viewer's subscriptions are complete [wall s]."""


BACKLOG = 1024
"""Minimum queue length per viewer (Foxglove's default); the oldest messages are dropped first."""


class LiveFlight(ServerListener):
    """Server that starts playback with its first viewer; later ones get the newest messages."""

    def __init__(self, flight: RecordedFlight, port: int) -> None:
        """Serve on a loopback TCP port, 0 = any free port; raise FieldError if it is in use."""
        messages = FlightMessages(flight)
        self._began_unix_us = messages.began_unix_us
        self._told = list(messages)
        self._context = foxglove.Context()
        self._channels: dict[Channel, foxglove.Channel] = {}
        self._newest: dict[int, tuple[foxglove.Channel, bytes, int]] = {}
        """Newest message by channel number: channel, data, time [ns]."""
        self._lock = threading.Lock()
        self._watched, self._another = threading.Event(), threading.Event()
        for channel in dict.fromkeys(message.channel for message in self._told):
            self._channels[channel] = self._new(channel)
        try:
            self._server = foxglove.start_server(
                name="airl export-log",
                host=LOOPBACK,
                port=port,
                server_listener=self,
                context=self._context,
                # Room for all messages: a slow viewer must not lose the scene, which is sent once.
                message_backlog_size=max(BACKLOG, len(self._told)),
            )
        except RuntimeError:
            raise FieldError("port", port, problem="it is taken; accepted: a free one") from None
        self.port = int(self._server.port)
        """TCP port of the server."""

    def _new(self, channel: Channel) -> foxglove.Channel:
        schema = foxglove.Schema(
            name=channel.schema_name, encoding=channel.schema_encoding, data=channel.schema
        )
        return foxglove.Channel(
            channel.topic,
            schema=schema,
            message_encoding=channel.encoding,
            context=self._context,
        )

    def on_subscribe(self, client: Client, channel: ChannelView) -> None:  # noqa: ARG002
        """Resend the newest message of the channel; called from the server's thread."""
        with self._lock:
            newest = self._newest.get(channel.id)
            if newest is not None:
                self._log(*newest)
        self._another.set()
        self._watched.set()

    @staticmethod
    def _log(channel: foxglove.Channel, data: bytes, time_ns: int) -> None:
        channel.log(data, log_time=time_ns)

    def wait(self, timeout_s: float | None = None) -> bool:
        """Wait until a viewer has subscribed to its topics; return False on timeout."""
        if not self._watched.wait(timeout_s):
            return False
        while self._another.wait(SETTLED_S):
            self._another.clear()
        return True

    def play(self, clock: Clock | None = None) -> None:
        """Publish the flight once from start to end."""
        clock = clock or WallClock()
        later_us = clock.time_us() - self._told[0].time_us
        for message in self._told:
            clock.sleep_until(message.time_us + later_us)
            time_ns = (self._began_unix_us + message.time_us) * NS_PER_US
            channel = self._channels[message.channel]
            with self._lock:
                self._newest[channel.id()] = channel, message.data, time_ns
                self._log(channel, message.data, time_ns)

    def run(self, ended: Callable[[], None], clock: Clock | None = None) -> None:
        """Publish the flight repeatedly until interrupted; `ended` is called after each."""
        clock = clock or WallClock()
        while not self.wait(0.5):
            pass
        while True:
            self.play(clock)
            ended()
            clock.sleep_until(clock.time_us() + PAUSE_US)
            with self._lock:
                self._newest.clear()
            # Time restarts: viewers must discard their data.
            self._server.clear_session()

    def close(self) -> None:
        """Free the port."""
        self._server.stop()


def write_mcap(flight: RecordedFlight, path: Path) -> None:
    """Write a flight as MCAP, replacing an existing file."""
    messages = FlightMessages(flight)
    with replacing(path) as partial, partial.open("wb") as opened:
        file = McapFile(opened, run_of(flight))
        for message in messages:
            unix_us = messages.began_unix_us + message.time_us
            file.add(message.channel, message.data, unix_us)
        file.finish()


def run_of(flight: RecordedFlight) -> dict[str, Any]:
    """Return the run's description as in a black box, with the settings of this flight."""
    record, info = flight.replayed.record, flight.info
    config = info.config
    pilot, limits = dict(config.get("pilot") or {}), dict(config.get("limits") or {})
    pilot["goal_radius_m"] = record.goal_radius_m
    pilot.setdefault("hold_s", _hold_s(flight))
    limits["flight_s"] = record.time_limit_s
    told = {
        "goal": list(record.goal),
        "seed": record.seed,
        "speed": config.get("speed") or info.setup.speed or 1.0,
        "pilot": pilot,
        "limits": limits,
    }
    return {**info_data(info), "config": {**config, **told}, "seeds": [record.seed]}


def _hold_s(flight: RecordedFlight) -> float:
    """Return the median hold time of actions [s], for older runs without this setting."""
    columns = flight.decisions
    if not len(columns.get("sent_us", ())):
        return 0.0
    return float(np.median(columns["held_until_us"] - columns["sent_us"])) / US_PER_S
