"""An evaluation at level lockstep: one flight at a time in each of several processes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Protocol

from airl_mav.flight.record import EpisodeRecord
from airl_mav.rehearsal.episode_saver import EpisodeSaver
from airl_mav.rehearsal.evaluation import Evaluation, Job, Watch
from airl_mav.rehearsal.run_folder import FlownEpisode, RunFolder
from airl_mav.rehearsal.workers import Workers

Fly = Callable[[Job], FlownEpisode]


class Flier(Protocol):
    """What a worker is made of; goes there by pickle."""

    def start(self, tlogs: RunFolder | None) -> Fly:
        """Load everything once; return what flies an episode.

        Args:
            tlogs: Where the MAVLink logs go; None: no logs.
        """
        ...


@dataclass(frozen=True)
class LockstepRun:
    """Everything an evaluation at level lockstep needs to know."""

    evaluation: Evaluation
    flier: Flier
    workers: int
    """Flights at a time; decides nothing."""
    tlogs: bool
    """Whether MAVLink logs are written."""


def fly_lockstep(
    run: LockstepRun, folder: RunFolder, done: Sequence[EpisodeRecord], watch: Watch
) -> None:
    """Fly what is left of a run, and save it.

    Args:
        run: The run.
        folder: Where everything goes.
        done: Episodes that lie there already.
        watch: Who looks on; hears of workers that were lost, and may stop it at any time.

    Raises:
        UsageError: No arena can be made of a seed; what was flown before is kept.
        WorkerError: A flight cannot be flown; what was flown before is kept.
    """
    start = partial(run.flier.start, folder if run.tlogs else None)
    workers: Workers[Job, FlownEpisode] = Workers(
        start, run.workers, name=lambda job: f"seed {job.seed}", lost=watch.say
    )
    with EpisodeSaver(folder) as saver, workers:
        for episode in workers.do(run.evaluation.jobs(done), watch.stop):
            saver.add(episode)
            watch.finished(episode.record)
