"""`airl train`: train a policy from a TOML file, to a folder that flies."""

from __future__ import annotations

import shlex
import signal
import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import tyro
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from airl_mav.cli.common import EXIT_INTERRUPTED, check_train_installed
from airl_mav.profiles.loading import load_profile

if TYPE_CHECKING:
    from airl_mav.training.store import Evaluation


@dataclass(frozen=True)
class Train:
    """Train a policy; the best weights are exported as policy.onnx with their card.

    Examples:
      airl train static-obstacles --out runs/mine
      airl train dense-obstacles --computer ras-pi-4 --workload template-5x32 --resume
    """

    config: tyro.conf.Positional[str] = "static-obstacles"
    """Training configuration: a shipped name, or a path to a .toml."""

    out: Path | None = None
    """Folder of the run. None: runs/train-<config>."""

    seed: int | None = None
    """Seed of weights, exploration and episodes. None: the configuration's."""

    computer: str | None = None
    """Decide as late as this computer in training: a shipped profile, or a path to a .toml; takes
    --workload. None: the configuration's."""

    workload: str | None = None
    """Workload of that computer whose latency t2 is drawn in every decision; estimate is not
    accepted: the network is not there yet. None: the configuration's."""

    latency: tuple[str, ...] = ()
    """Sources of t2 in place of computer and workload, as airl evaluate takes them: 150ms,
    lognormal:396ms,20ms, COMPUTER/WORKLOAD, FILE. Of several, each episode draws one: latency
    randomisation over several computers. None given: the configuration's."""

    sensing_distance: float | None = None
    """Scale the actions to the safe velocity: the vehicle, deciding as late as its longest latency,
    stops within so many metres. None: the configuration's, or no scaling."""

    max_acceleration: float | None = None
    """Greatest deceleration for the safe velocity, m/s²; takes --sensing-distance. None: what the
    vehicle's tilt limit and thrust permit."""

    steps: int | None = None
    """Decisions of all vehicles together. None: the configuration's."""

    name: str | None = None
    """Name of the policy on its card. None: the configuration's."""

    resume: bool = False
    """Go on with the run in --out from its newest checkpoint; begin it when there is none."""


def run(command: Train, console: Console | None = None, *, command_line: str | None = None) -> int:
    """Train, export, and print the result; `command_line` is noted on the card.

    Returns the exit status: 0 trained to the end, 130 Ctrl-C. Raises UsageError as
    `airl_mav.training.run.train`.
    """
    from airl_mav.envs.delay import injections_of, speed_bound
    from airl_mav.training.config import TrainingConfig, configured

    console = console or Console()
    show = partial(console.print, soft_wrap=True, highlight=False)
    config = configured(
        load_profile("training", command.config, TrainingConfig),
        seed=command.seed,
        steps=command.steps,
        computer=command.computer,
        workload=command.workload,
        latency=command.latency,
        sensing_distance_m=command.sensing_distance,
        max_acceleration_m_s2=command.max_acceleration,
    )
    bound, injections = speed_bound(config.environment), injections_of(config.environment.delay)
    check_train_installed()
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    # Imported late: the learner takes two seconds to load, and a typo must not wait for it.
    from airl_mav.training.run import train

    stem = Path(command.config).stem
    out = command.out or Path("runs") / f"train-{stem}"
    show(f"training   {stem}: {config.description}")
    for source in injections:
        show(f"latency    {source.label}")
    if bound is not None:
        show(f"speed      {bound.describe()}")
    show(f"folder     {out}")
    show(f"curves     tensorboard --logdir {out / 'tensorboard'}")
    try:
        with TrainingBar(console, config.steps) as bar:
            result = train(
                config,
                out,
                name=command.name or stem,
                resume=command.resume,
                progress=bar,
                command=command_line or shlex.join(["airl", *sys.argv[1:]]),
            )
    except KeyboardInterrupt:
        show(f"interrupted: airl train {command.config} --out {out} --resume continues")
        return EXIT_INTERRUPTED
    best, policy = result.best, result.folder.policy
    rate = f"{best.success_rate:.1%} of {best.episodes} selection episodes"
    show(f"best       {rate} after {best.steps:,} decisions")
    show(f"policy     {policy}")
    show(f"fly it     airl-sitl --policy {policy}")
    return 0


class TrainingBar:
    """A bar with the success rate, a line for every evaluation. A `TrainingProgress`."""

    def __init__(self, console: Console, steps: int) -> None:
        self._console = console
        self._bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(bar_width=24),
            TextColumn("{task.completed:,.0f}/{task.total:,.0f}"),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
            TextColumn("{task.fields[note]}"),
            console=console,
            transient=True,
        )
        self._task = self._bar.add_task("decisions", total=steps, note="")

    def __enter__(self) -> TrainingBar:
        """Start drawing."""
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Stop drawing."""
        self._bar.stop()

    def trained(self, steps: int, success: float | None, zone: int | None) -> None:
        """Draw the bar."""
        note = "" if success is None else f"success {success:.0%} in training"
        note += "" if zone is None else f", zone {zone}"
        self._bar.update(self._task, completed=steps, note=note)

    def evaluated(self, evaluation: Evaluation, *, best: bool) -> None:
        """Print a line."""
        time = "" if evaluation.flight_time_s is None else f"{evaluation.flight_time_s:6.2f} s"
        zone = "" if evaluation.zone is None else f"  zone {evaluation.zone}"
        self._console.print(
            f"{evaluation.steps:>11,} decisions {evaluation.seconds:7.0f} s  success "
            f"{evaluation.success_rate:6.1%}  {time}{zone}{'  best so far' if best else ''}",
            highlight=False,
        )

    def checkpointed(self, steps: int) -> None:
        """Print nothing."""
