"""Degradation: cost of latency added to every decision of a policy.

    python scripts/studies/degradation.py [--quick] [--episodes N] [--out DIR] [--config FILE]

The paper (VI.C) slows its Static Obstacles policy on a Core i9 by sleep, to 150 and 300 ms, and
draws its trajectories with a fixed goal. This study flies policies at growing latencies on the same
seeds, shows the cost of every step, and repeats the flights to one goal.
"""

from __future__ import annotations

from pathlib import Path

from common import OneGoal, StudyConfig, StudyOptions, fly, study
from pydantic import Field, create_model
from rich.console import Console

from airl_mav.cli.options import run_command, scenario_of
from airl_mav.core.progress import new_console
from airl_mav.experiments.evaluate import LATENCIES, declare_latency_sweep
from airl_mav.experiments.experiment import Experiment
from airl_mav.scenario.model import Scenario

OPTIONS = create_model("Options", __base__=StudyOptions, __doc__=__doc__)


class DegradationConfig(StudyConfig):
    policies: tuple[str, ...] = Field(min_length=1, description="names, or paths to folders")
    latencies: tuple[str, ...] = Field(default=LATENCIES, description="t2, growing")
    one_goal: OneGoal | None = Field(default=None, description="flights to one goal")


def run(options: StudyOptions, console: Console | None = None) -> int:
    with study(options, DegradationConfig, __file__) as (config, root):

        def declare(scenario: Scenario) -> Experiment:
            return declare_latency_sweep(scenario, config.latencies, config.policies)

        return fly(declare, scenario_of(config), config.one_goal, root, console or new_console())


if __name__ == "__main__":
    run_command(Path(__file__).name, __name__)
