"""`airl train`: train a policy from a TOML file and export it."""

from __future__ import annotations

import shlex
import signal
import sys
from functools import partial
from typing import Annotated

from pydantic import Field
from rich.console import Console

from airl_mav.cli.options import POSITIONAL
from airl_mav.cli.shared_options import Telling, Voice
from airl_mav.core.compiling import COMPILING, heard_compiling
from airl_mav.core.errors import EXIT_INTERRUPTED, FieldError, UsageError
from airl_mav.core.first_start import compile_shown
from airl_mav.profiles.vehicle import load_vehicle
from airl_mav.training.training_folder import Exported, TrainingProgress, TrainRequest


class TrainOptions(Telling, TrainRequest):
    """Train a policy; the best weights are exported as policy.onnx with their card.

    Examples:
        airl train static-obstacles --out runs/mine
        airl train dense-obstacles --computer ras-pi-4 --workload template-5x32 --resume
        airl train my.toml --initial runs/mine --out runs/finer
    """

    config: Annotated[str, POSITIONAL] = Field(
        default="static-obstacles", description=TrainRequest.model_fields["config"].description
    )


OPTIONS = TrainOptions
EXTRAS = ("sim", "train")


def run(
    options: TrainOptions, console: Console | None = None, *, command_line: str | None = None
) -> int:
    """Train, export, and print the result; return 0, or 130 after Ctrl-C."""
    from airl_mav.envs.stopping import injections_of, speed_bound

    voice = Voice(options, "airl train", console)
    show = partial(voice.console.print, soft_wrap=True, highlight=False)
    config = options.configured()
    vehicle = load_vehicle(config.environment.vehicle)
    kind = config.environment.camera.of(vehicle.camera).kind
    # Imported late: needs an arena, which `--help` and a light installation do not have.
    from airl_mav.scenario.resolve import vectorized_plan

    compile_shown([vectorized_plan(kind)])
    bound, injections = speed_bound(config.environment), injections_of(config.environment.delay)
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    # Imported late: the learner takes two seconds to load; typos are reported before.
    from airl_mav.training.training_run import train

    stem, out = options.stem, options.folder
    show(f"training   {stem}: {config.description}")
    for source in injections:
        show(f"latency    {source.label}")
    if bound is not None:
        show(f"speed      {bound.describe()}")
    show(f"folder     {out}")
    show(f"curves     tensorboard --logdir {out / 'tensorboard'}")
    with voice:
        progress = voice.progress
        try:
            with heard_compiling(lambda begins: progress.status(COMPILING if begins else None)):
                result = train(
                    config,
                    out,
                    name=options.name or stem,
                    resume=options.resume,
                    mixed_code=options.mixed_code,
                    progress=TrainingProgress(progress, config.steps),
                    command=command_line or shlex.join(["airl", *sys.argv[1:]]),
                )
        except FieldError as error:  # An error of the file, not of an option.
            raise UsageError(f"{options.config}: {error.line(sign=' = ')}") from None
        except KeyboardInterrupt:
            show(f"interrupted: airl train {options.config} --out {out} --resume continues")
            voice.finish(EXIT_INTERRUPTED, "interrupted", out)
            return EXIT_INTERRUPTED
        best, policy = result.best, result.folder.policy
        rate = f"{best.success_rate:.1%} of {best.episodes} selection episodes"
        lines = (f"best       {rate} after {best.steps:,} decisions", f"policy     {policy}")
        for line in lines:
            show(line)
        environment = config.environment
        where = f" --arena {environment.arena}" if environment.goal_height else ""
        show(f"fly it     airl-sitl --policy {policy}{where}")
        progress.tell(Exported(str(policy)))
        voice.finish(0, "complete", out, more=lines)
    return 0
