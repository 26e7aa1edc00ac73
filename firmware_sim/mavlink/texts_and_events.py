"""Texts (STATUSTEXT) and events (EVENT) for operators.

Events are sent in order to all clients, and again on request.
Source: https://mavlink.io/en/services/events.html, and PX4 1.16, mavlink/mavlink_events.cpp.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from typing import NamedTuple

from airl_mav.core.constants import US_PER_S
from firmware_sim.autopilot.autopilot_state import OperatorText
from firmware_sim.autopilot.events.definition import MavlinkEvent
from firmware_sim.mavlink.codec import WireMessage, dialect
from firmware_sim.mavlink.streams.units import boot_ms

FIRST_SEQUENCE = 65_526
"""Sequence number of the first event after boot. PX4 starts high to wrap around early."""

KEPT = 20
"""Number of events kept for repeated requests (PX4's buffer)."""

ANNOUNCED_US = 3 * US_PER_S
"""Interval of CURRENT_EVENT_SEQUENCE per client [µs]."""

NUMBERS = 65_536
"""Number of distinct sequence numbers."""
_ARGUMENT_BYTES = 40


class SentEvent(NamedTuple):
    """Event with its sequence number."""

    sequence: int
    time_us: int
    event: MavlinkEvent


class EventBuffer:
    """Most recent events of a vehicle since boot."""

    def __init__(self) -> None:
        self._stored: deque[SentEvent] = deque(maxlen=KEPT)
        self.latest = FIRST_SEQUENCE - 1
        """Sequence number of the newest event; `FIRST_SEQUENCE - 1` before the first event."""

    def __len__(self) -> int:
        """Return the number of stored events."""
        return len(self._stored)

    def add(self, event: MavlinkEvent, time_us: int) -> None:
        """Add an event that occurred at simulated `time_us` [µs]."""
        self.latest = (self.latest + 1) % NUMBERS
        self._stored.append(SentEvent(self.latest, time_us, event))

    def get(self, sequence: int) -> SentEvent | None:
        """Return the event with a sequence number; None = expired or not yet occurred."""
        for sent in self._stored:
            if sent.sequence == sequence:
                return sent
        return None

    def after(self, sequence: int) -> int:
        """Return the sequence number of the first stored event after another event."""
        following = [s.sequence for s in self._stored if s.sequence != sequence]
        return min(following, key=lambda s: (s - sequence) % NUMBERS, default=self.latest)


class EventSender:
    """Event transmission state of one client."""

    def __init__(self, buffer: EventBuffer) -> None:
        """Start with the next event. Earlier events are sent on request only."""
        self._buffer = buffer
        self._sent = buffer.latest
        self._announced_us = 0
        self._first = len(buffer) == 0

    @property
    def next_us(self) -> int:
        """Time of the next message [µs]; 0 = now."""
        news = self._sent != self._buffer.latest
        return 0 if news else self._announced_us + ANNOUNCED_US + 1

    def due(self, now_us: int) -> Iterator[WireMessage]:
        """Yield the messages due at simulated `now_us` [µs]."""
        latest = self._buffer.latest
        if self._first and latest != self._sent:
            # Numbering restarts with this boot: clients must drop the numbers of earlier boots.
            self._first = False
            yield self._current(now_us, reset=True)
        # Each client catches up from its own number.
        while self._sent != latest:
            self._sent = (self._sent + 1) % NUMBERS
            # None: the buffer has dropped this event already.
            sent = self._buffer.get(self._sent)
            if sent is not None:
                yield message(sent)
        if now_us - self._announced_us > ANNOUNCED_US:
            yield self._current(now_us)

    def _current(self, now_us: int, *, reset: bool = False) -> WireMessage:
        self._announced_us = now_us
        reset = reset or len(self._buffer) == 0
        flags = dialect.MAV_EVENT_CURRENT_SEQUENCE_FLAGS_RESET if reset else 0
        return dialect.MAVLink_current_event_sequence_message(self._buffer.latest, flags)


def message(sent: SentEvent) -> WireMessage:
    """Return EVENT, addressed to all systems."""
    event = sent.event
    arguments = event.arguments.ljust(_ARGUMENT_BYTES, b"\0")
    # Destination 0/0 is MAVLink's broadcast.
    everybody = 0
    return dialect.MAVLink_event_message(
        *(everybody, everybody, event.number, boot_ms(sent.time_us), sent.sequence),
        *(event.levels, list(arguments)),
    )


CHUNK_BYTES = 50

_LAST_ID = 65_535

SAID_BY_EVENT = b"\t"
"""Suffix of a text that is also sent as an event, as in PX4. Ground stations with event support
skip such texts."""

REPLY_IDS = 32_768
"""First id of replies if they are numbered separately from the autopilot's texts. The ids of two
consecutive long texts must differ."""


class TextEncoder:
    """Encoder of texts as STATUSTEXT messages, with the ids that link the chunks."""

    def __init__(self, last_id: int = 0) -> None:
        """Number long texts from the id after `last_id`."""
        self._id = last_id

    def encode(self, message: OperatorText) -> list[WireMessage]:
        """Return the messages of one text, in order.

        A text of up to 50 characters is one message with id 0. A longer text is split into chunks
        with a common id. A chunk with a NUL is the last, so an empty chunk follows a full last
        chunk.
        """
        # STATUSTEXT is ASCII in PX4; other characters become question marks.
        text = message.text.encode("ascii", errors="replace")
        if message.event is not None:
            text += SAID_BY_EVENT
        if len(text) <= CHUNK_BYTES:
            return [dialect.MAVLink_statustext_message(message.severity, text)]
        # Id 0 means a single chunk, so ids run from 1 to 65535.
        self._id = self._id % _LAST_ID + 1
        starts = range(0, len(text) + 1, CHUNK_BYTES)
        return [
            dialect.MAVLink_statustext_message(
                message.severity, text[start : start + CHUNK_BYTES], self._id, chunk
            )
            for chunk, start in enumerate(starts)
        ]
