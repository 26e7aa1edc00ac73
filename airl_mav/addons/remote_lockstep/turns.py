"""Lockstep protocol of two processes that pass a turn, as texts of MAVLink STATUSTEXTs.

See docs/reference/lockstep-protocol.md. At most 50 characters each.
"""

from __future__ import annotations

import re
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from queue import Empty, SimpleQueue
from typing import Literal, Protocol, cast

from airl_mav.core.clock import Clock, SimClock
from airl_mav.core.constants import US_PER_S
from companion.frame_source import FrameSource, ReceivedFrame
from companion.watchdog import Abandoned, Poll

Order = Literal["", "land", "abandon", "end"]
"""Order to the companion: no order; stop and land; abandon the flight without landing; the
scheduler has ended."""

Event = Literal["", "frame", "stop"]
"""Event that wakes the companion early: no event; the camera's next frame; an order."""

NO_FRAME = -1

_GIVEN = re.compile(r"F(\d+) (\d+) (-1|\d+)(?: (land|abandon|end))?")
_BACK = re.compile(r"D(\d+)(?: (end|\d+)(?: (\d+)(?: (frame|stop))?)?)?")
_PHASE = re.compile(r"P(\d+) ([ -~]+)")
"""Pattern of a phase, without control characters, as a phase is shown on a terminal."""


@dataclass(frozen=True)
class TurnGiven:
    """`F<number> <time_us> <frame> [order]`: the companion's turn begins."""

    number: int
    """Number of the turn, increases by one."""
    time_us: int
    """Simulated time [µs], constant until the turn is returned."""
    frame: int = NO_FRAME
    """Sequence of the newest frame available to the companion."""
    order: Order = ""

    def text(self) -> str:
        """Return the text."""
        return f"F{self.number} {self.time_us} {self.frame} {self.order}".rstrip()

    @classmethod
    def parse(cls, text: str) -> TurnGiven | None:
        """Parse a text; return None for any other text."""
        # The whole text must match: other texts of the vehicle may contain similar words.
        match = _GIVEN.fullmatch(text)
        if match is None:
            return None
        number, time_us, frame, order = match.groups(default="")
        return cls(int(number), int(time_us), int(frame), cast(Order, order))


@dataclass(frozen=True)
class TurnBack:
    """`D<number> [<wake_us> [<setpoints_sent> [event]]]`, or `D<number> end`: the turn is over."""

    number: int
    wake_us: int | None = None
    """Requested time of the next turn [µs]; None = not specified."""
    setpoints_sent: int | None = None
    """Number of setpoints sent so far, without repetitions; None = not specified."""
    event: Event = ""
    ended: bool = False

    def text(self) -> str:
        """Return the text."""
        if self.ended:
            return f"D{self.number} end"
        fields = (self.wake_us, self.setpoints_sent, self.event or None)
        return " ".join([f"D{self.number}", *(str(field) for field in fields if field is not None)])

    @classmethod
    def parse(cls, text: str) -> TurnBack | None:
        """Parse a text; return None for any other text."""
        match = _BACK.fullmatch(text)
        if match is None:
            return None
        number, wake_us, sent, event = match.groups()
        return cls(
            int(number),
            int(wake_us) if wake_us not in (None, "end") else None,
            int(sent) if sent is not None else None,
            cast(Event, event or ""),
            wake_us == "end",
        )


@dataclass(frozen=True)
class PhaseToken:
    """`P<number> <name>`: the companion has entered a phase of its mission during a turn."""

    number: int
    name: str

    def text(self) -> str:
        """Return the text."""
        return f"P{self.number} {self.name}"

    @classmethod
    def parse(cls, text: str) -> PhaseToken | None:
        """Parse a text; return None for any other text."""
        match = _PHASE.fullmatch(text)
        return None if match is None else cls(int(match[1]), match[2])


FAREWELL_S = 3
"""Wait of the companion at its end, in case its last text is lost [s of waiting]."""


class TextLink(Protocol):
    """Link for texts, such as `mavsdk_link.MavsdkLink`."""

    setpoints_sent: int

    def exchange_texts(self, heard: Callable[[str], None]) -> Callable[[str], None]:
        """Receive the texts of the flight controller; return the send function."""


