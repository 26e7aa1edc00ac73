"""The flights of a run in the order in which they went wrong, by their records alone."""

from __future__ import annotations

from airl_mav.flight.judge import Outcome
from airl_mav.flight.record import EpisodeRecord
from airl_mav.rehearsal.run_folder import LoadedRun
from airl_mav.report.forensics.evidence import time_lost_s, usual_flight


def ranked(run: LoadedRun) -> list[EpisodeRecord]:
    """Return all flights, the worst first.

    Those that failed come first, then those that reached the goal; each by the time they lost, or
    took where no flight reached the goal.
    """
    usual = usual_flight(run.episodes)

    def key(e: EpisodeRecord) -> tuple[bool, float, int]:
        lost_s = time_lost_s(e, usual)
        if lost_s is None:
            lost_s = 0.0 if e.quality is None else e.quality.flight_time_s
        return (e.outcome is Outcome.SUCCESS, -lost_s, e.index)

    return sorted(run.episodes, key=key)
