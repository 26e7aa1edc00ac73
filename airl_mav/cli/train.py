"""`airl train`: train a policy from a TOML file, to a folder that flies."""

from __future__ import annotations

import shlex
import signal
import sys
from functools import partial
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, Field
from rich.console import Console

from airl_mav.cli.options import POSITIONAL
from airl_mav.core.errors import EXIT_INTERRUPTED
from airl_mav.core.progress import RichProgress
from airl_mav.profiles.loading import load_profile
from airl_mav.training.store import Evaluation, TrainingProgress


class TrainOptions(BaseModel):
    """Train a policy; the best weights are exported as policy.onnx with their card.

    Examples:
        airl train static-obstacles --out runs/mine
        airl train dense-obstacles --computer ras-pi-4 --workload template-5x32 --resume
    """

    config: Annotated[str, POSITIONAL] = Field(
        default="static-obstacles",
        description="training configuration: a shipped name, or a path to a .toml",
    )
    out: Path | None = Field(
        default=None, description="folder of the run; by default runs/train-<config>"
    )
    seed: int | None = Field(
        default=None,
        description="seed of weights, exploration and episodes; by default the configuration's",
    )
    computer: str | None = Field(
        default=None,
        description="decide as late as this computer in training: a shipped profile, or a path to"
        " a .toml; takes --workload; by default the configuration's",
    )
    workload: str | None = Field(
        default=None,
        description="workload of that computer whose latency t2 is drawn in every decision",
    )
    latency: tuple[str, ...] = Field(
        default=(),
        description="sources of t2 in place of computer and workload, as airl evaluate takes them:"
        " 150ms, lognormal:396ms,20ms, COMPUTER/WORKLOAD, FILE; of several, each episode draws one",
    )
    sensing_distance_m: float | None = Field(
        default=None,
        description="scale the actions to the safe velocity: the vehicle, deciding as late as its"
        " longest latency, stops within so many metres; by default the configuration's, or not",
    )
    max_acceleration_m_s2: float | None = Field(
        default=None,
        description="greatest deceleration for the safe velocity, m/s²; takes --sensing-distance-m;"
        " by default what the vehicle's tilt limit and thrust permit",
    )
    steps: int | None = Field(
        default=None,
        description="decisions of all vehicles together; by default the configuration's",
    )
    name: str | None = Field(
        default=None, description="name of the policy on its card; by default the configuration's"
    )
    resume: bool = Field(
        default=False,
        description="continue the run in --out from its newest checkpoint; start it if there is"
        " none",
    )


OPTIONS = TrainOptions
RENAMED_OPTIONS = {
    "--sensing-distance": ("--sensing-distance-m",),
    "--max-acceleration": ("--max-acceleration-m-s2",),
}
EXTRAS = ("sim", "train")


def run(
    options: TrainOptions, console: Console | None = None, *, command_line: str | None = None
) -> int:
    """Train, export, and print the result; `command_line` is noted on the card.

    Returns the exit status: 0 trained to the end, 130 Ctrl-C. Raises UsageError as
    `airl_mav.training.run.train`.
    """
    from airl_mav.envs.delay import injections_of, speed_bound
    from airl_mav.training.config import TrainingConfig, configured

    console = console or Console()
    show = partial(console.print, soft_wrap=True, highlight=False)
    config = configured(
        load_profile("training", options.config, TrainingConfig),
        seed=options.seed,
        steps=options.steps,
        computer=options.computer,
        workload=options.workload,
        latency=options.latency,
        sensing_distance_m=options.sensing_distance_m,
        max_acceleration_m_s2=options.max_acceleration_m_s2,
    )
    bound, injections = speed_bound(config.environment), injections_of(config.environment.delay)
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    # Imported late: the learner takes two seconds to load, and a typo must not wait for it.
    from airl_mav.training.run import train

    stem = Path(options.config).stem
    out = options.out or Path("runs") / f"train-{stem}"
    show(f"training   {stem}: {config.description}")
    for source in injections:
        show(f"latency    {source.label}")
    if bound is not None:
        show(f"speed      {bound.describe()}")
    show(f"folder     {out}")
    show(f"curves     tensorboard --logdir {out / 'tensorboard'}")
    try:
        with RichProgress(console) as progress:
            result = train(
                config,
                out,
                name=options.name or stem,
                resume=options.resume,
                progress=TrainingBar(progress, config.steps),
                command=command_line or shlex.join(["airl", *sys.argv[1:]]),
            )
    except KeyboardInterrupt:
        show(f"interrupted: airl train {options.config} --out {out} --resume continues")
        return EXIT_INTERRUPTED
    best, policy = result.best, result.folder.policy
    rate = f"{best.success_rate:.1%} of {best.episodes} selection episodes"
    show(f"best       {rate} after {best.steps:,} decisions")
    show(f"policy     {policy}")
    show(f"fly it     airl-sitl --policy {policy}")
    return 0


class TrainingBar(TrainingProgress):
    """A bar with the success rate, a line for every evaluation. A `TrainingProgress`."""

    def __init__(self, progress: RichProgress, steps: int) -> None:
        self._progress = progress
        self._bar = progress.bar("training", steps, unit="decisions")

    def waiting(self, why: str) -> None:
        """Print a line."""
        self._progress.note(why)

    def trained(self, steps: int, success: float | None, zone: int | None) -> None:
        """Draw the bar."""
        text = "" if success is None else f"success {success:.0%} in training"
        text += "" if zone is None else f", zone {zone}"
        self._bar.update(completed=steps, postfix=text)

    def evaluated(self, evaluation: Evaluation, *, best: bool) -> None:
        """Print a line."""
        time = "" if evaluation.flight_time_s is None else f"{evaluation.flight_time_s:6.2f} s"
        zone = "" if evaluation.zone is None else f"  zone {evaluation.zone}"
        self._progress.note(
            f"{evaluation.steps:>11,} decisions {evaluation.seconds:7.0f} s  success "
            f"{evaluation.success_rate:6.1%}  {time}{zone}{'  best so far' if best else ''}"
        )
