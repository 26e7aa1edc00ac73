"""Worst flights of a run and their causes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from airl_mav.arena.geometry import Arena
from airl_mav.core.constants import US_PER_S
from airl_mav.envs.stopping import braking_of
from airl_mav.flight.judge import Outcome
from airl_mav.flight.record import EpisodeRecord
from airl_mav.flight.trajectory import Trajectory
from airl_mav.profiles.vehicle import VehicleProfile
from airl_mav.rehearsal.run_folder import LoadedRun
from airl_mav.report.forensics import evidence
from airl_mav.report.forensics.camera_view import PolicyCamera
from airl_mav.report.forensics.causes import cause_of
from airl_mav.report.table import NONE, OUTCOME_LABELS, TableView, columns_of

EXAMINED = 100
"""Maximum number of flights with a derived cause, worst first."""

LISTED = 12
"""Maximum number of rows in the table of worst flights."""

NAMED = 6
"""Maximum number of flights listed per cause."""

NOT_RECORDED = Trajectory(
    np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 4)), np.zeros(0)
)


@dataclass(frozen=True)
class ExaminedFlight:
    """Flight and its cause."""

    record: EpisodeRecord
    cause: evidence.Cause
    lost_s: float | None
    """Time lost relative to the run's median pace over the same straight line [s]."""
    excess: float | None
    """Excess of the flown distance over the straight line, as a fraction."""


def flown_path(run: LoadedRun, record: EpisodeRecord) -> Trajectory | None:
    """Return a flight's path up to the verdict, without the landing recorded after it."""
    path = run.trajectories.get(record.index)
    if path is None or not len(path):
        return None
    return path.between(int(path.time_us[0]), record.ended_us)


def examine_worst(
    run: LoadedRun, arenas: Mapping[int, Arena], vehicle: VehicleProfile | None
) -> list[ExaminedFlight]:
    """Return up to `EXAMINED` worst flights with their causes, as far as data allow."""
    usual = evidence.usual_flight(run.episodes)
    camera = None if vehicle is None else PolicyCamera.of(vehicle.camera)
    brake = None if vehicle is None else partial(_braking_m, vehicle)
    examined = []
    for record in evidence.ranked(run)[:EXAMINED]:
        path = flown_path(run, record)
        flight = evidence.Evidence(
            record,
            NOT_RECORDED if path is None else path,
            run.latency.get(record.index, {}),
            arenas.get(record.index),
            camera,
            brake,
        )
        lost_s, excess = evidence.time_lost_s(record, usual), evidence.path_excess(record)
        examined.append(ExaminedFlight(record, cause_of(flight, usual), lost_s, excess))
    return examined


def worst_table(judged: Sequence[ExaminedFlight], total: int) -> TableView:
    """Return the worst flights with their causes."""
    columns = columns_of(
        "# | seed | <outcome | after [s] | time lost [s] | way [x straight] | <cause"
    )
    shown = judged[:LISTED]
    notes = [
        "Failed flights first, each by time lost: its time less that of the run's median pace over "
        "the same straight way. Causes are worked out from what was recorded.",
    ]
    if len(shown) < total:
        notes.append(f"The {len(shown)} worst of {total:,} flights.")
    return TableView("worst", "Worst flights", columns, tuple(map(_row, shown)), tuple(notes))


def _row(judged: ExaminedFlight) -> tuple[str, ...]:
    record = judged.record
    arrived = record.outcome is Outcome.SUCCESS
    # Time lost is meaningless for flights that ended early.
    whole = arrived or record.outcome is Outcome.TIMEOUT
    return (
        f"{record.index}",
        f"{record.seed}",
        OUTCOME_LABELS[record.outcome],
        f"{(record.ended_us - record.zero_us) / US_PER_S:.1f}",
        NONE if judged.lost_s is None or not whole else f"{round(judged.lost_s, 1) + 0.0:+.1f}",
        NONE if judged.excess is None or not arrived else f"{1.0 + judged.excess:.2f}",
        judged.cause.kind,
    )


def causes_table(judged: Sequence[ExaminedFlight], run: LoadedRun) -> TableView | None:
    """Return the number of failed flights by cause; None for fewer than two failures."""
    failed = [j for j in judged if j.record.outcome is not Outcome.SUCCESS]
    if len(failed) < 2:
        return None
    counts = Counter(j.cause.kind for j in failed)
    rows = []
    for kind, count in counts.most_common():
        which = [f"{j.record.index}" for j in failed if j.cause.kind == kind]
        more = ", …" if len(which) > NAMED else ""
        rows.append(
            (
                kind,
                f"{count}",
                f"{100.0 * count / len(failed):.0f}",
                ", ".join(which[:NAMED]) + more,
            )
        )
    columns = columns_of("<cause | flights | of those that failed [%] | <which")
    all_failed = sum(e.outcome is not Outcome.SUCCESS for e in run.episodes)
    notes: tuple[str, ...] = ()
    if all_failed > len(failed):
        notes = (f"The first {len(failed)} of {all_failed:,} flights that failed.",)
    return TableView("causes", "Why flights failed", columns, tuple(rows), notes)


def _braking_m(vehicle: VehicleProfile, speed_m_s: float) -> float:
    return braking_of(vehicle).distance_from_m(speed_m_s)
