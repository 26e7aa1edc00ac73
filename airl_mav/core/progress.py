"""Progress of long tasks: bars and lines on a terminal, or nothing for callers of the Python API.

Tasks report to a `Progress`: a `Bar` for countable work, the current status, notes for people, and
events for programs. `RichProgress` draws; `JsonProgress` writes for programs. `new_console`
returns the console of a command, without rich's markup in paths and messages.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from functools import partial
from typing import IO, Any, ClassVar, TypedDict

from rich.console import Console, RenderableType
from rich.progress import (
    BarColumn,
    ProgressColumn,
    Task,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.progress import Progress as RichBars
from rich.segment import Segment
from rich.spinner import Spinner
from rich.table import Column
from rich.text import Text
from typing_extensions import Unpack

from airl_mav.core.clock import Clock, WallClock
from airl_mav.core.constants import US_PER_S

DRAWING = "drawing the report"
"""Status text while pages and figures are created."""

WIDE = 110
"""Minimum width of a terminal for bars and the elapsed time [columns]."""

PACE_S = 600.0
"""The remaining time is estimated from the pace over this interval [wall s]."""


_CONTROLS = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069]")
"""Control characters, which steer a terminal; tab and newline are none."""


class _SafeConsole(Console):
    """Console without the control characters of printed texts, which may come from a file."""

    def _render_buffer(self, buffer: Iterable[Segment]) -> str:
        return super()._render_buffer(
            each
            if each.control
            else Segment(_CONTROLS.sub("\N{REPLACEMENT CHARACTER}", each.text), each.style)
            for each in buffer
        )


new_console = partial(_SafeConsole, markup=False, emoji=False)
"""Factory of consoles that print square brackets and `:name:` as they are."""


@dataclass(frozen=True)
class Event:
    """Event for programs: one JSON object with the fields of the class."""

    event: ClassVar[str]
    """Type of the event."""


class BarChanges(TypedDict, total=False):
    """Changes of a bar."""

    completed: float
    """Completed amount."""
    total: float
    """Total amount."""
    postfix: str
    """Text after the bar, for people."""
    figures: Mapping[str, Any]
    """Values for programs."""


class Bar:
    """Countable task; this base class shows nothing."""

    def advance(self, amount: float = 1.0) -> None:
        """Increase the completed amount."""

    def update(self, **changes: Unpack[BarChanges]) -> None:
        """Set amounts, text or values."""

    def close(self) -> None:
        """Remove the bar."""


class Progress:
    """Receiver of progress reports; this base class ignores them."""

    def bar(
        self,
        label: str,  # noqa: ARG002 (for subclasses)
        total: float,  # noqa: ARG002
        *,
        completed: float = 0.0,  # noqa: ARG002
        unit: str | None = None,  # noqa: ARG002
    ) -> Bar:
        """Open a bar.

        `completed` is the initial amount, which does not count for the pace. `unit`, in the plural,
        enables count and pace; None = neither.
        """
        return Bar()

    def status(self, text: str | None) -> None:
        """Show the current activity or wait, until the next call; None clears it."""

    def watch(self, text: str) -> None:
        """Show live information for spectators in place of the status."""

    def tell(self, event: Event) -> None:
        """Send an event to programs."""

    def line(self, text: str) -> None:
        """Print progress on consoles that cannot draw bars."""

    def note(self, text: str, style: str | None = None) -> None:
        """Print a permanent line without markup; `style` is a style of rich."""


class RichProgress(Progress):
    """Progress with bars on interactive consoles; prints notes on any. Use as a context manager."""

    def __init__(self, console: Console, clock: Clock | None = None) -> None:
        """Set the console; without a terminal only notes are printed."""
        self._console = console
        source = clock or WallClock()
        wide = console.width >= WIDE
        label = Column(no_wrap=True, overflow="ellipsis", max_width=40 if wide else 18)
        self._bars = _Bars(
            TextColumn("{task.description}", markup=False, table_column=label),
            *([BarColumn(bar_width=24)] if wide else []),
            _Count(table_column=Column(no_wrap=True)),
            TextColumn("{task.fields[postfix]}", markup=False),
            *([TimeElapsedColumn()] if wide else []),
            _Left(),
            console=console,
            transient=True,
            speed_estimate_period=PACE_S,
            get_time=lambda: source.time_us() / US_PER_S,
        )

    def __enter__(self) -> RichProgress:
        """Start drawing, if there is a terminal."""
        if self._console.is_interactive:
            self._bars.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Remove the bars."""
        if self._console.is_interactive:
            self._bars.stop()

    def bar(
        self, label: str, total: float, *, completed: float = 0.0, unit: str | None = None
    ) -> Bar:
        """Open a bar; see `Progress`."""
        return _RichBar(self._bars, label, total, completed, unit)

    def status(self, text: str | None) -> None:
        """Draw the status below the bars; see `Progress`."""
        self._bars.say(text)

    def watch(self, text: str) -> None:
        """Draw live information below the bars; see `Progress`."""
        self._bars.say(text)

    def line(self, text: str) -> None:
        """Print a line if there is no terminal; see `Progress`."""
        if not self._console.is_interactive:
            self.note(text)

    def note(self, text: str, style: str | None = None) -> None:
        """Print a line; see `Progress`."""
        self._console.print(text, style=style, markup=False, highlight=False, soft_wrap=True)
        # Flush: in a file or a pipe a line must appear immediately.
        self._console.file.flush()


