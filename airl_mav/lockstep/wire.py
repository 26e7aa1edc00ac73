"""Companion's socket in lockstep: signed if there is a key, and restricted to one companion.

Signatures contain calendar time and are not forwarded: the key does not affect the digest.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

from airl_mav.core.clock import Clock, WallClock
from airl_mav.core.constants import US_PER_S
from airl_mav.core.signing import StoredSigning
from firmware_sim.mavlink.codec import Decoder, WireMessage, is_signed, layout
from firmware_sim.mavlink.endpoint import Peer, Sender, UdpEndpoint
from firmware_sim.mavlink.px4_links import ONBOARD_HZ

_OVERHEAD = 12
"""Header and checksum of an unsigned frame [bytes]."""

_MESSAGE = slice(7, 10)
"""Position of the message id in a frame."""

_SENT_BY = slice(5, 10)
"""Position of system id, component id and message id in a frame."""

_PER_INSTANCE = ("DISTANCE_SENSOR",)
"""Streams of several devices, distinguished by a field."""

STATES = frozenset(
    layout(name).id_bytes
    for name, rate_hz in ONBOARD_HZ.items()
    if rate_hz > 1.0 and name not in _PER_INSTANCE
)
"""Messages that replace older ones: state streams, and TIMESYNC, whose answer is not sent to the
vehicle (`conductor`). Answers, events, texts and slow streams such as HEARTBEAT are excluded."""


UNREAD = frozenset(
    layout(name).id_bytes
    for name in (
        *("HIGHRES_IMU", "ODOMETRY", "ALTITUDE", "ATTITUDE_TARGET", "SERVO_OUTPUT_RAW", "VFR_HUD"),
        *("POSITION_TARGET_LOCAL_NED", "POSITION_TARGET_GLOBAL_INT", "ESC_INFO", "ESC_STATUS"),
    )
)
"""Messages that the companion never reads from MAVSDK."""


def newest(frames: Sequence[bytes]) -> list[bytes]:
    """Return frames without `UNREAD` messages, and only the newest of each of the `STATES`."""
    kept: list[bytes] = []
    replaced: set[bytes] = set()
    # From the newest to the oldest: the first frame of each state is the one to keep.
    for frame in reversed(frames):
        if frame[_MESSAGE] in UNREAD:
            continue
        if frame[_MESSAGE] in STATES:
            # States of several systems are kept separately.
            sent_by = frame[_SENT_BY]
            if sent_by in replaced:
                continue
            replaced.add(sent_by)
        kept.append(frame)
    kept.reverse()
    return kept


def split(frames: bytes) -> Iterator[bytes]:
    """Yield the frames of concatenated unsigned frames."""
    start = 0
    while start + _OVERHEAD <= len(frames):
        end = start + _OVERHEAD + frames[start + 1]
        yield frames[start:end]
        start = end


def newest_heartbeat(frames: Iterable[bytes]) -> bytes | None:
    """Return the last HEARTBEAT of some frames, or None."""
    found = None
    for frame in frames:
        if frame[_MESSAGE] == b"\0\0\0":
            found = frame
    return found


def datagrams(frames: Iterable[bytes], longest: int) -> Iterator[bytes]:
    """Pack frames into as few datagrams of at most `longest` bytes as possible."""
    waiting: list[bytes] = []
    length = 0
    for frame in frames:
        # A frame is never split between datagrams.
        if waiting and length + len(frame) > longest:
            yield b"".join(waiting)
            waiting, length = [], 0
        waiting.append(frame)
        length += len(frame)
    if waiting:
        yield b"".join(waiting)


LONGEST_DATAGRAM = 1400
"""Maximum size of a telemetry datagram [bytes]; MAVSDK reads 2048 at a time."""

LINK_ID = 0
"""Link id in the signatures of the vehicle's onboard link, as at level sitl."""

TELL_EVERY_US = 10 * US_PER_S
"""Minimum interval between two messages about rejected frames [µs of wall time]."""


@dataclass(frozen=True, slots=True)
class Heard:
    """Message and its sender."""

    peer: Peer
    message: WireMessage


class Wire:
    """Connection to the companion during one flight; the caller owns and closes the socket."""

    def __init__(
        self,
        endpoint: UdpEndpoint,
        stored: StoredSigning | None = None,
        say: Callable[[str], None] = lambda _line: None,
        clock: Clock | None = None,
    ) -> None:
        """Discard pending input of an earlier flight.

        Args:
            endpoint: Endpoint of the companion, connected or not.
            stored: Signing key shared with the companion; None = no signing.
            say: Callback for messages about rejected frames.
            clock: Wall clock for the interval of these messages.
        """
        socket = endpoint.fileno()
        if socket is None:
            raise ValueError("the endpoint is closed")
        self.socket = socket
        """File descriptor to wait on."""
        self.refused = 0
        """Number of unsigned, forged or outdated frames."""
        self.foreign = 0
        """Number of datagrams from senders other than the companion."""
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
        """True after a message that only a companion can have sent."""
        self._kept: tuple[Peer] | None = None
        # Discards what an earlier companion has left in the socket.
        endpoint.receive()

    def send(self, frames: bytes) -> None:
        """Send unsigned frames to the preset remote and the last sender; sign if there is a key."""
        ends = [self._preset, None if self._learned is None else self._learned[1]]
        for datagram in datagrams(self._signed(frames), LONGEST_DATAGRAM):
            for end in ends:
                if end is not None:
                    end.send(datagram)

    def receive(self) -> list[Heard]:
        """Return all accepted messages, oldest first."""
        heard: list[Heard] = []
        for peer, data in self._endpoint.arrivals():
            # Once the companion is known, other senders are foreign.
            if self._kept is not None and peer != self._kept[0]:
                self.foreign += 1
                continue
            messages = self._decoder.feed(data)
            accepted = self._accepted(messages)
            # Unsigned messages that are accepted do not identify a companion, so no data is sent to
            # it.
            self._known = self._known or any(map(is_signed, accepted))
            if not accepted or not self._known:
                continue
            # Answers go to the newest accepted sender.
            if peer is not None and (self._learned is None or peer != self._learned[0]):
                end = self._endpoint.towards(peer)
                self._learned = None if end is None else (peer, end)
            heard += (Heard(peer, message) for message in accepted)
        self._tell()
        if self._stored is not None:
            self._stored.save_due()
        return heard

    def keep_to(self, peer: Peer) -> None:
        """Accept only this sender from now on: it is the companion."""
        self._kept = self._kept or (peer,)

    def close(self) -> None:
        """Save the newest time stamp, and report the remaining rejections."""
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
        """Report rejected frames at intervals; otherwise a wrong key would look like silence."""
        count = self.refused + self.foreign
        if count == self._told:
            return
        now_us = self._clock.time_us()
        # The first report is immediate, later reports come at intervals.
        if self._tell_us is not None and now_us < self._tell_us:
            return
        self._told, self._tell_us = count, now_us + TELL_EVERY_US
        if self.refused:
            self._say(f"onboard: {self.refused} frames refused so far: bad signature")
        if self.foreign:
            self._say(f"onboard: {self.foreign} datagrams dropped so far: not the companion's")
