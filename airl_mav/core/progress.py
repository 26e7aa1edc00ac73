"""Progress of long work: bars and lines on a terminal, or nothing for callers of the Python API.

Whoever does the work is given a `Progress`. It opens a `Bar` for what can be counted, says what is
done meanwhile, notes what a person should read and tells what a program should know. `RichProgress`
draws; `json_progress` writes for programs.
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
"""What is said while pages and pictures are made."""

WIDE = 110
"""A terminal of so many columns has room for bars and the time taken."""

PACE_S = 600.0
"""The remaining time is estimated from the pace over this interval [wall s]."""


@dataclass(frozen=True)
class Event:
    """What a program is told: one JSON object. Fields and their meaning are those of the class."""

    event: ClassVar[str]
    """What happened, in a word."""


class Bar:
    """One countable piece of work; by itself it shows nothing."""

    def advance(self, amount: float = 1.0) -> None:
        """Add to what is completed."""

    def update(
        self,
        *,
        completed: float | None = None,
        total: float | None = None,
        postfix: str | None = None,
        figures: Mapping[str, Any] | None = None,
    ) -> None:
        """Set what is completed of how much, the text after it, or what that says as figures.

        The figures are for programs. None leaves each as it is.
        """

    def close(self) -> None:
        """Remove the bar."""


class Progress:
    """Where long work says how far it is; by itself it passes everything over."""

    def bar(
        self,
        label: str,  # noqa: ARG002 (for those who draw)
        total: float,  # noqa: ARG002
        *,
        completed: float = 0.0,  # noqa: ARG002
        unit: str | None = None,  # noqa: ARG002
    ) -> Bar:
        """Open a bar.

        `completed` was done before and does not count for the pace. `unit`, in the plural, shows
        count and pace; None: neither.
        """
        return Bar()

    def status(self, text: str | None) -> None:
        """Say what is being done or waited for, until something else is; None: nothing."""

    def watch(self, text: str) -> None:
        """Say what somebody who looks on may want to see just now, instead of the status."""

    def tell(self, event: Event) -> None:
        """Tell programs what has happened."""

    def line(self, text: str) -> None:
        """Print how far long work is, where no bar can be drawn."""

    def note(self, text: str, style: str | None = None) -> None:
        """Print a line, taken literally, that outlasts the bars; `style` is one of rich's."""


class RichProgress(Progress):
    """Draws bars on an interactive console; notes are printed to any. Use as a context manager."""

    def __init__(self, console: Console, clock: Clock | None = None) -> None:
        """Draw on a console; without a terminal only notes are printed."""
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
        """Stop drawing and remove the bars."""
        if self._console.is_interactive:
            self._bars.stop()

    def bar(
        self, label: str, total: float, *, completed: float = 0.0, unit: str | None = None
    ) -> Bar:
        """Open a bar; see `Progress`."""
        return _RichBar(self._bars, label, total, completed, unit)

    def status(self, text: str | None) -> None:
        """Draw what is being done below the bars; see `Progress`."""
        self._bars.say(text)

    def watch(self, text: str) -> None:
        """Draw what is seen now below the bars; see `Progress`."""
        self._bars.say(text)

    def line(self, text: str) -> None:
        """Print a line without a terminal; see `Progress`."""
        if not self._console.is_interactive:
            self.note(text)

    def note(self, text: str, style: str | None = None) -> None:
        """Print a line; see `Progress`."""
        self._console.print(text, style=style, markup=False, highlight=False, soft_wrap=True)
        # In a file or a pipe a line must not wait for the end of the work.
        self._console.file.flush()


class _Bars(RichBars):
    """Bars, and a line below them that says what is being done."""

    _doing: Spinner | None = None

    def say(self, text: str | None) -> None:
        self._doing = None if text is None else Spinner("dots", Text(text, overflow="ellipsis"))

    def get_renderables(self) -> Iterable[RenderableType]:
        if self.tasks:
            yield self.make_tasks_table(self.tasks)
        if self._doing is not None:
            yield self._doing


class _RichBar(Bar):
    """A task of rich's."""

    def __init__(
        self, bars: RichBars, label: str, total: float, completed: float, unit: str | None
    ) -> None:
        self._bars = bars
        # Not by an update, which would count for the pace.
        self._task = bars.add_task(
            label,
            total=total,
            completed=completed,  # type: ignore[arg-type]
            before=completed,
            unit=unit,
            postfix="",
        )

    def advance(self, amount: float = 1.0) -> None:
        """Add to what is completed."""
        self._bars.advance(self._task, amount)

    def update(
        self,
        *,
        completed: float | None = None,
        total: float | None = None,
        postfix: str | None = None,
        figures: Mapping[str, Any] | None = None,  # noqa: ARG002 (the text says them)
    ) -> None:
        """Set what is completed of how much, or the text after the bar."""
        self._bars.update(self._task, completed=completed, total=total)
        if postfix is not None:
            self._bars.update(self._task, postfix=postfix)

    def close(self) -> None:
        """Remove the bar."""
        self._bars.remove_task(self._task)


class _Count(ProgressColumn):
    """The count and the pace, for bars that have a unit."""

    def render(self, task: Task) -> Text:
        """Return, for example, "120/1,000 3.4 flights/s", or "2/10 6.5 flights/min"."""
        unit = task.fields["unit"]
        if unit is None:
            return Text()
        count = f"{task.completed:,.0f}/{task.total:,.0f}"
        new = task.completed - task.fields["before"]
        if not new or not task.elapsed:
            return Text(count)
        # What came before the first one, as loading and compiling, is no part of the pace.
        pace, time = task.speed or new / task.elapsed, "s"
        if pace < 1.0:
            pace, time = 60.0 * pace, "min"
        return Text(f"{count} {pace:,.1f} {unit}/{time}")


class _Left(TimeRemainingColumn):
    """The time left, called so; the time taken at the end."""

    def __init__(self) -> None:
        super().__init__(elapsed_when_finished=True, table_column=Column(no_wrap=True))

    def render(self, task: Task) -> Text:
        """Return, for example, "0:01:12 left"."""
        text = super().render(task)
        return text if task.finished else Text.assemble(text, " left")
