"""Client link: an endpoint with codec, stream scheduler and counters.

Due times of streams are in integer µs of simulated time.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from airl_mav.core.constants import TICK_US, US_PER_S
from airl_mav.core.frames import Vector
from airl_mav.core.signing import Signing
from firmware_sim.autopilot.snapshot import AutopilotState
from firmware_sim.engine.record import Record
from firmware_sim.mavlink import codec
from firmware_sim.mavlink.endpoint import Sender
from firmware_sim.mavlink.px4_links import LinkConfig
from firmware_sim.mavlink.streams import Builder
from firmware_sim.mavlink.telemetry import NUMBERS, Packer
from firmware_sim.mavlink.telemetry import payload as fast_payload

Payloads = dict[Builder, "bytes | None"]
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
        config: LinkConfig,
        builders: Mapping[str, Builder | None],
        replies: Mapping[str, Builder | None] | None = None,
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
        self.scheduler = StreamScheduler(
            names,
            {name: interval_us(hz) for name, hz in config.rates_hz.items()},
            NUMBERS,
            config.slow_every_us,
        )
        self._packer = Packer()
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
            payload = fast_payload(name, state)
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


def interval_us(rate_hz: float) -> int:
    """Return the interval of a rate [µs]; 0 Hz gives 0 (off)."""
    return round(US_PER_S / rate_hz) if rate_hz > 0.0 else 0


OFF = 0
"""Interval of a disabled stream."""

_NEVER = np.iinfo(np.int64).max
_NONE: Mapping[str, int] = MappingProxyType({})


class StreamScheduler:
    """Scheduler of one link's streams: intervals and due times.

    A stream keeps its phase: the next due time is the last due time plus the interval, so rates are
    exact over any span. First due times are staggered by one tick each, which spreads the slow
    streams over several ticks. A stream is due at most once per call; missed times are skipped.

    Compiled code (`telemetry`) packs the fast streams from the arrays; `due` returns the others.
    """

    def __init__(
        self,
        names: Sequence[str],
        default_us: Mapping[str, int],
        fast: Mapping[str, int] = _NONE,
        every_us: int = 0,
    ) -> None:
        """Start at simulated time 0 with the default intervals [µs].

        Args:
            names: All streams, in their order within a tick.
            default_us: Default intervals; a stream without a default is off.
            fast: Indices of the fast streams in the table of compiled code.
            every_us: Time grid of the slow streams from the first tick [µs]; 0 = any tick.
        """
        self._every_us = every_us or 1
        self._names = tuple(names)
        self._index = {name: i for i, name in enumerate(self._names)}
        self._default = [default_us.get(name, OFF) for name in self._names]
        self.numbers = np.array([fast.get(name, -1) for name in self._names], np.int64)
        """(s,) indices of the fast streams in the table; -1 = a slow stream."""
        self.intervals_us = np.array(self._default, np.int64)
        """(s,) intervals [µs]; `OFF` = disabled."""
        self.due_us = np.zeros(len(self._names), np.int64)
        """(s,) due times of the fast streams [µs]."""
        self._slow_due_us: dict[int, int] = {}
        """Due times of the enabled slow streams [µs], by index."""
        self.fast_us = 0
        """Due time of the next fast stream, or an earlier time [µs]."""
        self._next_us = 0
        """Due time of the next slow stream [µs]."""
        self.quiet: set[str] = set()
        """Slow streams without content when last due: no sensor, no radio."""
        self.wake_us = 0
        """The earlier of both due times [µs]; nothing is due before."""
        self._rebase_pending = False
        self._rebase(0)

    def interval_us(self, name: str) -> int:
        """Return a stream's interval [µs]; `OFF` if disabled."""
        return self.intervals_us.item(self._index[name])

    def default_us(self, name: str) -> int:
        """Return a stream's default interval [µs]; `OFF` if disabled by default."""
        return self._default[self._index[name]]

    def set_interval(self, name: str, interval_us: int, now_us: int) -> None:
        """Send a stream every `interval_us` [µs] from `now_us`, or disable it (`OFF`)."""
        if interval_us < 0:
            raise ValueError(f"interval_us={interval_us}: must be >= 0")
        index = self._index[name]
        if interval_us == self.intervals_us[index]:
            # An unchanged interval keeps its phase.
            return
        self.intervals_us[index] = interval_us
        self._plan(index, now_us)
        # The next call recomputes the due times from here.
        self.wake_us = self._next_us = self.fast_us = min(self.wake_us, now_us)

    def restart(self) -> None:
        """Keep the intervals. The next call sets the time base, which may have jumped."""
        self._rebase_pending = True
        self.wake_us = 0

    def packed(self, next_us: int) -> None:
        """Store the due time of the next fast stream [µs], after packing."""
        self.fast_us = next_us
        self.wake_us = min(next_us, self._next_us)

    def next_slow_us(self, now_us: int) -> float:
        """Return the next time of the slow streams, from `now_us` [µs]. Ignores quiet streams."""
        if self._rebase_pending:
            return now_us
        names, quiet = self._names, self.quiet
        # A stream without content must not wake the server on its account.
        due = [due_us for i, due_us in self._slow_due_us.items() if names[i] not in quiet]
        return self.grid_us(max(now_us, min(due, default=_NEVER)))

    def grid_us(self, time_us: int) -> int:
        """Return the first time on the grid at or after `time_us` [µs]."""
        return TICK_US - (TICK_US - time_us) // self._every_us * self._every_us

    def is_time(self, now_us: int) -> bool:
        """Return True if slow streams may be sent at `now_us` [µs]."""
        return (now_us - TICK_US) % self._every_us == 0

    def due(self, now_us: int) -> list[str]:
        """Return the streams due at `now_us` [µs] and schedule their next time."""
        begins = self._rebase_pending  # the first heartbeat is sent immediately
        if begins:
            self._rebase(now_us)
        if now_us < self._next_us or not (begins or self.is_time(now_us)):
            return []
        plan, names = self._slow_due_us, []
        # In order of the due times; equal times keep the order of the table.
        for due_us, i in sorted([(due_us, i) for i, due_us in plan.items() if due_us <= now_us]):
            interval_us = self.intervals_us.item(i)
            # Advance by whole intervals beyond now: missed times are skipped, the phase stays.
            plan[i] = due_us + interval_us * (1 + (now_us - due_us) // interval_us)
            names.append(self._names[i])
        self._next_us = min(plan.values(), default=_NEVER)
        self.wake_us = min(self.fast_us, self._next_us)
        return names

    def _plan(self, index: int, due_us: int) -> None:
        """Schedule the next time of an enabled stream, or remove a disabled stream."""
        sent = self.intervals_us.item(index) != OFF
        if self.numbers.item(index) >= 0:
            # Compiled code reads `due_us`; the dictionary holds only slow streams.
            self.due_us[index] = due_us if sent else _NEVER
        elif sent:
            self._slow_due_us[index] = due_us
        else:
            self._slow_due_us.pop(index, None)

    def _rebase(self, now_us: int) -> None:
        self._rebase_pending = False
        # Align to the grid that starts at the first tick.
        if self._every_us > 1:
            now_us = TICK_US + (now_us - TICK_US - 1) // self._every_us * self._every_us
        for i, interval_us in enumerate(self.intervals_us.tolist()):
            # The stagger of one tick per stream spreads the first messages.
            self._plan(i, now_us if interval_us == OFF else now_us + i * TICK_US % interval_us)
        self.wake_us = self._next_us = self.fast_us = now_us
