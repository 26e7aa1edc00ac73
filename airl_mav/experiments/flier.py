"""How the episodes of a scenario are flown in a worker: what each level implements."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Protocol

from airl_mav.experiments.executors import Stop
from airl_mav.rehearsal.run_folder import FlownEpisode, RunFolder
from airl_mav.scenario.resolved import PlannedEpisode

FlyEpisodes = Callable[[Sequence[PlannedEpisode]], Iterable[FlownEpisode]]


class Flier(Protocol):
    """How the episodes of a scenario are flown. Goes to workers by pickle."""

    def episodes_per_job(self, episodes: int, workers: int) -> int:
        """Return the episodes per job for executors that do not stream results."""
        ...

    def start(self, folder: RunFolder, stop: Stop) -> FlyEpisodes:
        """Load everything once; return a function that flies episodes and polls `stop`."""
        ...
