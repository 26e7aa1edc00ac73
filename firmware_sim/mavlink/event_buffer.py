"""MAVLink events: sent in order to everybody, and again to who has missed one.

Source: https://mavlink.io/en/services/events.html, and PX4 1.16, mavlink/mavlink_events.cpp.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from typing import NamedTuple

from airl_mav.core.constants import US_PER_S
from firmware_sim.autopilot.events.definition import Event
from firmware_sim.mavlink.codec import WireMessage, dialect
from firmware_sim.mavlink.streams.units import boot_ms

FIRST_SEQUENCE = 65_526
"""Of the first event after boot: PX4 begins high, so that the number soon wraps around."""

KEPT = 20
"""Events that can be asked for again (PX4's buffer)."""

ANNOUNCED_US = 3 * US_PER_S
"""Time between two CURRENT_EVENT_SEQUENCE to one client [µs]."""

NUMBERS = 65_536
"""Sequence numbers that there are."""
_ARGUMENT_BYTES = 40


class SentEvent(NamedTuple):
    """An event with its number, as it is sent."""

    sequence: int
    time_us: int
    event: Event


class EventBuffer:
    """The newest events of a vehicle since boot."""

    def __init__(self) -> None:
        self._kept: deque[SentEvent] = deque(maxlen=KEPT)
        self.latest = FIRST_SEQUENCE - 1
        """Number of the newest event; one less than the first as long as there is none."""

    def __len__(self) -> int:
        """Return how many can be asked for."""
        return len(self._kept)

    def add(self, event: Event, time_us: int) -> None:
        """Take an event that happened at simulated `time_us` [µs]."""
        self.latest = (self.latest + 1) % NUMBERS
        self._kept.append(SentEvent(self.latest, time_us, event))

    def get(self, sequence: int) -> SentEvent | None:
        """Return an event by its number; None = it is gone, or has not happened."""
        for sent in self._kept:
            if sent.sequence == sequence:
                return sent
        return None

    def after(self, sequence: int) -> int:
        """Return the number of the first event kept that comes after one."""
        following = [s.sequence for s in self._kept if s.sequence != sequence]
        return min(following, key=lambda s: (s - sequence) % NUMBERS, default=self.latest)


class EventSender:
    """One client's part: what it has been sent."""

    def __init__(self, buffer: EventBuffer) -> None:
        """Begin with the next event: what happened before is to be asked for."""
        self._buffer = buffer
        self._sent = buffer.latest
        self._announced_us = 0
        self._first = len(buffer) == 0

    def has_news(self, now_us: int) -> bool:
        """Return whether anything is to be sent at simulated `now_us` [µs]: mostly there is not."""
        return now_us >= self.next_us

    @property
    def next_us(self) -> int:
        """When anything is sent next [µs]; 0 = now."""
        news = self._sent != self._buffer.latest
        return 0 if news else self._announced_us + ANNOUNCED_US + 1

    def due(self, now_us: int) -> Iterator[WireMessage]:
        """Yield what is to be sent at simulated `now_us` [µs]."""
        latest = self._buffer.latest
        if self._first and latest != self._sent:
            # The numbers begin anew with this boot: whoever has heard others forgets them.
            self._first = False
            yield self._current(now_us, reset=True)
        while self._sent != latest:
            self._sent = (self._sent + 1) % NUMBERS
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
    """Return EVENT, for everybody."""
    event = sent.event
    arguments = event.arguments.ljust(_ARGUMENT_BYTES, b"\0")
    everybody = 0
    return dialect.MAVLink_event_message(
        *(everybody, everybody, event.number, boot_ms(sent.time_us), sent.sequence),
        *(event.levels, list(arguments)),
    )
