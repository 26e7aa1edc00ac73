"""System evaluation: each arena's policy on a workstation and on the onboard computer.

    python scripts/studies/system.py [--quick] [--episodes N] [--out DIR] [--config FILE]

The paper (VI.B) flies the best policy of each of three arenas on a Core i9 and on a Raspberry Pi 4,
and draws trajectories with a fixed goal. This study flies our policy of each arena on the same
seeds, with the latency of the paper's best network of that arena on both computers, shows the
hardware gap of each arena beside the paper's, and repeats the flights to one goal.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

from common import OneGoal, StudyConfig, StudyOptions, fly, study
from pydantic import Field, create_model
from rich.console import Console

from airl_mav.cli.options import run_command, scenario_of
from airl_mav.core.errors import FieldError
from airl_mav.core.fields import ProfileModel
from airl_mav.core.progress import new_console
from airl_mav.experiments.experiment import Experiment
from airl_mav.experiments.hardware_gap import NOT_MITIGATED, declare_hardware_gap
from airl_mav.scenario.model import REFERENCE_COMPUTER, Scenario

OPTIONS = create_model("Options", __base__=StudyOptions, __doc__=__doc__)


class ArenaConfig(ProfileModel):
    arena: str = Field(description="arena profile")
    policy: str = Field(description="a name, or a path to a folder")
    workload: str = Field(description="whose latency both computers have")


class SystemConfig(StudyConfig):
    arenas: tuple[ArenaConfig, ...] = Field(
        min_length=1, description="policy and arena of each flight"
    )
    reference: str = Field(default=REFERENCE_COMPUTER, description="computer of the reference")
    one_goal: OneGoal | None = Field(default=None, description="flights to one goal")


def declare(scenario: Scenario, config: SystemConfig) -> Experiment:
    """Declare the hardware gap of every arena as one experiment."""
    gaps = [
        declare_hardware_gap(
            # The paper does not compensate latency.
            scenario.model_copy(update=each.model_dump() | {"compensate": False}),
            mitigated=NOT_MITIGATED,
            reference=config.reference,
        )
        for each in config.arenas
    ]
    cells = tuple(cell for gap in gaps for cell in gap.cells)
    if len({cell.name for cell in cells}) < len(cells):
        raise FieldError("arenas", [Path(e.arena).stem for e in config.arenas], "each arena once")
    own = ("policy", "workload")
    facts = gaps[0].facts | {f: ", ".join(f"{gap.facts[f]}" for gap in gaps) for f in own}
    facts["reference_workload"] = facts["workload"]
    return Experiment("hardware-gap", "system", facts, cells)


def run(options: StudyOptions, console: Console | None = None) -> int:
    with study(options, SystemConfig, __file__) as (config, root):
        declared = partial(declare, config=config)
        return fly(declared, scenario_of(config), config.one_goal, root, console or new_console())


if __name__ == "__main__":
    run_command(Path(__file__).name, __name__)
