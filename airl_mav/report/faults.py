"""The faults of a run: which acted in which flight, from when to when."""

from __future__ import annotations

from airl_mav.core.constants import US_PER_S
from airl_mav.flight.record import EpisodeRecord
from airl_mav.rehearsal.run_folder import EPISODES_FILE, LoadedRun
from airl_mav.report.table import OUTCOME_LABELS, TableView, columns_of

MAX_LISTED = 60


def faults_table(run: LoadedRun) -> TableView | None:
    """Return the faults that acted, a line each; None where nothing failed."""
    lines = [
        (f"{e.index}", acted.fault, f"{from_s:.2f}", f"{to_s:.2f}", OUTCOME_LABELS[e.outcome])
        for e in run.episodes
        for acted, (from_s, to_s) in zip(e.faults, fault_spans_s(e), strict=True)
    ]
    if not lines:
        return None
    notes = ["Simulated time since the start of navigation; negative: before it."]
    if len(lines) > MAX_LISTED:
        notes.append(f"{MAX_LISTED} of {len(lines):,} lines; all: {EPISODES_FILE}.")
    columns = columns_of("# | <fault | from [s] | to [s] | <outcome of the flight")
    return TableView("faults", "Faults", columns, tuple(lines[:MAX_LISTED]), tuple(notes))


def fault_spans_s(episode: EpisodeRecord) -> list[tuple[float, float]]:
    """Return from when to when each fault acted [s since the start of navigation]."""
    zero_us = episode.zero_us
    return [
        ((each.from_us - zero_us) / US_PER_S, (each.to_us - zero_us) / US_PER_S)
        for each in episode.faults
    ]
