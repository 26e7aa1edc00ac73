"""What a person sees of a sweep: a bar over all of it, and a line for each trial."""

from __future__ import annotations

from collections.abc import Sequence
from types import TracebackType

from rich.console import Console
from rich.progress import (
    BarColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from airl_mav.core.clock import WallClock
from airl_mav.core.constants import US_PER_S
from airl_mav.sweep.result import TrialResult
from airl_mav.sweep.store import SweepFolder
from airl_mav.sweep.trial import Trial, size_of

LOOK_US = US_PER_S
"""How often the notes of the trainings are read [wall µs]."""

PACE_S = 600.0
"""Over how long the pace is measured that the time left is told from [wall s]."""

MOST_LINES = 12
"""Trials at work that get a line of their own."""


class SweepProgress:
    """Follows the trials by the notes that they leave in the sweep's folder."""

    def __init__(
        self, console: Console, folder: SweepFolder, trials: Sequence[Trial], ended: int
    ) -> None:
        """Begin with so many trials ended, of all those given."""
        self._console, self._folder = console, folder
        self._steps = folder.config.training.steps
        self._total, self._ended = len(trials), ended
        self._open: dict[Trial, float] = {}
        """Work of each trial that has not ended."""
        self._progress = Progress(
            TextColumn("{task.description}", markup=False),
            BarColumn(bar_width=24),
            TextColumn("{task.fields[told]}", markup=False),
            TimeElapsedColumn(),
            TextColumn("{task.fields[left]}"),
            TimeRemainingColumn(elapsed_when_finished=True),
            console=console,
            transient=True,
            speed_estimate_period=PACE_S,
        )
        self._all = self._progress.add_task("sweep", total=1.0, told="", left="at most")
        self._lines: dict[Trial, TaskID] = {}
        self._clock = WallClock()
        self._due_us = 0
        self._done_work = 0.0

    def __enter__(self) -> SweepProgress:
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

    def begin(self, waiting: Sequence[Trial]) -> None:
        """Say which trials are to be carried out."""
        self._open = {trial: self._work(trial) for trial in waiting}
        self._progress.update(self._all, total=sum(self._open.values()) or 1.0)
        self._draw()

    def finished(self, result: TrialResult) -> None:
        """Count a trial that has just ended."""
        self._ended += 1
        trial, trained = result.trial, result.trained
        self._done_work += self._open.pop(trial, 0.0)
        if (line := self._lines.pop(trial, None)) is not None:
            self._progress.remove_task(line)
        width = len(f"{self._total}")
        self._console.print(
            f"{self._ended:>{width}}/{self._total}  {trial.arena_name}  {trial.network:>6}  "
            f"seed {trial.seed}  success {result.success_rate:6.1%} of {result.episodes}, best "
            f"after {trained.best_steps:,} of {trained.steps:,} decisions, "
            f"{trained.seconds:,.0f} s",
            markup=False,
            highlight=False,
            soft_wrap=True,
        )
        self._draw()

    def look(self) -> None:
        """Look how far the trainings are; cheap, to be called often."""
        if self._clock.time_us() >= self._due_us:
            self._due_us = self._clock.time_us() + LOOK_US
            self._draw()

    def say(self, text: str) -> None:
        """Print something that the person should know."""
        self._console.print(text, style="yellow", markup=False, highlight=False, soft_wrap=True)

    def _work(self, trial: Trial) -> float:
        """Return how long a trial takes, in a unit of its own: for the bar only.

        Measured on one core, a decision's cost grows more slowly than its multiply-accumulates.
        """
        return float(size_of(self._folder.config, trial).macs ** 0.75)

    def _draw(self) -> None:
        under_way = 0.0
        for trial, work in self._open.items():
            now = self._folder.progress(trial)
            if now is None:
                continue
            share = min(now.steps / self._steps, 1.0)
            under_way += share * work
            told = f"{now.steps:,}/{self._steps:,}"
            if now.success is not None:
                told += f"  success {now.success:.0%}"
            if trial not in self._lines and len(self._lines) < MOST_LINES:
                self._lines[trial] = self._progress.add_task(
                    trial.name, total=1.0, told=told, left=""
                )
            if trial in self._lines:
                self._progress.update(self._lines[trial], completed=share, told=told)
        self._progress.update(
            self._all,
            completed=self._done_work + under_way,
            told=f"{self._ended}/{self._total} trials",
        )
