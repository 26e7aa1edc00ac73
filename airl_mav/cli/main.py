"""`airl`: everything around a rehearsal, one subcommand a file."""

from __future__ import annotations

from typing import Annotated

import tyro

from airl_mav.cli import arena, evaluate, export, report, train
from airl_mav.cli.common import run_command

Command = (
    Annotated[arena.ArenaCommand, tyro.conf.subcommand("arena", prefix_name=False)]
    | Annotated[evaluate.EvaluateCommand, tyro.conf.subcommand("evaluate", prefix_name=False)]
    | Annotated[export.ExportCommand, tyro.conf.subcommand("export", prefix_name=False)]
    | Annotated[report.ReportCommand, tyro.conf.subcommand("report", prefix_name=False)]
    | Annotated[train.TrainCommand, tyro.conf.subcommand("train", prefix_name=False)]
)


def main() -> None:
    """Entry point of `airl`."""
    command = tyro.cli(Command, prog="airl", description=__doc__)
    run_command(lambda: _run(command))


def _run(command: object) -> int:
    if isinstance(command, arena.ArenaCommand):
        return arena.run(command)
    if isinstance(command, evaluate.EvaluateCommand):
        return evaluate.run(command)
    if isinstance(command, export.ExportCommand):
        return export.run(command)
    if isinstance(command, report.ReportCommand):
        return report.run(command)
    if isinstance(command, train.TrainCommand):
        return train.run(command)
    raise TypeError(f"no such command: {command!r}")


if __name__ == "__main__":
    main()
