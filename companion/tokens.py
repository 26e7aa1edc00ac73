"""Lockstep protocol of two processes that pass a turn, as texts of MAVLink STATUSTEXTs.

See docs/reference/lockstep-protocol.md. At most 50 characters each.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal, cast

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
