"""What a person sees while many episodes fly, and how that person stops them."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from airl_mav.core.clock import WallClock
from airl_mav.core.constants import US_PER_S
from airl_mav.flight.judge import Outcome
from airl_mav.flight.record import EpisodeRecord


class EpisodeBar:
    """A progress bar over the episodes, with the success rate so far and the pace."""

    def __init__(
        self, console: Console, title: str, done: Sequence[EpisodeRecord], episodes: int
    ) -> None:
        """Begin with the episodes that were flown before, of so many in all."""
        self._console = console
        self._progress = Progress(
            TextColumn(title, markup=False),
            BarColumn(bar_width=24),
            TextColumn("{task.completed:.0f}/{task.total:.0f}"),
            TimeElapsedColumn(),
            TextColumn("{task.fields[rate]}"),
            TextColumn("{task.fields[pace]}"),
            console=console,
            transient=True,
        )
        self._task = self._progress.add_task("episodes", total=episodes, rate="", pace="")
        self._clock = WallClock()
        self._new = 0
        self._counted = self._reached = 0
        for record in done:
            self._count(record)

    def __enter__(self) -> EpisodeBar:
        """Start drawing, if there is somebody to see it."""
        if self._console.is_interactive:
            self._progress.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Stop drawing."""
        if self._console.is_interactive:
            self._progress.stop()

    def finished(self, record: EpisodeRecord) -> None:
        """Count an episode that has just ended."""
        self._new += 1
        self._count(record)

    def say(self, text: str) -> None:
        """Print something that the person should know."""
        self._console.print(text, style="yellow", markup=False, highlight=False, soft_wrap=True)

    def _count(self, record: EpisodeRecord) -> None:
        self._counted += 1
        self._reached += record.outcome is Outcome.SUCCESS
        passed_s = self._clock.time_us() / US_PER_S
        self._progress.update(
            self._task,
            completed=self._counted,
            rate=f"{100.0 * self._reached / self._counted:.1f} % reached the goal",
            pace=f"{self._new / passed_s:.1f} episodes/s" if self._new and passed_s else "",
        )


@contextmanager
def stop_on_signals() -> Iterator[Callable[[], bool]]:
    """Give a function that says whether Ctrl-C or SIGTERM has come; a second one is not waited for.

    So nothing is torn: what has ended is saved before the command leaves.
    """
    seen: list[int] = []

    def note(number: int, _frame: object) -> None:
        if seen:
            raise KeyboardInterrupt
        seen.append(number)

    before = {number: signal.signal(number, note) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: bool(seen)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
