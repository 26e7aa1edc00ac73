"""`airl`: everything around a rehearsal, one subcommand a file."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any

import tyro

from airl_mav.cli import arena, evaluate, export, ladder, report, train
from airl_mav.cli.common import run_command
from airl_mav.cli.evaluate_command import EvaluateCommand
from airl_mav.cli.ladder_command import LadderCommand
from airl_mav.cli.train_command import TrainCommand

Command = (
    Annotated[arena.ArenaCommand, tyro.conf.subcommand("arena", prefix_name=False)]
    | Annotated[EvaluateCommand, tyro.conf.subcommand("evaluate", prefix_name=False)]
    | Annotated[export.ExportCommand, tyro.conf.subcommand("export", prefix_name=False)]
    | Annotated[LadderCommand, tyro.conf.subcommand("ladder", prefix_name=False)]
    | Annotated[report.ReportCommand, tyro.conf.subcommand("report", prefix_name=False)]
    | Annotated[TrainCommand, tyro.conf.subcommand("train", prefix_name=False)]
)

_RUN: dict[type[Any], Callable[[Any], int]] = {
    arena.ArenaCommand: arena.run,
    EvaluateCommand: evaluate.run,
    export.ExportCommand: export.run,
    LadderCommand: ladder.run,
    report.ReportCommand: report.run,
    TrainCommand: train.run,
}


def main() -> None:
    """Entry point of `airl`."""
    command = tyro.cli(Command, prog="airl", description=__doc__)
    run_command(lambda: _RUN[type(command)](command))


if __name__ == "__main__":
    main()
