"""Progress for programs: one JSON object a line."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import IO, Any, ClassVar

from airl_mav.core.clock import Clock, WallClock
from airl_mav.core.constants import US_PER_S
from airl_mav.core.progress import Bar, Event, Progress

EVERY_S = 1.0
"""Of each work, programs hear no more often how far it is [wall s]."""


@dataclass(frozen=True)
class Status(Event):
    """What is being done or waited for."""

    event: ClassVar[str] = "status"
    text: str


@dataclass(frozen=True)
class Note(Event):
    """A remark for a person: a warning, or what a flight controller said."""

    event: ClassVar[str] = "note"
    text: str


@dataclass(frozen=True)
class Advanced(Event):
    """How far a work is: at most once a second, and when it is done."""

    event: ClassVar[str] = "progress"
    work: str
    """What is being done, as its bar is called."""
    done: float
    planned: float
    unit: str | None
    """What is counted, in the plural."""
    elapsed_s: float
    """Since this command began with it [wall s]."""
    per_s: float | None
    """Pace of this command since the first one [1/s]; None before there is one."""
    left_s: float | None
    """Time left at that pace [wall s]."""


class JsonProgress(Progress):
    """Writes a line of JSON for everything that happens."""

    def __init__(self, out: IO[str], clock: Clock | None = None) -> None:
        """Write to a stream; the clock, by default the wall's, is that of paces."""
        self._out = out
        self._clock = clock or WallClock()
        self._status: str | None = None

    def bar(
        self, label: str, total: float, *, completed: float = 0.0, unit: str | None = None
    ) -> Bar:
        """Begin a work; see `Progress`."""
        return _JsonBar(self, self._clock, label, total, completed, unit)

    def status(self, text: str | None) -> None:
        """Tell what is being done, once."""
        if text is not None and text != self._status:
            self.tell(Status(text))
            self._status = text

    def note(self, text: str, style: str | None = None) -> None:  # noqa: ARG002 (for those who draw)
        """Tell a remark."""
        self.tell(Note(text.strip()))

    def tell(self, event: Event, **more: Any) -> None:
        """Write an event, with more figures of it; no line waits for the next one."""
        line = {"event": event.event, **asdict(event), **more}
        self._out.write(json.dumps(line, ensure_ascii=False, allow_nan=False) + "\n")
        self._out.flush()


class _JsonBar(Bar):
    """A work as programs hear of it."""

    def __init__(
        self,
        progress: JsonProgress,
        clock: Clock,
        label: str,
        total: float,
        completed: float,
        unit: str | None,
    ) -> None:
        self._progress, self._clock = progress, clock
        self._label, self._total, self._unit = label, total, unit
        self._before = self._completed = completed
        self._began_us = clock.time_us()
        self._first: tuple[int, float] | None = None
        """When the first ones were completed, and how many there were then."""
        self._told_us: int | None = None
        self._told = completed
        self._figures: dict[str, Any] = {}

    def advance(self, amount: float = 1.0) -> None:
        """Add to what is completed."""
        self.update(completed=self._completed + amount)

    def update(
        self,
        *,
        completed: float | None = None,
        total: float | None = None,
        postfix: str | None = None,  # noqa: ARG002 (the figures say it)
        figures: Mapping[str, Any] | None = None,
    ) -> None:
        """Set what is completed of how much, or the figures that are told with it."""
        self._figures.update(figures or {})
        self._total = self._total if total is None else total
        if completed is None:
            return
        now_us = self._clock.time_us()
        if self._first is None and completed > self._completed:
            self._first = now_us, completed
        self._completed = completed
        due = self._told_us is None or now_us - self._told_us >= EVERY_S * US_PER_S
        if due or completed >= self._total:
            self._tell(now_us)

    def close(self) -> None:
        """Tell how far it came, if that was not told."""
        if self._told != self._completed:
            self._tell(self._clock.time_us())

    def _tell(self, now_us: int) -> None:
        elapsed_s = (now_us - self._began_us) / US_PER_S
        pace = self._pace(now_us)
        left_s = None if pace is None else max(self._total - self._completed, 0.0) / pace
        self._told_us, self._told = now_us, self._completed
        done, planned = _plain(self._completed), _plain(self._total)
        event = Advanced(self._label, done, planned, self._unit, elapsed_s, pace, left_s)
        self._progress.tell(event, **self._figures)

    def _pace(self, now_us: int) -> float | None:
        """Return how many are completed a second; what came before the first is no part of it."""
        if self._first is None:
            return None
        began_us, before = self._first
        if self._completed == before or now_us == began_us:
            began_us, before = self._began_us, self._before
        if now_us == began_us:
            return None
        return (self._completed - before) * US_PER_S / (now_us - began_us)


def _plain(count: float) -> float:
    """Return a whole number as one: 3, not 3.0."""
    return int(count) if float(count).is_integer() else count
