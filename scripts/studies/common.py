"""Shared parts of the studies: options, configuration, training, flights to one goal.

A configuration is a scenario as TOML with additional fields of the study; `[quick]` contains the
changes of --quick. Every run folder is below --out, and the same --out resumes an interrupted
study.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from pydantic import BaseModel, Field, model_validator
from rich.console import Console

from airl_mav.cli import train_command
from airl_mav.cli.shared_options import fly_and_show
from airl_mav.core.errors import FieldError, UsageError
from airl_mav.core.fields import ProfileModel, quantity, validated
from airl_mav.experiments.experiment import Experiment
from airl_mav.flight.episode_record import EpisodeRecord
from airl_mav.flight.statistics import Estimate, median_of
from airl_mav.flight.trajectory import Trajectory
from airl_mav.policy.registry import find_policy
from airl_mav.profiles.loading import list_profiles, read_toml
from airl_mav.report.document import with_interval
from airl_mav.report.measures import rate_digits
from airl_mav.scenario.model import LevelName, Scenario
from airl_mav.training.config import check_seeds


class StudyOptions(BaseModel):
    config: Path | None = Field(default=None, description="by default the .toml beside the script")
    quick: bool = Field(default=False, description="few episodes: a first look")
    episodes: int | None = quantity("episodes of each run", "1", ge=1, le=100_000, default=None)
    out: Path | None = Field(default=None, description="folder; by default runs/studies/<name>")


class OneGoal(ProfileModel):
    arena_seed: int = quantity("seed of the arena and the goal", "1", ge=0, le=2**31)
    episodes: int = quantity("flights of each run", "1", ge=1, le=10_000, default=100)

    @model_validator(mode="after")
    def _arena_is_not_held_out(self) -> OneGoal:
        check_seeds(self.arena_seed, field="one_goal.arena_seed")
        return self


class StudyConfig(Scenario):
    description: str = Field(default="", description="one line for people")
    level: LevelName = Field(default="gym", description="fidelity level")
    episodes: int = quantity("episodes of each run", "1", ge=1, le=100_000, default=1000)
    quick: dict[str, Any] = Field(default={"episodes": 40}, description="changes by --quick")

    @model_validator(mode="after")
    def _seeds_are_not_held_out(self) -> StudyConfig:
        check_seeds(self.seed, self.episodes)
        if self.arena_seed is not None:
            check_seeds(self.arena_seed, field="arena_seed")
        return self


Config = TypeVar("Config", bound=StudyConfig)
Declare = Callable[[Scenario], Experiment]


@contextmanager
def study(options: StudyOptions, model: type[Config], script: str) -> Iterator[tuple[Config, Path]]:
    """Yield the configuration and the folder; field errors name the configuration's file."""
    path = options.config or Path(script).with_suffix(".toml")
    data = read_toml(path)
    data |= validated(model, data, path).quick if options.quick else {}
    data |= {} if options.episodes is None else {"episodes": options.episodes}
    name = Path(script).stem + ("-quick" if options.quick else "")
    try:
        yield validated(model, data, path), options.out or Path("runs/studies") / name
    except FieldError as error:
        raise UsageError(f"{path}: {error.line(sign=' = ')}") from None


def find_or_train(
    policy: str, root: Path, console: Console, training: str | None = None, steps: int | None = None
) -> str:
    """Return an existing policy, or train it below `root`; a killed training resumes."""
    try:
        find_policy(policy)
        return policy
    except UsageError as error:
        known = training is not None or policy in list_profiles("training")
        if not known or "no such policy" not in str(error):
            raise
    folder, training = root / f"train-{policy}", training or policy
    if not (folder / "policy" / "card.json").exists():
        asked = {"config": training, "out": folder, "steps": steps, "name": policy, "resume": True}
        command = f"airl train {training} --name {policy}" + (f" --steps {steps}" if steps else "")
        if train_command.run(train_command.TrainOptions(**asked), console, command_line=command):
            raise KeyboardInterrupt
    return str(folder / "policy")


def fly(
    declare: Declare, scenario: Scenario, one_goal: OneGoal | None, root: Path, console: Console
) -> int:
    """Fly an experiment, then repeat it to one goal; return the exit status of both."""
    code, _ = fly_and_show(declare(scenario), root, console)
    if code or one_goal is None:
        return code
    one = declare(scenario.model_copy(update=one_goal.model_dump()))
    plain = tuple(replace(cell, label="", role="", group="") for cell in one.cells)
    one = replace(one, kind="compare", cells=plain)
    code, flown = fly_and_show(one, root / "one-goal", console)
    for run in flown.cells:
        paths = flown.runs[run.cell.name].trajectories
        wide = median_of([aside(paths[e.index], e) for e in run.episodes if e.index in paths])
        console.print(f"widest aside {with_interval(wide, 2)} m: {run.cell.title}", soft_wrap=True)
    return code


def aside(path: Trajectory, episode: EpisodeRecord) -> float:
    """Return the maximum distance of a path from the line through start and goal [m]."""
    start_us = episode.zero_us
    north, east = np.array(episode.goal) / np.linalg.norm(episode.goal)
    position = path.between(start_us, episode.ended_us).position
    return float(np.abs(position[:, :2] @ np.array([-east, north])).max(initial=0.0))


def rate_with_interval(rate: Estimate) -> str:
    """Return a rate in percent with its interval in brackets."""
    return with_interval(rate.scaled(100.0), rate_digits(rate))
