"""`airl latency-sweep`: the same policies at increasing latencies."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import Field
from rich.console import Console

from airl_mav.cli.options import POSITIONAL, scenario_of
from airl_mav.cli.shared_options import ExperimentOptions, Gate, episodes, fly_and_show
from airl_mav.core.fields import COMMON
from airl_mav.experiments.evaluate import LATENCIES, declare_latency_sweep
from airl_mav.scenario.model import DEFAULT_ARENA, DEFAULT_POLICY, ArenaName


class LatencySweepOptions(Gate, ExperimentOptions):
    """Fly policies at increasing latencies on the same seeds, and draw performance curves.

    The same --out resumes an interrupted run.

    Examples:
        airl latency-sweep
        airl latency-sweep static-obstacles static-obstacles-ras-pi-4 --latencies native 200ms 400ms
        airl latency-sweep --compensated
        airl latency-sweep MINE --level lockstep --episodes 100
    """

    policies: Annotated[tuple[str, ...], POSITIONAL] = Field(
        default=(DEFAULT_POLICY,),
        description="names, or paths to folders with policy.onnx and card.json",
    )
    latencies: Annotated[tuple[str, ...], COMMON, "latency"] = Field(
        default=LATENCIES,
        description="sources of t2 as latency takes them, growing; native: none injected; the first"
        " is the reference",
    )
    compensated: Annotated[bool, COMMON, "latency"] = Field(
        default=False,
        description="also fly each policy with compensated latency, as a separate curve",
    )
    arena: ArenaName = DEFAULT_ARENA
    episodes: int = episodes("episodes at each latency", 300)
    out: Annotated[Path | None, COMMON, "output"] = Field(
        default=None,
        description="folder of the curve: a run folder for each latency, latency-sweep.json and"
        " latency-sweep.html; by default runs/<UTC time>-latency-sweep-<policies>",
    )


OPTIONS = LatencySweepOptions


def run(options: LatencySweepOptions, console: Console | None = None) -> int:
    """Fly all latencies and show the results; exit status and errors as in `fly_and_show`."""
    scenario = scenario_of(options, policy=options.policies[0] if options.policies else None)
    experiment = declare_latency_sweep(
        scenario, options.latencies, options.policies, compensated=options.compensated
    )
    code, _ = fly_and_show(experiment, options.out, console, options, options)
    return code
