"""The figures of a run, worked out once for every form of the report."""

from __future__ import annotations

from dataclasses import dataclass

from airl_mav.flight import statistics
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
