"""The companion's socket in lockstep: signed where there is a key, and one companion's alone.

Signatures are of the wire: they carry calendar time, and nothing of them goes further. The flight,
and its fingerprint, is the same with a key and without.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

from airl_mav.core.clock import Clock, WallClock
from airl_mav.core.constants import US_PER_S
from airl_mav.core.signing import StoredSigning
from airl_mav.lockstep.frames import datagrams, split
from firmware_sim.mavlink.codec import Decoder, WireMessage, is_signed
from firmware_sim.mavlink.endpoint import Peer, Sender, UdpEndpoint

LONGEST_DATAGRAM = 1400
"""Frames of telemetry share a datagram up to this size [bytes]; MAVSDK reads 2048 at a time."""

LINK_ID = 0
"""In the signatures of the vehicle's onboard link, as at level sitl."""

TELL_EVERY_US = 10 * US_PER_S
"""Shortest time between two lines about frames that are turned away [µs of wall time]."""


@dataclass(frozen=True, slots=True)
class Heard:
    """A message, and who sent it."""

    peer: Peer
    message: WireMessage


class Wire:
    """Sends to the companion and hears it. One flight; the socket is its owner's to close."""

    def __init__(
        self,
        endpoint: UdpEndpoint,
        stored: StoredSigning | None = None,
        say: Callable[[str], None] = lambda _line: None,
        clock: Clock | None = None,
    ) -> None:
        """Forget what is left of another flight.

        Args:
            endpoint: Where the companion is, or will be.
            stored: The key that it has, too; None: nothing is signed or asked for.
            say: Is told what is turned away, a line at a time.
            clock: Wall time, for how often that is told.
        """
        socket = endpoint.fileno()
        if socket is None:
            raise ValueError("the endpoint is closed")
        self.socket = socket
        """To wait on."""
        self.refused = 0
        """Frames that were unsigned, forged or old."""
        self.foreign = 0
        """Datagrams of others than the companion."""
        self._endpoint = endpoint
        self._stored = stored
        self._say = say
        self._clock = clock or WallClock()
        self._told = 0
        self._tell_us: int | None = None
        self._decoder = Decoder(datagrams=True)
        self._preset = endpoint.towards(None)
        self._learned: tuple[Peer, Sender] | None = None
        self._known = stored is None
        """Whether anything has come that only a companion can have sent."""
        self._kept: tuple[Peer] | None = None
        endpoint.receive()

    def send(self, frames: bytes) -> None:
        """Send frames, none of them signed, to the preset remote and to who has spoken."""
        ends = [self._preset, None if self._learned is None else self._learned[1]]
        for datagram in datagrams(self._signed(frames), LONGEST_DATAGRAM):
            for end in ends:
                if end is not None:
                    end.send(datagram)

    def receive(self) -> list[Heard]:
        """Return what has arrived and may be taken, oldest first."""
        heard: list[Heard] = []
        for peer, data in self._endpoint.arrivals():
            if self._kept is not None and peer != self._kept[0]:
                self.foreign += 1
                continue
            messages = self._decoder.feed(data)
            accepted = self._accepted(messages)
            # What passes unsigned makes nobody the companion, nor is it sent anything.
            self._known = self._known or any(map(is_signed, accepted))
            if not accepted or not self._known:
                continue
            if peer is not None and (self._learned is None or peer != self._learned[0]):
                end = self._endpoint.towards(peer)
                self._learned = None if end is None else (peer, end)
            heard += (Heard(peer, message) for message in accepted)
        self._tell()
        if self._stored is not None:
            self._stored.save_due()
        return heard

    def keep_to(self, peer: Peer) -> None:
        """Hear this one alone from now on: it is the companion."""
        self._kept = self._kept or (peer,)

    def close(self) -> None:
        """Keep the newest time stamp, and tell the rest."""
        self._tell_us = None
        self._tell()
        if self._stored is not None:
            self._stored.save()

    def _signed(self, frames: bytes) -> Iterable[bytes]:
        if self._stored is None:
            return split(frames)
        return self._with_signatures(frames, self._stored)

    def _with_signatures(self, frames: bytes, stored: StoredSigning) -> Iterator[bytes]:
        for frame in split(frames):
            yield stored.signing.sign(frame, LINK_ID)

    def _accepted(self, messages: list[WireMessage]) -> list[WireMessage]:
        if self._stored is None:
            return messages
        signing = self._stored.signing
        accepted = [m for m in messages if signing.accepts(bytes(m.get_msgbuf()))]
        self.refused += len(messages) - len(accepted)
        return accepted

    def _tell(self) -> None:
        """Say what was turned away, now and then: a wrong key would look like silence."""
        count = self.refused + self.foreign
        if count == self._told:
            return
        now_us = self._clock.time_us()
        if self._tell_us is not None and now_us < self._tell_us:
            return
        self._told, self._tell_us = count, now_us + TELL_EVERY_US
        if self.refused:
            self._say(f"onboard: {self.refused} frames refused so far: bad signature")
        if self.foreign:
            self._say(f"onboard: {self.foreign} datagrams dropped so far: not the companion's")
