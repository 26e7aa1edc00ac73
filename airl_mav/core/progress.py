"""Progress of long work: bars and lines on a terminal, or nothing for callers of the Python API.

Whoever does the work is given a `Progress`: it opens a `Bar` for what can be counted and notes what
a person should read. `RichProgress` draws.
"""

from __future__ import annotations

from types import TracebackType

from rich.console import Console
from rich.progress import (
    BarColumn,
    ProgressColumn,
    Task,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.progress import Progress as RichBars
from rich.text import Text

from airl_mav.core.clock import Clock, WallClock
from airl_mav.core.constants import US_PER_S

PACE_S = 600.0
"""The remaining time is estimated from the pace over this interval [wall s]."""


class Bar:
    """One countable piece of work; by itself it shows nothing."""

    def advance(self, amount: float = 1.0) -> None:
        """Add to what is completed."""

    def update(self, *, completed: float | None = None, postfix: str | None = None) -> None:
        """Set what is completed, or the text after the bar; None leaves it as it is."""

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

        Args:
            label: What is being done.
            total: How much of it there is.
            completed: How much of it had been done before; does not count for the pace.
            unit: What is counted, in the plural: shows the count and the pace. None: neither.
        """
        return Bar()

    def note(self, text: str, style: str | None = None) -> None:
        """Print a line for a person; it stays when the bars are gone.

        Args:
            text: The line, taken literally.
            style: A style of rich: "yellow" for what a person should know.
        """


class RichProgress(Progress):
    """Draws bars on an interactive console; notes are printed to any. Use as a context manager."""

    def __init__(self, console: Console, clock: Clock | None = None) -> None:
        """Draw on a console.

        Args:
            console: Where to draw; without a terminal only notes are printed.
            clock: Of elapsed and remaining time; None is the wall clock.
        """
        self._console = console
        source = clock or WallClock()
        self._bars = RichBars(
            TextColumn("{task.description}", markup=False),
            BarColumn(bar_width=24),
            _Count(),
            TextColumn("{task.fields[postfix]}", markup=False),
            TimeElapsedColumn(),
            TimeRemainingColumn(elapsed_when_finished=True),
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

    def note(self, text: str, style: str | None = None) -> None:
        """Print a line; see `Progress`."""
        self._console.print(text, style=style, markup=False, highlight=False, soft_wrap=True)
        # In a file or a pipe a line must not wait for the end of the work.
        self._console.file.flush()


class _RichBar(Bar):
    """A task of rich's."""

    def __init__(
        self, bars: RichBars, label: str, total: float, completed: float, unit: str | None
    ) -> None:
        self._bars = bars
        self._task = bars.add_task(label, total=total, before=completed, unit=unit, postfix="")
        bars.update(self._task, completed=completed)

    def advance(self, amount: float = 1.0) -> None:
        """Add to what is completed."""
        self._bars.advance(self._task, amount)

    def update(self, *, completed: float | None = None, postfix: str | None = None) -> None:
        """Set what is completed, or the text after the bar."""
        self._bars.update(self._task, completed=completed)
        if postfix is not None:
            self._bars.update(self._task, postfix=postfix)

    def close(self) -> None:
        """Remove the bar."""
        self._bars.remove_task(self._task)


class _Count(ProgressColumn):
    """The count and the pace, for bars that have a unit."""

    def render(self, task: Task) -> Text:
        """Return, for example, "120/1,000  3.4 episodes/s"."""
        unit = task.fields["unit"]
        if unit is None:
            return Text()
        count = f"{task.completed:,.0f}/{task.total:,.0f}"
        new = task.completed - task.fields["before"]
        return Text(
            f"{count}  {new / task.elapsed:,.1f} {unit}/s" if new and task.elapsed else count
        )
