"""Mitigation: a policy trained with the onboard computer's latency.

    python scripts/studies/mitigation.py [--quick] [--episodes N] [--out DIR] [--config FILE]

The paper (VII.B) trains its Static Obstacles policy with the latency of a Raspberry Pi 4 and
compares it there with a policy trained without latency. This study measures the hardware gap
without and with mitigation, against both references, and repeats the flights to one goal. Missing
policies are trained first, by the training configurations of their names.
"""

from __future__ import annotations

from pathlib import Path

from common import OneGoal, StudyConfig, StudyOptions, find_or_train, fly, study
from pydantic import Field, create_model
from rich.console import Console

from airl_mav.cli.options import run_command, scenario_of
from airl_mav.core.fields import quantity
from airl_mav.core.progress import new_console
from airl_mav.experiments.experiment import Experiment
from airl_mav.experiments.hardware_gap import DEFAULT_MITIGATED, declare_hardware_gap
from airl_mav.scenario.model import REFERENCE_COMPUTER, Scenario

OPTIONS = create_model("Options", __base__=StudyOptions, __doc__=__doc__)


class MitigationConfig(StudyConfig):
    mitigated: str = Field(default=DEFAULT_MITIGATED, description="a name, or a path to a folder")
    reference: str = Field(default=REFERENCE_COMPUTER, description="computer of the reference")
    training: dict[str, str] = Field(
        default={}, description="training configuration by policy, where it is not of its name"
    )
    training_steps: int | None = quantity("decisions to train", "1", ge=1, default=None)
    one_goal: OneGoal | None = Field(default=None, description="flights to one goal")


def run(options: StudyOptions, console: Console | None = None) -> int:
    console = console or new_console()
    with study(options, MitigationConfig, __file__) as (config, root):
        policy, mitigated = (
            find_or_train(name, root, console, config.training.get(name), config.training_steps)
            for name in (config.policy, config.mitigated)
        )

        def declare(scenario: Scenario) -> Experiment:
            return declare_hardware_gap(scenario, mitigated=mitigated, reference=config.reference)

        return fly(declare, scenario_of(config, policy=policy), config.one_goal, root, console)


if __name__ == "__main__":
    run_command(Path(__file__).name, __name__)
