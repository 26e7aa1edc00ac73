"""Progress reports for programs: one JSON object per line."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import IO, Any, ClassVar

from airl_mav.core.clock import Clock, WallClock
from airl_mav.core.constants import US_PER_S
from airl_mav.core.progress import Bar, Event, Progress

EVERY_S = 1.0
"""Minimum interval between progress events of one task [wall s]."""


@dataclass(frozen=True)
class ActivityStatus(Event):
    """Current activity or wait."""

    event: ClassVar[str] = "status"
    text: str


@dataclass(frozen=True)
class Note(Event):
    """Remark for people: a warning, or a flight controller's text."""

    event: ClassVar[str] = "note"
    text: str


@dataclass(frozen=True)
class Advanced(Event):
    """Progress of a task: at most once per second, and at its end."""

    event: ClassVar[str] = "progress"
    work: str
    """Name of the task, as its bar's label."""
    done: float
    planned: float
    unit: str | None
    """Unit of the count, in the plural."""
    elapsed_s: float
    """Time since this command began the task [wall s]."""
    per_s: float | None
    """Pace of this command since the first completed unit [1/s]; None before the first one."""
    left_s: float | None
    """Remaining time at this pace [wall s]."""


class JsonProgress(Progress):
    """Progress that writes a line of JSON for every event."""

    def __init__(self, out: IO[str], clock: Clock | None = None) -> None:
        """Write to a stream; `clock` measures the pace, by default in wall time."""
        self._out = out
        self._clock = clock or WallClock()
        self._status: str | None = None

    def bar(
        self, label: str, total: float, *, completed: float = 0.0, unit: str | None = None
    ) -> Bar:
        """Begin a task; see `Progress`."""
        return _JsonBar(self, self._clock, label, total, completed, unit)

    def status(self, text: str | None) -> None:
        """Write the status if it has changed."""
        if text is not None and text != self._status:
            self.tell(ActivityStatus(text))
            self._status = text

    def note(self, text: str, style: str | None = None) -> None:  # noqa: ARG002 (for drawing)
        """Write a remark."""
        self.tell(Note(text.strip()))

    def tell(self, event: Event, **more: Any) -> None:
        """Write an event with additional values, and flush the stream."""
        line = {"event": event.event, **asdict(event), **more}
        self._out.write(json.dumps(line, ensure_ascii=False, allow_nan=False) + "\n")
        self._out.flush()


class _JsonBar(Bar):
    """Task that is reported to programs."""

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
        """Time and number of the first completed units; None = no unit completed."""
        self._told_us: int | None = None
        self._told = completed
        self._figures: dict[str, Any] = {}

    def advance(self, amount: float = 1.0) -> None:
        """Increase the completed amount."""
        self.update(completed=self._completed + amount)

    def update(
        self,
        *,
        completed: float | None = None,
        total: float | None = None,
        postfix: str | None = None,  # noqa: ARG002 (the figures contain it)
        figures: Mapping[str, Any] | None = None,
    ) -> None:
        """Set the completed and total amount, or additional values of the event."""
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
        """Write the last progress if it has not been reported."""
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
        """Return the completed units per second, measured from the first completed unit."""
        if self._first is None:
            return None
        began_us, before = self._first
        if self._completed == before or now_us == began_us:
            began_us, before = self._began_us, self._before
        if now_us == began_us:
            return None
        return (self._completed - before) * US_PER_S / (now_us - began_us)


def _plain(count: float) -> float:
    """Return a whole number as int: 3, not 3.0."""
    return int(count) if float(count).is_integer() else count
