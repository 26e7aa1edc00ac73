"""Progress of long tasks: bars and lines on a terminal, or nothing for callers of the Python API.

Tasks report to a `Progress`: a `Bar` for countable work, the current status, notes for people, and
events for programs. `RichProgress` draws; `json_progress` writes for programs.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from types import TracebackType
from typing import Any, ClassVar

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
from rich.spinner import Spinner
from rich.table import Column
from rich.text import Text

from airl_mav.core.clock import Clock, WallClock
from airl_mav.core.constants import US_PER_S

DRAWING = "drawing the report"
"""Status text while pages and figures are created."""

WIDE = 110
"""Minimum width of a terminal for bars and the elapsed time [columns]."""

PACE_S = 600.0
"""The remaining time is estimated from the pace over this interval [wall s]."""


@dataclass(frozen=True)
class Event:
    """Event for programs: one JSON object with the fields of the class."""

    event: ClassVar[str]
    """Type of the event."""


class Bar:
    """Countable task; this base class shows nothing."""

    def advance(self, amount: float = 1.0) -> None:
        """Increase the completed amount."""

    def update(
        self,
        *,
        completed: float | None = None,
        total: float | None = None,
        postfix: str | None = None,
        figures: Mapping[str, Any] | None = None,
    ) -> None:
        """Set the completed and total amount, the text after the bar, or its values for programs.

        None leaves a value unchanged.
        """

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

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
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

    def update(
        self,
        *,
        completed: float | None = None,
        total: float | None = None,
        postfix: str | None = None,
        figures: Mapping[str, Any] | None = None,  # noqa: ARG002 (the text says them)
    ) -> None:
        """Set the completed and total amount, or the text after the bar."""
        self._bars.update(self._task, completed=completed, total=total)
        if postfix is not None:
            self._bars.update(self._task, postfix=postfix)

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
