"""`airl train`: train a policy from a TOML file, to a folder that flies."""

from __future__ import annotations

import shlex
import signal
import sys
from pathlib import Path
from typing import NoReturn

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from airl_mav.cli.common import (
    EXIT_INTERRUPTED,
    GREATEST_SEED,
    check_range,
    check_train_installed,
)
from airl_mav.cli.train_command import TrainCommand
from airl_mav.cli.train_environment import environment_of
from airl_mav.envs.delay import bounded, injections_of, speed_bound
from airl_mav.profiles.loading import load_profile
from airl_mav.training.config import TrainingConfig
from airl_mav.training.store import Evaluation, TrainingFolder


def run(command: TrainCommand, console: Console | None = None, *, words: str | None = None) -> int:
    """Train, export, and say what came out.

    Args:
        command: What was asked for.
        console: Where to print; None means standard output.
        words: The command line that makes the policy, for its card; None: that of this process.

    Returns:
        Exit status: 0 trained to the end, 130 Ctrl-C.

    Raises:
        UsageError: The input cannot be used; nothing was trained.
    """
    console = console or Console()
    config = _config(command)
    bound = speed_bound(config.environment)
    config = config.model_copy(update={"environment": bounded(config.environment)})
    check_train_installed()
    stem = Path(command.config).stem
    path = command.out or Path("runs") / f"train-{stem}"
    signal.signal(signal.SIGTERM, _interrupt)
    words = shlex.join(["airl", *sys.argv[1:]]) if words is None else words
    # Imported late: the learner takes two seconds to load, and a typo must not wait for it.
    from airl_mav.training.run import train

    if command.resume and (path / "train.json").exists():
        folder = TrainingFolder.open(path, config)
    else:
        folder = TrainingFolder.create(path, config, words)
    console.print(f"training   {stem}: {config.description}", highlight=False)
    for source in injections_of(config.environment.delay):
        console.print(f"latency    {source.label}", soft_wrap=True, highlight=False)
    if bound is not None:
        console.print(f"speed      {bound.in_words()}", soft_wrap=True, highlight=False)
    console.print(f"folder     {path}", soft_wrap=True, highlight=False)
    console.print(f"curves     tensorboard --logdir {folder.tensorboard}", soft_wrap=True)
    try:
        with folder.locked(), TrainingProgress(console, config.steps) as progress:
            best = train(config, folder, progress)
    except KeyboardInterrupt:
        console.print(
            f"interrupted: airl train {command.config} --out {path} --resume goes on",
            style="yellow",
            soft_wrap=True,
        )
        return EXIT_INTERRUPTED
    from airl_mav.training.result import export_best

    export_best(folder, config, command.name or stem)
    console.print(
        f"best       {best.success_rate:.1%} of {best.episodes} selection episodes after "
        f"{best.steps:,} decisions"
    )
    console.print(f"policy     {folder.policy}", soft_wrap=True, highlight=False)
    console.print(f"fly it     airl-sitl --policy {folder.policy}", soft_wrap=True, highlight=False)
    return 0


def _config(command: TrainCommand) -> TrainingConfig:
    """Load the configuration and put the command line's values into it."""
    config = load_profile("training", command.config, TrainingConfig)
    config = config.model_copy(update={"environment": environment_of(command, config.environment)})
    changes: dict[str, int] = {}
    if command.seed is not None:
        check_range("--seed", command.seed, 0, GREATEST_SEED)
        changes["seed"] = command.seed
    if command.steps is not None:
        check_range("--steps", command.steps, 1, 10**10)
        changes["steps"] = command.steps
    return config.model_copy(update=changes)


class TrainingProgress:
    """A bar with the success rate, a line for every evaluation. A `Watcher`."""

    def __init__(self, console: Console, steps: int) -> None:
        self._console = console
        self._bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(bar_width=24),
            TextColumn("{task.completed:,.0f}/{task.total:,.0f}"),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
            TextColumn("{task.fields[state]}"),
            console=console,
            transient=True,
        )
        self._task = self._bar.add_task("decisions", total=steps, state="")

    def __enter__(self) -> TrainingProgress:
        """Start drawing."""
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Stop drawing."""
        self._bar.stop()

    def progress(self, steps: int, success: float | None, zone: int | None) -> None:
        """Training goes on."""
        state = "" if success is None else f"success {success:.0%} in training"
        if zone is not None:
            state += f", zone {zone}"
        self._bar.update(self._task, completed=steps, state=state)

    def evaluated(self, evaluation: Evaluation, *, best: bool) -> None:
        """An evaluation is done."""
        time = "" if evaluation.flight_time_s is None else f"{evaluation.flight_time_s:6.2f} s"
        zone = "" if evaluation.zone is None else f"  zone {evaluation.zone}"
        self._console.print(
            f"{evaluation.steps:>11,} decisions {evaluation.seconds:7.0f} s  success "
            f"{evaluation.success_rate:6.1%}  {time}{zone}{'  best so far' if best else ''}",
            highlight=False,
        )

    def checkpointed(self, steps: int) -> None:
        """A checkpoint lies on the disk."""


def _interrupt(*_: object) -> NoReturn:
    """Treat SIGTERM like Ctrl-C."""
    raise KeyboardInterrupt
