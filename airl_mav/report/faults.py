"""The faults of a run: which acted in which flight, from when to when."""

from __future__ import annotations

from airl_mav.core.constants import US_PER_S
from airl_mav.flight.record import EpisodeRecord
from airl_mav.rehearsal.run_folder import EPISODES_FILE, LoadedRun
from airl_mav.report.table import OUTCOME_LABELS, Column, TableView

MAX_LISTED = 60


def faults_table(run: LoadedRun) -> TableView | None:
    """Return the faults that acted, a line each; None where nothing failed."""
    lines = [
        (f"{episode.index}", each.fault, *_span(episode, each.from_us, each.to_us), outcome)
        for episode in run.episodes
        for outcome in (OUTCOME_LABELS[episode.outcome],)
        for each in episode.faults
    ]
    if not lines:
        return None
    notes = ["Simulated time since the start of navigation; negative: before it."]
    if len(lines) > MAX_LISTED:
        notes.append(f"{MAX_LISTED} of {len(lines):,} lines; all: {EPISODES_FILE}.")
    columns = (
        Column("#"),
        Column("fault", number=False),
        Column("from", "s"),
        Column("to", "s"),
        Column("outcome of the flight", number=False),
    )
    return TableView("faults", "Faults", columns, tuple(lines[:MAX_LISTED]), tuple(notes))


def fault_spans_s(episode: EpisodeRecord) -> list[tuple[float, float]]:
    """Return from when to when each fault acted [s since the start of navigation]."""
    zero_us = _zero_us(episode)
    return [
        ((each.from_us - zero_us) / US_PER_S, (each.to_us - zero_us) / US_PER_S)
        for each in episode.faults
    ]


def _zero_us(episode: EpisodeRecord) -> int:
    return episode.started_us if episode.navigation_us is None else episode.navigation_us


def _span(episode: EpisodeRecord, from_us: int, to_us: int) -> tuple[str, str]:
    zero_us = _zero_us(episode)
    return f"{(from_us - zero_us) / US_PER_S:.2f}", f"{(to_us - zero_us) / US_PER_S:.2f}"
