"""What was sent and what was answered, one line each."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Literal, NamedTuple

from airl_mav.core.clock import Clock
from airl_mav.core.constants import US_PER_S

Kind = Literal["sent", "heard", "check", "note"]


class Line(NamedTuple):
    """One line."""

    time_s: float
    """Since the start, by the clock that the waits follow [s]."""
    kind: Kind
    text: str


class Transcript:
    """Lines in their order, from any thread."""

    def __init__(self, clock: Clock, show: Callable[[Line], None]) -> None:
        """Start empty.

        Args:
            clock: What time it is.
            show: Called with each line, from whichever thread says it.
        """
        self._clock, self._show = clock, show
        self._lock = threading.Lock()
        self._lines: list[Line] = []
        self._repeated = 0

    def say(self, kind: Kind, text: str) -> None:
        """Add a line; one that repeats the last is only counted."""
        with self._lock:
            if self._lines and self._lines[-1][1:] == (kind, text):
                self._repeated += 1
                return
            if self._repeated:
                again = f"... and {self._repeated} times more"
                self._repeated = 0
                self._add("note", again)
            self._add(kind, text)

    @property
    def time_s(self) -> float:
        """The present time on the lines' scale [s]."""
        return self._clock.time_us() / US_PER_S

    @property
    def lines(self) -> list[Line]:
        """All lines so far."""
        with self._lock:
            return self._lines[:]

    def _add(self, kind: Kind, text: str) -> None:
        line = Line(self._clock.time_us() / US_PER_S, kind, text)
        self._lines.append(line)
        self._show(line)
