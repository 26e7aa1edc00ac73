"""Held-out zone: a policy's success at goals beyond its training distance.

    python scripts/studies/held_out_zone.py [--quick] [--episodes N] [--out DIR] [--config FILE]

The paper trains to its Zone 2 and evaluates in Zone 3, "the region not used during training". Here
a policy trains with goals within a radius, and flies to goals within and beyond it, beside a policy
trained with goals everywhere. The study trains the first with the other's training configuration,
about two minutes on one core, which needs the train extra.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import tomli_w
from common import StudyConfig, StudyOptions, find_or_train, rate_with_interval, study
from pydantic import Field, create_model
from rich.console import Console

from airl_mav.cli.options import run_command, scenario_of
from airl_mav.cli.shared_options import fly_and_show
from airl_mav.core.fields import quantity
from airl_mav.core.files import replace_file
from airl_mav.core.progress import new_console
from airl_mav.experiments.experiment import Experiment, make_cell
from airl_mav.flight.statistics import aggregate
from airl_mav.profiles.arena import ArenaSpec
from airl_mav.profiles.loading import load_profile
from airl_mav.report.document import Column, TableView, print_table, with_interval
from airl_mav.training.config import TrainingConfig

OPTIONS = create_model("Options", __base__=StudyOptions, __doc__=__doc__)


class HeldOutConfig(StudyConfig):
    radius_m: float = quantity("greatest distance of the goals that are learned", "m", gt=0)
    training: str = Field(description="training configuration that made the scenario's policy")
    steps: int | None = quantity("decisions to train", "1", ge=1, default=None)


def write_toml(path: Path, content: dict[str, Any]) -> str:
    """Write a profile; return its path."""
    path.parent.mkdir(parents=True, exist_ok=True)
    replace_file(path, tomli_w.dumps(content).encode())
    return str(path)


def zones(config: HeldOutConfig, root: Path) -> dict[str, str]:
    """Write the configured arena with its goals within and beyond the radius."""
    spec = load_profile("arenas", config.arena, ArenaSpec)
    plain = spec.model_dump(mode="json", exclude_none=True)
    within = plain | {"zones_m": [config.radius_m]}
    goal = plain["goal"] | {"min_distance_m": config.radius_m}
    beyond = plain | {"goal": goal, "zones_m": [z for z in spec.zones_m if z > config.radius_m]}
    return {
        "within": write_toml(root / "within.toml", within),
        "beyond": write_toml(root / "beyond.toml", beyond),
    }


def train_within(config: HeldOutConfig, arena: str, root: Path, console: Console) -> str:
    """Train with the goals of an arena; return the policy."""
    learned = load_profile("training", config.training, TrainingConfig)
    plain = learned.model_dump(mode="json", exclude_none=True, exclude_defaults=True)
    plain["environment"] = plain.get("environment", {}) | {"arena": arena}
    training = write_toml(root / "training.toml", plain)
    return find_or_train("held-out-zone", root, console, training, config.steps)


def run(options: StudyOptions, console: Console | None = None) -> int:
    console = console or new_console()
    with study(options, HeldOutConfig, __file__) as (config, root):
        arenas = zones(config, root)
        learned = {
            f"learned within {config.radius_m:g} m": train_within(
                config, arenas["within"], root, console
            ),
            "learned everywhere": config.policy,
        }
        rows = []
        for zone, arena in arenas.items():
            cells = tuple(
                make_cell(
                    "near" if k == 0 else "everywhere",
                    f"{title}, goals {zone}",
                    scenario_of(config, policy=policy, arena=arena),
                    label=title,
                )
                for k, (title, policy) in enumerate(learned.items())
            )
            what = {"what": f"goals {zone} {config.radius_m:g} m"}
            experiment = Experiment("compare", "held out zone", what, cells)
            code, flown = fly_and_show(experiment, root / zone, console)
            if code:
                return code
            for cell in flown.cells:
                found = aggregate(cell.episodes)
                flights = with_interval(found.flight_time_s, 2), with_interval(found.distance_m, 1)
                row = f"{zone} {config.radius_m:g} m", cell.cell.label
                rows.append((*row, rate_with_interval(found.success_rate), *flights))
    columns = (
        *(Column("goals", number=False), Column("policy", number=False)),
        *(Column("success", "%"), Column("flight time", "s"), Column("distance", "m")),
    )
    table = ("held-out-zone", "Goals farther off than any that was learned", columns, tuple(rows))
    print_table(TableView(*table, (), in_terminal="stacked"), console, wrap=True)
    return 0


if __name__ == "__main__":
    run_command(Path(__file__).name, __name__)
