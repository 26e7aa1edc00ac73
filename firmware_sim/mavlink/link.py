"""Client link: an endpoint with codec, stream scheduler and counters."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

from airl_mav.core.frames import Vector
from airl_mav.core.signing import Signing
from firmware_sim.autopilot.snapshot import AutopilotState
from firmware_sim.engine.record import Record
from firmware_sim.mavlink import codec, message_rates, px4_links, streams, telemetry
from firmware_sim.mavlink.endpoint import Sender

Payloads = dict[streams.Builder, "bytes | None"]
"""Payloads built and packed in one tick, common to all links; None = nothing to send, empty =
values out of range."""


@dataclass(frozen=True, slots=True)
class LinkCounters:
    """Traffic of one link since the start."""

    rx: int
    """Number of valid frames of known messages received."""
    tx: int
    """Number of frames sent."""
    malformed: int
    """Number of received byte runs that are not a valid frame."""
    ignored: int
    """Number of valid frames received without effect: unknown message, other target, no handler."""
    send_errors: int
    """Number of messages that could not be packed or sent."""
    dropped: int = 0
    """Number of datagrams dropped: sender above its rate limit, or too many clients."""
    refused: int = 0
    """Number of frames received without a valid signature; 0 without a key."""

    def __add__(self, other: LinkCounters) -> LinkCounters:
        """Return the sum of two counters."""
        return LinkCounters(
            self.rx + other.rx,
            self.tx + other.tx,
            self.malformed + other.malformed,
            self.ignored + other.ignored,
            self.send_errors + other.send_errors,
            self.dropped + other.dropped,
            self.refused + other.refused,
        )


class Link:
    """Receiver and sender of the messages of one client.

    Telemetry (`stream`, `stream_due`, then `flush` at the end of the tick) and replies to requests
    (`send`, `send_payload`, `send_stream`) share one sequence, in the order of sending, unless
    `LinkConfig.separate_replies` is set.
    """

    def __init__(
        self,
        config: px4_links.LinkConfig,
        builders: Mapping[str, streams.Builder | None],
        replies: Mapping[str, streams.Builder | None] | None = None,
        *,
        endpoint: Sender | None = None,
        system_id: int = codec.SYSTEM_ID,
        signing: Signing | None = None,
        link_id: int = 0,
    ) -> None:
        """Open a link that streams `builders` and replies with `replies`; None = the same builders.

        `endpoint` sends to one client; None = the config's. `signing` signs sent frames, with
        `link_id`, and checks received frames; None = neither.
        """
        self.name = config.name
        self.builders = builders
        # Configured streams come first: their order is the order within a tick.
        names = [*config.rates_hz, *(name for name in builders if name not in config.rates_hz)]
        self.scheduler = message_rates.StreamScheduler(
            names,
            {name: message_rates.interval_us(hz) for name, hz in config.rates_hz.items()},
            telemetry.NUMBERS,
            config.slow_every_us,
        )
        self._packer = telemetry.Packer()
        self.tap: Callable[[Sequence[bytes]], None] | None = None
        """Callback for the frames of both directions; None = disabled."""
        self.ignored = 0
        self.endpoint: Sender = config.endpoint if endpoint is None else endpoint
        self._streams = {
            name: (codec.layout(name), build) for name, build in builders.items() if build
        }
        self._replies = builders if replies is None else replies
        self._stream_encoder = codec.Encoder(system_id)
        self._reply_encoder = (
            # Separate encoders keep the telemetry's sequence numbers independent of requests.
            codec.Encoder(system_id) if config.separate_replies else self._stream_encoder
        )
        self._decoder = codec.Decoder(datagrams=config.endpoint.datagrams)
        self._signing = signing
        self._link_id = link_id
        self.pending: list[bytes] = []
        """Telemetry frames of this tick, not yet sent."""
        self._rx = 0
        self.sent = 0
        """Number of frames sent."""
        self._refused = 0
        self._unsendable = 0

    @property
    def counters(self) -> LinkCounters:
        """Traffic so far."""
        return LinkCounters(
            rx=self._rx,
            tx=self.sent,
            malformed=self._decoder.malformed,
            ignored=self.ignored + self._decoder.unknown,
            send_errors=self._unsendable + self.endpoint.send_errors,
            refused=self._refused,
        )

    def identify(self, system_id: int) -> None:
        """Change the system id of the sender."""
        self._stream_encoder.identify(system_id)
        self._reply_encoder.identify(system_id)

    def decode(self, chunk: bytes) -> list[codec.WireMessage]:
        """Return the messages in a chunk of bytes from this client."""
        messages = self._decoder.feed(chunk)
        # Frames are checked after decoding: signatures do not change the payload.
        if self._signing is not None and self._signing.key is not None:
            count = len(messages)
            messages = [m for m in messages if self._signing.accepts(bytes(m.get_msgbuf()))]
            self._refused += count - len(messages)
        self.note(messages)
        return messages

    def note(self, messages: Sequence[codec.WireMessage]) -> None:
        """Count and log messages from this client."""
        self._rx += len(messages)
        if self.tap is not None and messages:
            self.tap([bytes(message.get_msgbuf()) for message in messages])

    # --- answers

    def send(self, message: codec.WireMessage) -> None:
        """Send a message. Drops and counts a message with values out of range."""
        frame = self._packed(self._reply_encoder, message)
        if frame is not None:
            self._reply(frame)

    def send_payload(self, name: str, payload: bytes) -> None:
        """Send a message given by name and full payload."""
        self._reply(self._reply_encoder.frame(codec.layout(name), codec.trimmed(payload)))

    def send_stream(self, name: str, state: AutopilotState) -> bool:
        """Send a streamed message now; return True if it had content."""
        builder = self._replies[name]
        # None marks a stream of the compiled packer.
        if builder is None:
            payload = telemetry.payload(name, state)
        else:
            payload = _payload(codec.layout(name), builder(state))
        if payload is None:
            return False
        # Empty bytes mean that a value does not fit its field.
        if payload:
            self._reply(self._reply_encoder.frame(codec.layout(name), payload))
        else:
            self._unsendable += 1
        return True

    def pass_on(self, frame: bytes) -> None:
        """Send a forwarded frame unchanged."""
        self.endpoint.send(frame)
        self.sent += 1
        if self.tap is not None:
            self.tap((frame,))

    def _reply(self, frame: bytes) -> None:
        if self._reply_encoder is self._stream_encoder:
            self.flush()  # keeps frames in the order of their sequence numbers
        frame = self._signed(frame)
        self.endpoint.send(frame)
        self.sent += 1
        if self.tap is not None:
            self.tap((frame,))

    # --- telemetry

    def stream(self, message: codec.WireMessage) -> None:
        """Add a message to this tick's telemetry. Handles values out of range like `send`."""
        frame = self._packed(self._stream_encoder, message)
        if frame is not None:
            self.pending.append(frame)

    def stream_due(self, names: Iterable[str], state: AutopilotState, payloads: Payloads) -> None:
        """Add streams to this tick's telemetry. Handles values out of range like `send`.

        `payloads` holds the payloads already built from this tick's snapshot; new ones are added.
        """
        frames, encoder, quiet = self.pending, self._stream_encoder, self.scheduler.quiet
        for name in names:
            shape, builder = self._streams[name]
            # Another link may have built the same message in this tick.
            if builder in payloads:
                payload = payloads[builder]
            else:
                values = builder(state)
                payload = payloads[builder] = None if values is None else _payload(shape, values)
            if payload is None:
                # A stream without content does not wake the link.
                quiet.add(name)
                continue
            quiet.discard(name)
            if payload:
                frames.append(encoder.frame(shape, payload))
            else:
                self._unsendable += 1

    def stream_fast(self, flown: Record, after_us: int, context: Vector, most: int) -> None:
        """Add the fast streams of n ticks to the telemetry.

        Args:
            flown: (n,) logs of the ticks.
            after_us: Time from the log of a tick to its end [µs].
            context: Values of `telemetry.TickContext.of`.
            most: Maximum number of frames per tick.
        """
        # One call packs the frames of all n ticks in compiled code.
        plan, encoder = self.scheduler, self._stream_encoder
        frames, next_us = self._packer.pack(
            *(flown, after_us, context, plan.numbers, plan.due_us, plan.intervals_us),
            *(encoder.system_id, encoder.sequence, most),
        )
        plan.packed(next_us)
        if frames:
            # The compiled packer has used these sequence numbers.
            encoder.skip(len(frames))
            self.pending += frames

    def flush(self) -> None:
        """Send the telemetry added in this tick."""
        frames = self.pending
        if not frames:
            return
        self.pending = []
        # Signed at the end of the tick, because the time stamp must rise in order of sending.
        if self._signing is not None and self._signing.key is not None:
            frames = [self._signed(frame) for frame in frames]
        self.endpoint.send_streams(frames)
        self.sent += len(frames)
        if self.tap is not None:
            self.tap(frames)

    def _signed(self, frame: bytes) -> bytes:
        return frame if self._signing is None else self._signing.sign(frame, self._link_id)

    def _packed(self, encoder: codec.Encoder, message: codec.WireMessage) -> bytes | None:
        try:
            return encoder.pack(message)
        except (struct.error, OverflowError):
            self._unsendable += 1
            return None


def _payload(shape: codec.WireLayout, values: codec.Values | None) -> bytes | None:
    """Return the payload; empty if a value is out of range, None without values."""
    if values is None:
        return None
    try:
        return shape.payload(values)
    except (struct.error, OverflowError):
        return b""
