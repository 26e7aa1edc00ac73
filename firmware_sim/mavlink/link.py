"""One MAVLink link: an endpoint, its codec, its streams and its counters."""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from firmware_sim.autopilot.state import AutopilotState
from firmware_sim.mavlink.codec import Decoder, Encoder, WireMessage
from firmware_sim.mavlink.endpoint import Endpoint
from firmware_sim.mavlink.rates import GCS_HZ, ONBOARD_HZ, interval_us
from firmware_sim.mavlink.scheduler import StreamScheduler
from firmware_sim.mavlink.streams import Builder


@dataclass(frozen=True, slots=True)
class LinkConfig:
    """What a link is made of."""

    name: str
    endpoint: Endpoint
    rates_hz: Mapping[str, float]
    """Default rate per stream [Hz]; streams not named are off."""


def onboard_link(endpoint: Endpoint) -> LinkConfig:
    """Return the link for the companion (PX4: 14580 -> 14540)."""
    return LinkConfig("onboard", endpoint, ONBOARD_HZ)


def gcs_link(endpoint: Endpoint) -> LinkConfig:
    """Return the link for a ground station (PX4: 18570 -> 14550)."""
    return LinkConfig("gcs", endpoint, GCS_HZ)


@dataclass(frozen=True, slots=True)
class LinkCounters:
    """Traffic of one link since the start."""

    rx: int
    """Valid frames of known messages received."""
    tx: int
    """Frames sent."""
    malformed: int
    """Runs of received bytes that are no valid frame."""
    ignored: int
    """Received frames that were valid and changed nothing: unknown message, other addressee,
    nobody handles it."""
    send_errors: int
    """Messages that could not be packed or sent."""


class Link:
    """Receives and sends the messages of one endpoint."""

    def __init__(self, config: LinkConfig, builders: Mapping[str, Builder]) -> None:
        self.name = config.name
        self.builders = builders
        names = [*config.rates_hz, *(name for name in builders if name not in config.rates_hz)]
        self.scheduler = StreamScheduler(
            names, {name: interval_us(hz) for name, hz in config.rates_hz.items()}
        )
        self.tap: Callable[[bytes], None] | None = None
        """Is given every frame of both directions."""
        self.ignored = 0
        self._endpoint = config.endpoint
        self._encoder = Encoder()
        self._decoder = Decoder(datagrams=config.endpoint.datagrams)
        self._rx = 0
        self._tx = 0
        self._unsendable = 0

    @property
    def counters(self) -> LinkCounters:
        """Traffic so far."""
        return LinkCounters(
            rx=self._rx,
            tx=self._tx,
            malformed=self._decoder.malformed,
            ignored=self.ignored + self._decoder.unknown,
            send_errors=self._unsendable + self._endpoint.send_errors,
        )

    def receive(self) -> list[WireMessage]:
        """Return the messages that have arrived, oldest first."""
        messages: list[WireMessage] = []
        for chunk in self._endpoint.receive():
            messages += self._decoder.feed(chunk)
        self._rx += len(messages)
        if self.tap is not None:
            for message in messages:
                self.tap(bytes(message.get_msgbuf()))
        return messages

    def send(self, message: WireMessage) -> None:
        """Send a message; one whose values do not fit their fields is dropped and counted."""
        try:
            frame = self._encoder.pack(message)
        except (struct.error, OverflowError):
            self._unsendable += 1
            return
        self._endpoint.send(frame)
        self._tx += 1
        if self.tap is not None:
            self.tap(frame)

    def send_stream(self, name: str, state: AutopilotState) -> bool:
        """Build and send one streamed message; tell whether there was something to say."""
        message = self.builders[name](state)
        if message is None:
            return False
        self.send(message)
        return True

    def fileno(self) -> int | None:
        """Return the endpoint's descriptor, None when there is none."""
        return self._endpoint.fileno()

    def close(self) -> None:
        """Close the endpoint."""
        self._endpoint.close()
