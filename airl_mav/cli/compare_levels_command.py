"""`airl compare-levels`: the same policy and seeds at several fidelity levels."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import Field
from rich.console import Console

from airl_mav.cli.options import POSITIONAL, scenario_of
from airl_mav.cli.shared_options import ExperimentOptions, episodes, fly_and_show
from airl_mav.core.fields import COMMON, quantity
from airl_mav.experiments.evaluate import LEVELS, declare_compare_levels, training_arena
from airl_mav.policy.registry import find_policy
from airl_mav.scenario.model import LevelName


class CompareLevelsOptions(ExperimentOptions):
    """Fly the same policy and seeds at several levels of fidelity, and show the differences.

    Prints success, flight time, distance and energy at each level, and the differences from the
    first level on the same seeds with 95 % intervals. The same --out resumes an interrupted run.

    Examples:
        airl compare-levels static-obstacles
        airl compare-levels static-obstacles --levels gym lockstep --episodes 500
    """

    policy: Annotated[str, POSITIONAL] = Field(
        description="a name, or a path to a folder with policy.onnx and card.json"
    )
    arena: Annotated[str | None, COMMON, "arena"] = Field(
        default=None,
        description="arena profile; by default that which the policy was trained in",
    )
    episodes: int = episodes("episodes at each level", 100)
    levels: Annotated[tuple[LevelName, ...], COMMON, "execution"] = Field(
        default=LEVELS, description="levels that fly, two or more; the first is the reference"
    )
    sitl_episodes: Annotated[int | None, COMMON, "execution"] = quantity(
        "episodes at level sitl, which flies in real time times the speed: the first ones of the"
        " seeds; by default 10, or all if they are fewer",
        "1",
        ge=1,
        le=100_000,
        default=None,
    )
    out: Annotated[Path | None, COMMON, "output"] = Field(
        default=None,
        description="folder of the comparison: a run folder for each level, compare-levels.json and"
        " compare-levels.html; by default runs/<UTC time>-compare-levels-<policy>-<arena>",
    )


OPTIONS = CompareLevelsOptions


def run(options: CompareLevelsOptions, console: Console | None = None) -> int:
    """Fly all levels and show the differences; exit status and errors as in `fly_and_show`."""
    policy = find_policy(options.policy, trust=options.trust)
    arena = options.arena or training_arena(policy)
    experiment = declare_compare_levels(
        scenario_of(options, arena=arena), options.levels, sitl_episodes=options.sitl_episodes
    )
    code, _ = fly_and_show(experiment, options.out, console, telling=options)
    return code
