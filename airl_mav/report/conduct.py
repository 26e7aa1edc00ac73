"""Deadlines of a run, and smoothness of its commands and its flight."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from airl_mav.core.constants import MS_PER_S, US_PER_S
from airl_mav.core.errors import UsageError
from airl_mav.flight.judge import Outcome
from airl_mav.flight.smoothness import BANDWIDTH_HZ, command_steps
from airl_mav.flight.statistics import known, successful
from airl_mav.latency.percentiles import percentile
from airl_mav.latency.stages import Samples, deadline_miss_ratio
from airl_mav.policy.registry import find_policy
from airl_mav.rehearsal.run_folder import LoadedRun
from airl_mav.report import measures
from airl_mav.report.arenas import vehicle_of
from airl_mav.report.table import NONE, TOO_FEW_CELL, TableView, columns_of

CONDUCT_NOTE = (
    "Deadline misses: decisions that took effect later than the hold time after their frame was "
    "exposed, or never; of all valid flights, the rest of those that reached the goal. Jerk: "
    f"sampled at 50 Hz, Gaussian low-pass of {BANDWIDTH_HZ:g} Hz; that of the command is its steps "
    "seen through the same filter."
)


@dataclass(frozen=True)
class Budget:
    """Inference budget of a policy at its fastest action."""

    t2_s: float
    """Maximum safe inference time at that speed [s]; negative = the speed is never safe."""
    note: str

    def row(self, t2_us: Samples) -> tuple[str, ...]:
        """Return the share of inference times (n,) [µs] above the budget."""
        ratio = deadline_miss_ratio(t2_us, max(1.0, self.t2_s * US_PER_S))
        told = NONE if ratio is None else f"{100.0 * ratio:.1f} %"
        return "t2 beyond the safe velocity's", told, NONE, f"{t2_us.size:,}"


def _budget(run: LoadedRun) -> Budget | None:
    """Return the budget of a run's policy; None without a known sensing distance."""
    # Imported here, as it loads scipy's solvers, which few policies need.
    from airl_mav.envs.stopping import DecisionLoop, StoppingTask

    try:
        card = find_policy(run.info.config["policy"]).card
        vehicle = vehicle_of(run.info)
    except (KeyError, UsageError):
        return None
    trained = {} if card is None else card.training.config.get("environment", {})
    bound, pilot = trained.get("safe_velocity"), run.info.config.get("pilot")
    if not bound or not pilot:
        return None
    distance_m, speed_m_s = bound["sensing_distance_m"], pilot["max_speed_m_s"]
    task = StoppingTask(vehicle, DecisionLoop.of(vehicle, pilot["hold_s"]), distance_m)
    t2_s = task.inference_budget_s(speed_m_s)
    allowed = f"{MS_PER_S * t2_s:.0f} ms" if t2_s > 0.0 else "none"
    return Budget(
        t2_s,
        f"At {speed_m_s:.2f} m/s, its fastest action, the policy stops for what comes up "
        f"{distance_m:g} m ahead (as on its card) with a t2 of at most: {allowed}.",
    )


def conduct_table(run: LoadedRun, summary: measures.RunSummary) -> TableView | None:
    """Return deadlines and smoothness; None for recordings without these measures."""
    q = summary.quality
    if not any(measure.of(q).n for measure in measures.CONDUCT):
        return None
    reached = [e for e in run.episodes if e.outcome is Outcome.SUCCESS and not e.invalid]
    good = successful(reached)
    command_rms = known(good, "command_jerk_rms_m_s3")
    steps = np.concatenate(
        [np.zeros(0), *(command_steps(run.latency.get(e.index, {})) for e in reached)]
    )
    p95, n = percentile(steps, 95.0), f"{steps.size:,}"
    tail = f"{p95:.2f} m/s" if p95 is not None else TOO_FEW_CELL if steps.size else NONE
    greatest_step = f"{steps.max():.2f} m/s" if steps.size else NONE
    rms = f"{np.mean(command_rms):,.2f} m/s³" if command_rms else NONE

    def mean(measure: measures.QualityMeasure) -> tuple[str, ...]:
        of = measure.of(q)
        interval = NONE if of.low is None else f"{measure.plain(of.low)} … {measure.plain(of.high)}"
        return measure.title, measure.plain(of.value, unit=True), interval, f"{of.n:,}"

    def greatest(title: str, name: str) -> tuple[str, ...]:
        peaks = known(good, name)
        value = f"{max(peaks):,.1f} m/s³" if peaks else NONE
        return title, value, NONE, f"{len(peaks):,}"

    budget = _budget(run)
    rows = (
        mean(measures.DEADLINE_MISSES),
        *(() if budget is None else (budget.row(summary.samples["t2"]),)),
        mean(measures.JERK),
        greatest("jerk, flown, peak", "jerk_peak_m_s3"),
        ("jerk, commanded, RMS", rms, NONE, f"{len(command_rms):,}"),
        greatest("jerk, commanded, peak", "command_jerk_peak_m_s3"),
        mean(measures.COMMAND_STEP),
        ("step of the command, p95", tail, NONE, n),
        ("step of the command, greatest", greatest_step, NONE, n),
    )
    columns = columns_of("<measure | value | 95 % interval | n")
    notes = [CONDUCT_NOTE, *(() if budget is None else (budget.note,))]
    if not summary.timed:
        notes.append(
            f"At level {run.info.setup.level} the companion is no process of its own: it has no "
            "processor time, memory or power."
        )
    return TableView("conduct", "Deadlines and smoothness", columns, rows, tuple(notes))
