"""What is known of one flight and of its run: causes are worked out from it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from airl_mav.arena.geometry import Arena
from airl_mav.flight.judge import Outcome
from airl_mav.flight.record import EpisodeRecord
from airl_mav.flight.trajectory import Trajectory
from airl_mav.rehearsal.run_folder import LoadedRun

if TYPE_CHECKING:
    from airl_mav.report.forensics.camera_view import PolicyCamera


HALF_WIDTH_M = 0.3
"""Room that a vehicle takes to either side."""

NO_CAUSE = "no cause found in the data"


@dataclass(frozen=True)
class Evidence:
    """Everything that is known of one flight."""

    record: EpisodeRecord
    path: Trajectory
    """Up to the verdict; empty where nothing was recorded."""
    stamps: Mapping[str, NDArray[Any]]
    """Its decisions by column; empty where there is none."""
    arena: Arena | None = None
    camera: PolicyCamera | None = None
    braking_m: Callable[[float], float] | None = None
    """The vehicle's way from a speed [m/s] to a stand [m]."""


@dataclass(frozen=True)
class UsualFlight:
    """Medians of a run over the flights that reached the goal."""

    pace_s_m: float | None
    """Flight time by metre of the straight way to the goal's edge."""
    path_ratio: float | None
    """Distance flown by the length of that way."""
    speed_m_s: float | None
    """Mean speed of a flight."""


@dataclass(frozen=True)
class Cause:
    """Why a flight failed, or took long."""

    kind: str
    """A few words, the same for all flights with this cause."""
    sentences: tuple[str, ...]
    """Sentences with the numbers behind it."""


def straight_m(record: EpisodeRecord) -> float:
    """Return the length of the straight level way from the start to the goal's edge [m]."""
    return max(0.1, math.hypot(*record.goal[:2]) - record.goal_radius_m)


def usual_flight(records: tuple[EpisodeRecord, ...]) -> UsualFlight:
    """Return the medians of a run; None where no flight reached the goal."""
    good = [(r, r.quality) for r in records if r.outcome is Outcome.SUCCESS and r.quality]
    if not good:
        return UsualFlight(None, None, None)
    return UsualFlight(
        float(np.median([q.flight_time_s / straight_m(r) for r, q in good])),
        float(np.median([q.distance_m / straight_m(r) for r, q in good])),
        float(np.median([q.mean_speed_m_s for _, q in good])),
    )


def time_lost_s(record: EpisodeRecord, usual: UsualFlight) -> float | None:
    """Return how much longer a flight took than its way takes at the run's median pace [s]."""
    if record.quality is None or usual.pace_s_m is None:
        return None
    return record.quality.flight_time_s - usual.pace_s_m * straight_m(record)


def path_excess(record: EpisodeRecord) -> float | None:
    """Return by how much the way flown exceeds the straight one, as a fraction of it."""
    if record.quality is None:
        return None
    return record.quality.distance_m / straight_m(record) - 1.0


def ranked(run: LoadedRun) -> list[EpisodeRecord]:
    """Return all flights, worst first: failures, then successes, each by the time they lost."""
    usual = usual_flight(run.episodes)

    def key(e: EpisodeRecord) -> tuple[bool, float, int]:
        lost_s = time_lost_s(e, usual)
        if lost_s is None:
            lost_s = 0.0 if e.quality is None else e.quality.flight_time_s
        return (e.outcome is Outcome.SUCCESS, -lost_s, e.index)

    return sorted(run.episodes, key=key)
