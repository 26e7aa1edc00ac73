"""Measures for the comparison of runs, their estimates as text, deadlines and smoothness."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from airl_mav.core import constants, errors
from airl_mav.flight import judge, statistics, trajectory
from airl_mav.flight.statistics import (
    Aggregate,
    Change,
    Estimate,
    PairedComparison,
    known,
    successful,
)
from airl_mav.latency.stages import (
    ALL_STAGES,
    SETPOINT_TO_MOTOR,
    SHOWN_STAGES,
    Samples,
    Stage,
    Summary,
    deadline_miss_ratio,
    percentile,
    pool,
    stage_samples,
    summarize,
)
from airl_mav.policy.registry import find_policy
from airl_mav.rehearsal.run_folder import LoadedRun, vehicle_of
from airl_mav.report.document import NONE, TOO_FEW_CELL, TableView, columns_of, with_interval

MANY_FLIGHTS = 100
"""Number of flights from which rates have a decimal."""

S_PER_MIN = 60.0


@dataclass(frozen=True)
class QualityMeasure:
    """Measure of flight quality."""

    key: Literal[
        "success_rate",
        "flight_time_s",
        "distance_m",
        "energy_j",
        "computer_energy_j",
        "total_energy_j",
        "mean_speed_m_s",
        "endurance_s",
        "range_m",
        "missions_per_charge",
        "deadline_misses",
        "jerk_rms_m_s3",
        "command_step_m_s",
    ]
    """Field in an `Aggregate`; the first six are also fields of a `PairedComparison`."""
    title: str
    unit: str
    scale: float
    """Factor from the unit of the field to the displayed unit."""
    digits: int
    difference_unit: str = "%"

    @property
    def headline(self) -> str:
        """Title of the measure as a headline: a rate, or a median."""
        return self.title if self.difference_unit == "points" else f"{self.title}, median"

    def of(self, quality: Aggregate) -> Estimate:
        """Return the measure of a run."""
        estimate: Estimate = getattr(quality, self.key)
        return estimate

    def change(self, paired: PairedComparison) -> Change:
        """Return the measure of a paired comparison."""
        change: Change = getattr(paired, self.key)
        return change

    def plain(self, value: float | None, *, unit: bool = False) -> str:
        """Return a value in the displayed unit."""
        if value is None:
            return NONE
        return f"{self.scale * value:,.{self.digits}f}{f' {self.unit}' if unit else ''}".rstrip()

    def interval(self, estimate: Estimate) -> str:
        """Return the 95 % interval of an estimate in the displayed unit."""
        if estimate.low is None:
            return NONE
        return f"{self.plain(estimate.low)} … {self.plain(estimate.high)}"

    def with_interval(self, quality: Aggregate) -> str:
        """Return the measure of a run in the displayed unit, with its 95 % interval in brackets."""
        return with_interval(self.of(quality).scaled(self.scale), self.digits)


SUCCESS_RATE = QualityMeasure("success_rate", "success rate", "%", 100.0, 1, "points")
FLIGHT_TIME = QualityMeasure("flight_time_s", "flight time", "s", 1.0, 2)
DISTANCE = QualityMeasure("distance_m", "distance", "m", 1.0, 2)
ENERGY = QualityMeasure("energy_j", "energy, vehicle", "kJ", 1e-3, 2)
COMPUTER_ENERGY = QualityMeasure("computer_energy_j", "energy, computer", "kJ", 1e-3, 2)
MEAN_SPEED = QualityMeasure("mean_speed_m_s", "mean speed", "m/s", 1.0, 2)
TOTAL_ENERGY = QualityMeasure("total_energy_j", "energy, both", "kJ", 1e-3, 2)
ENDURANCE = QualityMeasure("endurance_s", "endurance", "min", 1.0 / S_PER_MIN, 1)
RANGE = QualityMeasure("range_m", "range", "km", 1e-3, 2)
MISSIONS = QualityMeasure("missions_per_charge", "missions per charge", "", 1.0, 1)

DEADLINE_MISSES = QualityMeasure("deadline_misses", "deadline misses", "%", 100.0, 1, "points")
JERK = QualityMeasure("jerk_rms_m_s3", "jerk, flown, RMS", "m/s³", 1.0, 2)
COMMAND_STEP = QualityMeasure("command_step_m_s", "step of the command, mean", "m/s", 1.0, 2)

CONDUCT = (DEADLINE_MISSES, JERK, COMMAND_STEP)
"""Measures of deadlines and smoothness; empty for runs recorded without them."""

PACK = (ENDURANCE, RANGE, MISSIONS)
"""Measures of a full charge; empty for runs recorded without them."""

MEASURES = (SUCCESS_RATE, FLIGHT_TIME, DISTANCE, ENERGY)
ALL_MEASURES = (*MEASURES, COMPUTER_ENERGY, TOTAL_ENERGY)


def rate_digits(rate: Estimate) -> int:
    """Return the decimals of a rate in percent, so that a single flight is visible."""
    return 1 if rate.n >= MANY_FLIGHTS else 0


def count_successes(n: int) -> str:
    """Return "3 common successes"."""
    return f"{n:,} common success" if n == 1 else f"{n:,} common successes"


MODELLED_STAGES = tuple(
    SETPOINT_TO_MOTOR if stage.key == "link" else stage
    for stage in SHOWN_STAGES
    if stage.key not in ("send", "control")
)
"""Stages at level gym: no send time; link and control are one stage."""


@dataclass(frozen=True)
class RunSummary:
    """Data of a report's tables."""

    stages: dict[str, Summary]
    samples: dict[str, Samples]
    """Raw durations of the stages [µs]."""
    quality: statistics.Aggregate
    means: dict[str, float]
    """Means over the flights of `quality`, by its fields."""
    modelled: bool
    """True if times come from a model instead of measurements: level gym."""
    timed: bool
    """True if flights ran in wall time: neither gym nor lockstep."""

    @property
    def shown_stages(self) -> tuple[Stage, ...]:
        """Stages of the latency table; at level gym, the stages of its model."""
        if not self.modelled:
            return SHOWN_STAGES
        return tuple(stage for stage in MODELLED_STAGES if self.stages[stage.key].n)


