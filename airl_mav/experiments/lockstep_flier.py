"""How the episodes of a scenario are flown in a worker: lockstep."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from airl_mav.experiments.executors import Stop
from airl_mav.experiments.flier import FlyEpisodes
from airl_mav.rehearsal.run_folder import FIRMWARE_PRINTS, FlownEpisode, RunFolder
from airl_mav.scenario.resolved import PlannedEpisode, ResolvedScenario


@dataclass(frozen=True)
class LockstepFlier:
    """Level lockstep: one flight at a time in each worker. Implements `Flier`."""

    scenario: ResolvedScenario

    def episodes_per_job(self, episodes: int, workers: int) -> int:  # noqa: ARG002
        """Return how many episodes make a job; see `Flier`."""
        return 1

    def start(self, folder: RunFolder, stop: Stop) -> FlyEpisodes:  # noqa: ARG002 (asked between flights)
        """Load everything; see `Flier`."""
        # Here: flight controller and MAVSDK are for those who fly, not for those who have it flown.
        from airl_mav.lockstep.flight import fly
        from firmware_sim.warm_up import warm_up

        scenario = self.scenario
        warm_up(scenario.vehicle, scenario.scenario.plant)
        log = folder.path / FIRMWARE_PRINTS  # of flights side by side, mixed

        def fly_all(episodes: Sequence[PlannedEpisode]) -> Iterator[FlownEpisode]:
            for episode in episodes:
                tlog = folder.tlog_path(episode.index) if scenario.scenario.tlogs else None
                policy = scenario.fresh_policy(episode.seed)
                yield fly(scenario, policy, episode.index, episode.seed, tlog=tlog, log=log)

        return fly_all
