"""The measures that runs are compared in, and estimates of them as text."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from airl_mav.flight import statistics
from airl_mav.flight.paired import Change, PairedComparison
from airl_mav.flight.statistics import Aggregate, Estimate
from airl_mav.latency.percentiles import Summary, summarize
from airl_mav.latency.stages import (
    ALL_STAGES,
    SETPOINT_TO_MOTOR,
    SHOWN_STAGES,
    Samples,
    Stage,
    pool,
    stage_samples,
)
from airl_mav.rehearsal.run_folder import LoadedRun
from airl_mav.report.table import NONE

FEW_FLIGHTS = 10
"""Below this a bootstrap interval covers clearly less than its 95 %."""

MANY_FLIGHTS = 100
"""From here on rates have a decimal."""

S_PER_MIN = 60.0


@dataclass(frozen=True)
class Measure:
    """A measure of the quality of flight."""

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
    """Its field in an `Aggregate`; of the first six, also in a `PairedComparison`."""
    title: str
    unit: str
    scale: float
    """From the unit of the field to the shown one."""
    digits: int
    difference_unit: str = "%"

    def of(self, quality: Aggregate) -> Estimate:
        """Return the measure of a run."""
        estimate: Estimate = getattr(quality, self.key)
        return estimate

    def change(self, paired: PairedComparison) -> Change:
        """Return the measure of a paired comparison."""
        change: Change = getattr(paired, self.key)
        return change

    def plain(self, value: float | None, *, unit: bool = False) -> str:
        """Return a value in the shown unit."""
        if value is None:
            return NONE
        return f"{self.scale * value:,.{self.digits}f}{f' {self.unit}' if unit else ''}".rstrip()

    def with_interval(self, quality: Aggregate) -> str:
        """Return the measure of a run in the shown unit, its 95 % interval in brackets."""
        return with_interval(self.of(quality).scaled(self.scale), self.digits)


SUCCESS_RATE = Measure("success_rate", "success rate", "%", 100.0, 1, "points")
FLIGHT_TIME = Measure("flight_time_s", "flight time", "s", 1.0, 2)
DISTANCE = Measure("distance_m", "distance", "m", 1.0, 2)
ENERGY = Measure("energy_j", "energy, vehicle", "kJ", 1e-3, 2)
COMPUTER_ENERGY = Measure("computer_energy_j", "energy, computer", "kJ", 1e-3, 2)
MEAN_SPEED = Measure("mean_speed_m_s", "mean speed", "m/s", 1.0, 2)
TOTAL_ENERGY = Measure("total_energy_j", "energy, both", "kJ", 1e-3, 2)
ENDURANCE = Measure("endurance_s", "endurance", "min", 1.0 / S_PER_MIN, 1)
RANGE = Measure("range_m", "range", "km", 1e-3, 2)
MISSIONS = Measure("missions_per_charge", "missions per charge", "", 1.0, 1)

DEADLINE_MISSES = Measure("deadline_misses", "deadline misses", "%", 100.0, 1, "points")
JERK = Measure("jerk_rms_m_s3", "jerk, flown, RMS", "m/s³", 1.0, 2)
COMMAND_STEP = Measure("command_step_m_s", "step of the command, mean", "m/s", 1.0, 2)

CONDUCT = (DEADLINE_MISSES, JERK, COMMAND_STEP)
"""Deadlines and smoothness. Runs that were recorded without have none of these."""

PACK = (ENDURANCE, RANGE, MISSIONS)
"""Runs that were recorded without have none of these."""

MEASURES = (SUCCESS_RATE, FLIGHT_TIME, DISTANCE, ENERGY)
ALL_MEASURES = (*MEASURES, COMPUTER_ENERGY, TOTAL_ENERGY)


def with_interval(estimate: Estimate, digits: int = 1, sign: str = "") -> str:
    """Return an estimate with its 95 % interval in brackets; `sign` is "+" for differences."""
    if estimate.value is None:
        return NONE
    form = f"{sign}.{digits}f"
    text = f"{estimate.value:{form}}"
    if estimate.low is not None and estimate.high is not None:
        text += f" [{estimate.low:{form}}, {estimate.high:{form}}]"
    return text


def interval_of(estimate: Estimate, digits: int, sign: str = "") -> str:
    """Return the 95 % interval alone; empty where there is none."""
    if estimate.low is None or estimate.high is None:
        return ""
    form = f"{sign}.{digits}f"
    return f"{estimate.low:{form}} … {estimate.high:{form}}"


def rate_digits(rate: Estimate) -> int:
    """Return the decimals of a rate in percent: one flight more or less shows."""
    return 1 if rate.n >= MANY_FLIGHTS else 0


def rate_with_interval(rate: Estimate) -> str:
    """Return a rate in percent with its interval in brackets."""
    return with_interval(rate.scaled(100.0), rate_digits(rate))


def count_successes(n: int) -> str:
    """Return "3 common successes"."""
    return f"{n:,} common success" if n == 1 else f"{n:,} common successes"


MODELLED_STAGES = tuple(
    SETPOINT_TO_MOTOR if stage.key == "link" else stage
    for stage in SHOWN_STAGES
    if stage.key not in ("send", "control")
)
"""Level gym sends in no time, and has link and control in one."""


@dataclass(frozen=True)
class RunSummary:
    """Everything that a report's tables say."""

    stages: dict[str, Summary]
    samples: dict[str, Samples]
    """Raw durations behind them [µs]."""
    quality: statistics.Aggregate
    medians: dict[str, statistics.Estimate]
    """Of the same flights as the means of `quality`, by its field."""
    modelled: bool
    """Times come from a model and were not measured: level gym."""
    timed: bool
    """The flights lived by the wall clock: not gym, not lockstep."""

    @property
    def shown_stages(self) -> tuple[Stage, ...]:
        """The stages of the latency table: at level gym those that its model has."""
        if not self.modelled:
            return SHOWN_STAGES
        return tuple(stage for stage in MODELLED_STAGES if self.stages[stage.key].n)


def summarize_run(run: LoadedRun) -> RunSummary:
    """Work out the figures of a run."""
    samples = pool(stage_samples(stamps) for stamps in run.latency.values())
    stages = {stage.key: summarize(samples[stage.key]) for stage in ALL_STAGES}
    good = statistics.successful(run.episodes)
    return RunSummary(
        stages=stages,
        samples=samples,
        quality=statistics.aggregate(run.episodes),
        medians={
            name: statistics.median_of(statistics.known(good, name)) for name in statistics.AVERAGED
        },
        modelled=run.info.setup.level == "gym",
        timed=run.info.setup.level not in ("gym", "lockstep"),
    )