class TokenTurns:
    """Turns of one flight. All methods except `_hear` run on the companion's thread."""

    def __init__(self, stop: threading.Event, abandon: threading.Event, patience_s: float) -> None:
        """Set the timeout `patience_s` of a turn or its frame [wall s, while running]."""
        self.patience_s = patience_s
        self.frame = NO_FRAME
        """Sequence of the newest frame available to the companion."""
        self.frame_arrived = threading.Event()
        """Event set by a newer frame; clear it before waiting."""
        self._stop, self._abandon = stop, abandon
        self.clock = SimClock()
        """Simulated time, advanced by the turns."""
        self._inbox: SimpleQueue[TurnGiven] = SimpleQueue()
        self._link: TextLink | None = None
        self._send: Callable[[str], None] = lambda _: None
        self._number = 0
        self._sent: list[str] = []
        """All texts of this turn, for retransmission after a loss."""

    @contextmanager
    def taken(self, link: TextLink) -> Iterator[None]:
        """Take turns on a connected link while the context is active; Abandoned on a timeout."""
        self._link = link
        self._send = link.exchange_texts(self._hear)
        self._await_turn()
        try:
            yield
        # The turn is lost already; only other endings return it.
        except Abandoned:
            raise
        except BaseException:
            self._end()
            raise
        self._end()

    def sleep(
        self, wake_us: int, interrupt: threading.Event | None = None, poll: Poll | None = None
    ) -> None:
        """Return the turn until simulated `wake_us` [µs] (`conducted.Sleep`); raises Abandoned."""
        del poll
        sent = 0 if self._link is None else self._link.setpoints_sent
        self._give_back(TurnBack(self._number, wake_us, sent, self._name_of(interrupt)))
        self._await_turn()

    def tell(self, phase: str) -> None:
        """Report that the mission enters a phase."""
        self._send_text(PhaseToken(self._number, phase).text())

    def _end(self) -> None:
        self._give_back(TurnBack(self._number, ended=True))
        # The last text is repeated on request, since it may be lost.
        for _ in range(FAREWELL_S):
            given = self._next_given(1.0)
            if given is not None and given.order == "end":
                return
            if given is not None:
                self._resend()

    def _name_of(self, interrupt: threading.Event | None) -> Event:
        if interrupt is None:
            return ""
        if interrupt is self.frame_arrived:
            return "frame"
        if interrupt is self._stop:
            return "stop"
        raise ValueError("a sleep in lockstep can be ended by an order or by a frame only")

    # --- texts

    def _hear(self, text: str) -> None:
        """Handle a text of the flight controller, on MAVSDK's thread."""
        given = TurnGiven.parse(text)
        if given is not None:
            self._inbox.put(given)

    def _give_back(self, back: TurnBack) -> None:
        while self._next_given(0.0) is not None:
            pass  # repeated by the scheduler during a long turn
        self._send_text(back.text())

    def _send_text(self, text: str) -> None:
        self._sent.append(text)
        self._send(text)

    def _resend(self) -> None:
        for text in self._sent:
            self._send(text)

    def _next_given(self, timeout_s: float) -> TurnGiven | None:
        try:
            return self._inbox.get(block=timeout_s > 0.0, timeout=timeout_s or None)
        except Empty:
            return None

    def _await_turn(self) -> None:
        waited_s = 0
        while waited_s < self.patience_s:
            # Count short waits instead of clock time, to exclude time while the process is stopped.
            given = self._next_given(1.0)
            if given is None:
                waited_s += 1
            # A higher number is the next turn; the same number means that the reply was lost.
            elif given.number > self._number:
                self._take(given)
                return
            else:
                self._resend()
        raise Abandoned(f"the flight controller gave no turn in {self.patience_s:g} s")

    def _take(self, given: TurnGiven) -> None:
        if given.order == "end":
            raise Abandoned("the flight controller has ended the flight")
        # New turn: earlier texts need no retransmission.
        self._number = given.number
        self._sent.clear()
        self.clock.sleep_until(given.time_us)
        if given.order == "abandon":
            self._abandon.set()
        if given.order:
            self._stop.set()
        # The event wakes a wait for the frame, see TokenFrameSource.
        if given.frame != self.frame:
            self.frame = given.frame
            self.frame_arrived.set()


@dataclass
class TokenFrameSource:
    """Source of the frame named by the turn. Implements `companion.frame_source.FrameSource`."""

    frames: FrameSource
    turns: TokenTurns
    clock: Clock
    newest: ReceivedFrame | None = field(default=None, init=False)

    def latest(self) -> ReceivedFrame | None:
        """Return the turn's frame, None before the first frame; Abandoned on a timeout."""
        wanted = self.turns.frame
        if wanted == NO_FRAME:
            return None
        # The turn names the frame; a newer one may already be decoded but does not count.
        if self.newest is None or self.newest.frame.sequence != wanted:
            self.newest = self._await(wanted)
        return self.newest

    def wait(self, newer_than_sequence: int, timeout_s: float) -> ReceivedFrame | None:
        """Wait for a new frame, see `FrameSource`, with a timeout in simulated time."""
        clock, arrived = self.clock, self.turns.frame_arrived
        deadline_us = clock.time_us() + int(timeout_s * US_PER_S)
        while True:
            newest = self.latest()
            if newest is not None and newest.frame.sequence != newer_than_sequence:
                return newest
            if clock.time_us() >= deadline_us:
                return None
            # Cleared before the sleep, so that a frame during the sleep wakes it.
            arrived.clear()
            clock.sleep_until(deadline_us, arrived)

    def _await(self, wanted: int) -> ReceivedFrame:
        """Wait for a frame that is in transit through the operating system."""
        received, patience_s = self.frames.latest(), self.turns.patience_s
        waited_s = 0
        while received is None or received.frame.sequence != wanted:
            # The frame is sent repeatedly until the turn is returned.
            seen = NO_FRAME if received is None else received.frame.sequence
            newer = self.frames.wait(newer_than_sequence=seen, timeout_s=1.0)
            if newer is None:
                waited_s += 1
                if waited_s >= patience_s:
                    raise Abandoned(
                        f"frame {wanted} of the camera did not come in {patience_s:g} s"
                    )
            else:
                received = newer
        return received
