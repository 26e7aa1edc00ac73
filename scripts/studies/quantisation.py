"""Quantisation: comparison of a policy in 8-bit integers and in floats.

    python scripts/studies/quantisation.py [--quick] [--episodes N] [--out DIR] [--config FILE]

Each policy is exported with `airl export --int8` into the study's folder and flown beside the float
policy, in its training arena, on the same seeds and with the same latency: one comparison for each,
in a separate folder. `airl profile` measures the speed-up on a computer.
"""

from __future__ import annotations

from pathlib import Path

from common import StudyConfig, StudyOptions, study
from pydantic import Field, create_model
from rich.console import Console

from airl_mav.addons.int8.quantisation import export_int8
from airl_mav.cli.options import run_command, scenario_of
from airl_mav.cli.shared_options import fly_and_show
from airl_mav.core.errors import UsageError
from airl_mav.core.progress import new_console
from airl_mav.experiments.evaluate import training_arena
from airl_mav.experiments.experiment import Experiment, make_cell
from airl_mav.policy.card import CARD_FILE
from airl_mav.policy.registry import find_policy
from airl_mav.scenario.model import Scenario

OPTIONS = create_model("Options", __base__=StudyOptions, __doc__=__doc__)


class QuantisationConfig(StudyConfig):
    policies: tuple[str, ...] = Field(min_length=1, description="learned policies, in floats")


def declare(scenario: Scenario, policy: str, integers: Path) -> Experiment:
    """Declare a policy in floats and in integers."""
    flown = {"floats": policy, "int8": str(integers)}
    cells = tuple(
        make_cell(
            name, f"{policy}, {name}", scenario.model_copy(update={"policy": path}), label=name
        )
        for name, path in flown.items()
    )
    return Experiment("compare", f"{policy}-int8", {"what": f"{policy} in 8-bit integers"}, cells)


def run(options: StudyOptions, console: Console | None = None) -> int:
    console = console or new_console()
    with study(options, QuantisationConfig, __file__) as (config, root):
        for policy in config.policies:
            found, integers = find_policy(policy), root / "policies" / f"{Path(policy).name}-int8"
            if found.folder is None:
                raise UsageError(f"policies: {policy}: accepted: learned policies")
            if not (integers / CARD_FILE).exists():
                export_int8(found.folder, integers)
            scenario = scenario_of(config, policy=policy, arena=training_arena(found))
            experiment = declare(scenario, policy, integers)
            code, _ = fly_and_show(experiment, root / Path(policy).name, console)
            if code:
                return code
    return 0


if __name__ == "__main__":
    run_command(Path(__file__).name, __name__)