def summarize_run(run: LoadedRun) -> RunSummary:
    """Compute the summary of a run."""
    samples = pool(stage_samples(stamps) for stamps in run.latency.values())
    stages = {stage.key: summarize(samples[stage.key]) for stage in ALL_STAGES}
    good = statistics.successful(run.episodes)
    return RunSummary(
        stages=stages,
        samples=samples,
        quality=statistics.aggregate(run.episodes),
        means={
            name: float(np.mean(values))
            for name in statistics.OF_SUCCESSES
            if (values := statistics.known(good, name))
        },
        modelled=run.info.setup.level == "gym",
        timed=run.info.setup.level not in ("gym", "lockstep"),
    )


CONDUCT_NOTE = (
    "Deadline misses: decisions that took effect later than the hold time after their frame was "
    "exposed, or never; the mean of all valid flights, with an interval of at least 95 %. The "
    "rest: medians of the flights that reached the goal. Jerk: "
    f"sampled at 50 Hz, Gaussian low-pass of {trajectory.BANDWIDTH_HZ:g} Hz; that of the command "
    "is its steps seen through the same filter."
)


@dataclass(frozen=True)
class Budget:
    """Inference budget of a policy at its fastest action."""

    t2_s: float
    """Maximum safe inference time at that speed [s]; negative = the speed is never safe."""
    note: str

    def row(self, t2_us: Samples) -> tuple[str, ...]:
        """Return the share of inference times (n,) [µs] above the budget."""
        ratio = deadline_miss_ratio(t2_us, max(1.0, self.t2_s * constants.US_PER_S))
        told = NONE if ratio is None else f"{100.0 * ratio:.1f} %"
        return "t2 beyond the safe velocity's", told, NONE, f"{t2_us.size:,}"


def _budget(run: LoadedRun) -> Budget | None:
    """Return the budget of a run's policy; None without a known sensing distance."""
    # Imported here, as it loads scipy's solvers, which few policies need.
    from airl_mav.envs.stopping import DecisionLoop, StoppingTask

    try:
        card = find_policy(run.info.config["policy"]).card
        vehicle = vehicle_of(run.info)
    except (KeyError, errors.UsageError):
        return None
    trained = {} if card is None else card.training.config.get("environment", {})
    bound, pilot = trained.get("safe_velocity"), run.info.config.get("pilot")
    if not bound or not pilot:
        return None
    distance_m, speed_m_s = bound["sensing_distance_m"], pilot["max_speed_m_s"]
    task = StoppingTask(vehicle, DecisionLoop.of(vehicle, pilot["hold_s"]), distance_m)
    t2_s = task.inference_budget_s(speed_m_s)
    allowed = f"{constants.MS_PER_S * t2_s:.0f} ms" if t2_s > 0.0 else "none"
    return Budget(
        t2_s,
        f"At {speed_m_s:.2f} m/s, its fastest action, the policy stops for what comes up "
        f"{distance_m:g} m ahead (as on its card) with a t2 of at most: {allowed}.",
    )


def conduct_table(run: LoadedRun, summary: RunSummary) -> TableView | None:
    """Return deadlines and smoothness; None for recordings without these measures."""
    q = summary.quality
    if not any(measure.of(q).n for measure in CONDUCT):
        return None
    reached = [e for e in run.episodes if e.outcome is judge.Outcome.SUCCESS and not e.invalid]
    good = successful(reached)
    command_rms = statistics.median_of(known(good, "command_jerk_rms_m_s3"))
    steps = np.concatenate(
        [np.zeros(0), *(trajectory.command_steps(run.latency.get(e.index, {})) for e in reached)]
    )
    p95, n = percentile(steps, 95.0), f"{steps.size:,}"
    tail = f"{p95:.2f} m/s" if p95 is not None else TOO_FEW_CELL if steps.size else NONE
    greatest_step = f"{steps.max():.2f} m/s" if steps.size else NONE

    def row(
        measure: QualityMeasure, title: str = "", estimate: Estimate | None = None
    ) -> tuple[str, ...]:
        of = estimate or measure.of(q)
        value = measure.plain(of.value, unit=True)
        return title or measure.title, value, measure.interval(of), f"{of.n:,}"

    def greatest(title: str, name: str) -> tuple[str, ...]:
        peaks = known(good, name)
        value = f"{max(peaks):,.1f} m/s³" if peaks else NONE
        return title, value, NONE, f"{len(peaks):,}"

    budget = _budget(run)
    rows = (
        row(DEADLINE_MISSES),
        *(() if budget is None else (budget.row(summary.samples["t2"]),)),
        row(JERK),
        greatest("jerk, flown, peak", "jerk_peak_m_s3"),
        row(JERK, "jerk, commanded, RMS", command_rms),
        greatest("jerk, commanded, peak", "command_jerk_peak_m_s3"),
        row(COMMAND_STEP),
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
