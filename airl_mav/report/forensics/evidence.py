"""Data of a flight and its run from which causes are derived."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from airl_mav.arena.geometry import Arena
from airl_mav.flight.episode_record import EpisodeRecord
from airl_mav.flight.judge import Outcome
from airl_mav.flight.trajectory import Trajectory
from airl_mav.rehearsal.run_folder import LoadedRun

if TYPE_CHECKING:
    from airl_mav.report.forensics.camera_view import PolicyCamera


HALF_WIDTH_M = 0.3
"""Half-width of a vehicle [m]."""

NO_CAUSE = "no cause found in the data"


@dataclass(frozen=True)
class Evidence:
    """Available data of one flight."""

    record: EpisodeRecord
    path: Trajectory
    """Path up to the verdict; empty if not recorded."""
    stamps: Mapping[str, NDArray[Any]]
    """Decisions by column; empty without decisions."""
    arena: Arena | None = None
    camera: PolicyCamera | None = None
    braking_m: Callable[[float], float] | None = None
    """Function of the vehicle's stopping distance [m] from a speed [m/s]."""


@dataclass(frozen=True)
class UsualFlight:
    """Medians of a run over the flights that reached the goal."""

    pace_s_m: float | None
    """Flight time per metre of the straight line to the goal's edge."""
    path_ratio: float | None
    """Ratio of the flown distance to the straight line."""
    speed_m_s: float | None
    """Mean speed of a flight."""


@dataclass(frozen=True)
class Cause:
    """Cause of a failed or long flight."""

    kind: str
    """Short name of the cause, equal for all flights with this cause."""
    sentences: tuple[str, ...]
    """Sentences with the supporting numbers."""


def straight_m(record: EpisodeRecord) -> float:
    """Return the horizontal straight distance from the start to the goal's edge [m]."""
    return max(0.1, math.hypot(*record.goal[:2]) - record.goal_radius_m)


def usual_flight(records: tuple[EpisodeRecord, ...]) -> UsualFlight:
    """Return the medians of a run; all None if no flight reached the goal."""
    good = [(r, r.quality) for r in records if r.outcome is Outcome.SUCCESS and r.quality]
    if not good:
        return UsualFlight(None, None, None)
    return UsualFlight(
        float(np.median([q.flight_time_s / straight_m(r) for r, q in good])),
        float(np.median([q.distance_m / straight_m(r) for r, q in good])),
        float(np.median([q.mean_speed_m_s for _, q in good])),
    )


def time_lost_s(record: EpisodeRecord, usual: UsualFlight) -> float | None:
    """Return the time lost relative to the run's median pace [s]."""
    if record.quality is None or usual.pace_s_m is None:
        return None
    return record.quality.flight_time_s - usual.pace_s_m * straight_m(record)


def path_excess(record: EpisodeRecord) -> float | None:
    """Return the excess of the flown distance over the straight line, as a fraction."""
    if record.quality is None:
        return None
    return record.quality.distance_m / straight_m(record) - 1.0


def ranked(run: LoadedRun) -> list[EpisodeRecord]:
    """Return all flights, worst first: failures, then successes, each by time lost."""
    usual = usual_flight(run.episodes)

    def key(e: EpisodeRecord) -> tuple[bool, float, int]:
        lost_s = time_lost_s(e, usual)
        if lost_s is None:
            lost_s = 0.0 if e.quality is None else e.quality.flight_time_s
        return (e.outcome is Outcome.SUCCESS, -lost_s, e.index)

    return sorted(run.episodes, key=key)