class _Bars(RichBars):
    """Bars, with a status line below them."""

    _doing: Spinner | None = None

    def say(self, text: str | None) -> None:
        self._doing = None if text is None else Spinner("dots", Text(text, overflow="ellipsis"))

    def get_renderables(self) -> Iterable[RenderableType]:
        if self.tasks:
            yield self.make_tasks_table(self.tasks)
        if self._doing is not None:
            yield self._doing


class _RichBar(Bar):
    """Bar drawn as a task of rich."""

    def __init__(
        self, bars: RichBars, label: str, total: float, completed: float, unit: str | None
    ) -> None:
        self._bars = bars
        # Set here: an update would count for the pace.
        self._task = bars.add_task(
            label,
            total=total,
            completed=completed,  # type: ignore[arg-type]
            before=completed,
            unit=unit,
            postfix="",
        )

    def advance(self, amount: float = 1.0) -> None:
        """Increase the completed amount."""
        self._bars.advance(self._task, amount)

    def update(self, **changes: Unpack[BarChanges]) -> None:
        """Set amounts or the text after the bar."""
        changes.pop("figures", None)  # The text contains them.
        self._bars.update(self._task, **changes)

    def close(self) -> None:
        """Remove the bar."""
        self._bars.remove_task(self._task)


class _Count(ProgressColumn):
    """Column with count and pace, for bars with a unit."""

    def render(self, task: Task) -> Text:
        """Return, for example, "120/1,000 3.4 flights/s", or "2/10 6.5 flights/min"."""
        unit = task.fields["unit"]
        if unit is None:
            return Text()
        count = f"{task.completed:,.0f}/{task.total:,.0f}"
        new = task.completed - task.fields["before"]
        if not new or not task.elapsed:
            return Text(count)
        # Time before the first completed unit, such as loading and compiling, is excluded.
        pace, time = task.speed or new / task.elapsed, "s"
        if pace < 1.0:
            pace, time = 60.0 * pace, "min"
        return Text(f"{count} {pace:,.1f} {unit}/{time}")


class _Left(TimeRemainingColumn):
    """Column with the remaining time; shows the elapsed time at the end."""

    def __init__(self) -> None:
        super().__init__(elapsed_when_finished=True, table_column=Column(no_wrap=True))

    def render(self, task: Task) -> Text:
        """Return, for example, "0:01:12 left"."""
        text = super().render(task)
        return text if task.finished else Text.assemble(text, " left")


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
        self.clock = clock or WallClock()
        self._status: str | None = None

    def bar(
        self, label: str, total: float, *, completed: float = 0.0, unit: str | None = None
    ) -> Bar:
        """Begin a task; see `Progress`."""
        return _JsonBar(self, label, total, completed, unit)

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
        self, progress: JsonProgress, label: str, total: float, completed: float, unit: str | None
    ) -> None:
        self._progress, self._clock = progress, progress.clock
        self._label, self._total, self._unit = label, total, unit
        self._before = self._completed = completed
        self._began_us = self._clock.time_us()
        self._first: tuple[int, float] | None = None
        """Time and number of the first completed units; None = no unit completed."""
        self._told_us: int | None = None
        self._told = completed
        self._figures: dict[str, Any] = {}

    def advance(self, amount: float = 1.0) -> None:
        """Increase the completed amount."""
        self.update(completed=self._completed + amount)

    def update(self, **changes: Unpack[BarChanges]) -> None:
        """Set amounts, or additional values of the event."""
        self._figures.update(changes.get("figures", {}))
        self._total = changes.get("total", self._total)
        completed = changes.get("completed")
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
