"""How a run kept its deadlines, and how smoothly it was commanded and flew."""

from __future__ import annotations

import numpy as np

from airl_mav.flight.judge import Outcome
from airl_mav.flight.smoothness import BANDWIDTH_HZ, command_steps
from airl_mav.flight.statistics import known, successful
from airl_mav.latency.percentiles import percentile
from airl_mav.rehearsal.run_folder import LoadedRun
from airl_mav.report.measures import COMMAND_STEP, CONDUCT, DEADLINE_MISSES, JERK, Measure
from airl_mav.report.run_summary import RunSummary
from airl_mav.report.table import NONE, TOO_FEW_CELL, Column, TableView

CONDUCT_NOTE = (
    "Deadline misses: decisions that took effect later than the hold time after their frame was "
    "exposed, or never; of all valid flights, the rest of those that reached the goal. Jerk: "
    f"sampled at 50 Hz, Gaussian low-pass of {BANDWIDTH_HZ:g} Hz; that of the command is its steps "
    "seen through the same filter."
)


def conduct_table(run: LoadedRun, summary: RunSummary) -> TableView | None:
    """Return deadlines and smoothness; None of a run that was recorded without them."""
    q = summary.quality
    if not any(measure.of(q).n for measure in CONDUCT):
        return None
    reached = [e for e in run.episodes if e.outcome is Outcome.SUCCESS and not e.invalid]
    good = successful(reached)
    command_rms = known(good, "command_jerk_rms_m_s3")
    steps = np.concatenate(
        [np.zeros(0), *(command_steps(run.latency.get(e.index, {})) for e in reached)]
    )
    p95 = percentile(steps, 95.0)
    n = f"{steps.size:,}"

    def mean(measure: Measure) -> tuple[str, ...]:
        of = measure.of(q)
        interval = NONE if of.low is None else f"{measure.plain(of.low)} … {measure.plain(of.high)}"
        return measure.title, measure.plain(of.value, unit=True), interval, f"{of.n:,}"

    def greatest(title: str, name: str) -> tuple[str, ...]:
        peaks = known(good, name)
        value = f"{max(peaks):,.1f} m/s³" if peaks else NONE
        return title, value, NONE, f"{len(peaks):,}"

    rows = (
        mean(DEADLINE_MISSES),
        mean(JERK),
        greatest("jerk, flown, peak", "jerk_peak_m_s3"),
        (
            "jerk, commanded, RMS",
            f"{np.mean(command_rms):,.2f} m/s³" if command_rms else NONE,
            NONE,
            f"{len(command_rms):,}",
        ),
        greatest("jerk, commanded, peak", "command_jerk_peak_m_s3"),
        mean(COMMAND_STEP),
        (
            "step of the command, p95",
            f"{p95:.2f} m/s" if p95 is not None else TOO_FEW_CELL if steps.size else NONE,
            NONE,
            n,
        ),
        (
            "step of the command, greatest",
            f"{steps.max():.2f} m/s" if steps.size else NONE,
            NONE,
            n,
        ),
    )
    columns = (
        Column("measure", number=False),
        Column("value"),
        Column("95 % interval"),
        Column("n"),
    )
    notes = [CONDUCT_NOTE]
    if not summary.timed:
        notes.append(
            f"At level {run.info.setup.level} the companion is no process of its own: it has no "
            "processor time, memory or power."
        )
    return TableView("conduct", "Deadlines and smoothness", columns, rows, tuple(notes))
