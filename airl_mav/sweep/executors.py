"""Who carries out trials: an `Executor`. Here, the processes of this machine."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

from airl_mav.rehearsal.workers import Workers
from airl_mav.sweep.result import TrialResult
from airl_mav.sweep.trial import Trial

Work = Callable[[], Callable[[Trial], TrialResult]]
"""What a worker is made of: `work.TrialWork`. Goes to another process by pickle."""


class Executor(Protocol):
    """Maps trials to results, several at a time."""

    def run(self, waiting: Sequence[Trial], stop: Callable[[], bool]) -> Iterator[TrialResult]:
        """Carry out trials and yield their results as they come, in any order.

        Args:
            waiting: Trials to carry out, each wherever it is.
            stop: Asked several times a second; True ends it all, what is under way is given up.

        Raises:
            UsageError: A worker said so.
            WorkerError: A trial failed, or its worker was lost `workers.TRIES` times.
        """
        ...


@dataclass(frozen=True)
class LocalExecutor:
    """Processes on this machine, one trial at a time in each."""

    work: Work
    workers: int
    lost: Callable[[str], None]
    """Is told, in words, of each worker that was lost."""

    def run(self, waiting: Sequence[Trial], stop: Callable[[], bool]) -> Iterator[TrialResult]:
        """Carry out trials; see `Executor`."""
        workers: Workers[Trial, TrialResult] = Workers(
            self.work, self.workers, name=lambda trial: trial.name, lost=self.lost
        )
        with workers:
            yield from workers.do(waiting, stop)
