"""Level lockstep: one flight at a time in each worker."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from airl_mav.experiments.campaign import FlyEpisodes
from airl_mav.experiments.executors import Stop
from airl_mav.lockstep.flight import LockstepPlan, fly
from airl_mav.policy.actions import Policy
from airl_mav.rehearsal.evaluation import PlannedEpisode
from airl_mav.rehearsal.run_folder import FlownEpisode, RunFolder
from firmware_sim.warm_up import warm_up


@dataclass(frozen=True)
class LockstepFlier:
    """Flies the episodes of a cell in lockstep. Implements `campaign.Flier`."""

    plan: LockstepPlan
    load_policy: Callable[[], Callable[[int], Policy]]
    """Loads the policy once; what it returns gives it as it begins a flight with a seed. Goes to
    workers by pickle."""
    tlogs: bool
    """Whether MAVLink logs are written into the run folder."""

    def episodes_per_job(self, episodes: int, workers: int) -> int:  # noqa: ARG002
        """Return how many episodes make a job; see `campaign.Flier`."""
        return 1

    def start(self, folder: RunFolder, stop: Stop) -> FlyEpisodes:
        """Load everything; see `campaign.Flier`."""
        warm_up(self.plan.vehicle)
        policy_for = self.load_policy()

        def fly_all(episodes: Sequence[PlannedEpisode]) -> Iterator[FlownEpisode]:
            for episode in episodes:
                if stop():
                    return
                tlog = folder.tlog_path(episode.index) if self.tlogs else None
                yield fly(
                    self.plan, policy_for(episode.seed), episode.index, episode.seed, tlog=tlog
                )

        return fly_all
