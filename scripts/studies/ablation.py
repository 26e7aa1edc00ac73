"""Sensor ablation: a policy's need for each of its inputs.

    python scripts/studies/ablation.py [--quick] [--episodes N] [--out DIR] [--config FILE]

The paper (V.D) sets depth, velocity and position to zero, one by one and without new training. This
study does the same with policies of our `body` layout and of the paper's layout, each in its
training arena: one comparison for each, in a separate folder. No policy of the paper's layout is
built in: those are trained first, about two minutes each on one core, which needs the train extra.
"""

from __future__ import annotations

from pathlib import Path

from common import StudyConfig, StudyOptions, find_or_train, rate_with_interval, study
from pydantic import Field, create_model
from rich.console import Console

from airl_mav.cli.options import run_command, scenario_of
from airl_mav.cli.shared_options import fly_and_show
from airl_mav.core.fields import ProfileModel, quantity
from airl_mav.core.progress import new_console
from airl_mav.experiments.experiment import Experiment, make_cell
from airl_mav.flight.statistics import aggregate
from airl_mav.policy.registry import find_policy
from airl_mav.profiles.loading import load_published
from airl_mav.report.document import NONE, Column, TableView, print_table
from airl_mav.scenario.model import Scenario

OPTIONS = create_model("Options", __base__=StudyOptions, __doc__=__doc__)

INPUTS = {"none": "all inputs", "velocity": "no velocity", "goal": "no goal", "depth": "no depth"}
"""Zeroed inputs and the names of their runs; the paper calls the goal "position"."""


class PolicyConfig(ProfileModel):
    arena: str = Field(description="arena profile")
    policy: str = Field(description="a name, or a path to a folder; trained where it is not there")
    training: str | None = Field(default=None, description="by default the policy's name")
    steps: int | None = quantity("decisions to train", "1", ge=1, default=None)


class AblationConfig(StudyConfig):
    policies: tuple[PolicyConfig, ...] = Field(
        min_length=1, description="policy and arena of each flight"
    )


def declare(scenario: Scenario, title: str) -> Experiment:
    """Declare a policy with all inputs and without each."""
    flown = {name: scenario.model_copy(update={"ablate": name}) for name in INPUTS}
    flown["none"] = scenario
    cells = tuple(
        make_cell(k, f"{title}, {label}", flown[k], label=label) for k, label in INPUTS.items()
    )
    return Experiment("compare", "ablation", {"what": title}, cells)


def run(options: StudyOptions, console: Console | None = None) -> int:
    console, rows = console or new_console(), []
    with study(options, AblationConfig, __file__) as (config, root):
        for each in config.policies:
            policy = find_or_train(each.policy, root, console, each.training, each.steps)
            card, arena = find_policy(policy).card, Path(each.arena).stem
            layout = NONE if card is None else card.observation.layout
            place = f"{Path(each.policy).name}-in-{arena}"
            scenario = scenario_of(config, policy=policy, arena=each.arena)
            experiment = declare(scenario, f"{each.policy} in {arena}, layout {layout}")
            code, flown = fly_and_show(experiment, root / place, console)
            if code:
                return code
            rates = (aggregate(run.episodes).success_rate for run in flown.cells)
            rows.append((arena, layout, *map(rate_with_interval, rates)))
            if paper := load_published().ablation.get(arena):
                rows.append((arena, "the paper", *(f"{paper.get(z, NONE)}" for z in INPUTS)))
    columns = [Column("arena", number=False), Column("layout", number=False)]
    columns += [Column(label, "%") for label in INPUTS.values()]
    note = "The paper: V.D; for Static Obstacles it has one figure for velocity and position."
    table = ("ablation", "Success without one input", tuple(columns), tuple(sorted({*rows})))
    print_table(TableView(*table, (note,), in_terminal="stacked"), console, wrap=True)
    return 0


if __name__ == "__main__":
    run_command(Path(__file__).name, __name__)
