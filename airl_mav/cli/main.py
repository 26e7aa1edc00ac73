"""`airl`: everything around a rehearsal, one subcommand a file."""

from __future__ import annotations

import importlib
from typing import Annotated, Any, NamedTuple, Union

import tyro

from airl_mav.cli.arena_command import ArenaCommand
from airl_mav.cli.common import check_installed, run_command
from airl_mav.cli.conformance import ConformanceOptions
from airl_mav.cli.evaluate_command import EvaluateCommand
from airl_mav.cli.export import ExportOptions
from airl_mav.cli.gap_command import GapCommand
from airl_mav.cli.ladder_command import LadderCommand
from airl_mav.cli.parameters_command import ParametersCommand
from airl_mav.cli.profile_command import ProfileCommand
from airl_mav.cli.report_command import ReportCommand
from airl_mav.cli.sweep_command import SweepCommand
from airl_mav.cli.train import TrainOptions


class Subcommand(NamedTuple):
    """One subcommand of `airl`."""

    options: type[Any]
    """What it can be asked for: a dataclass in a module of its own, `cli/<name>_command.py`, that
    imports nothing beyond the light installation. Its docstring is the help."""
    module: str
    """Where its `run(command) -> exit status` is: imported when it is asked for, not before."""
    needs: tuple[str, ...] = ("sim",)
    """Extras without which it does nothing at all (keys of `cli.common.EXTRAS`)."""


SUBCOMMANDS: dict[str, Subcommand] = {
    # To add one: write cli/<name>_command.py and cli/<name>.py, and a line here.
    "arena": Subcommand(ArenaCommand, "airl_mav.cli.arena"),
    "conformance": Subcommand(ConformanceOptions, "airl_mav.cli.conformance", needs=()),
    "evaluate": Subcommand(EvaluateCommand, "airl_mav.cli.evaluate"),
    "export": Subcommand(ExportOptions, "airl_mav.cli.export"),
    "gap": Subcommand(GapCommand, "airl_mav.cli.gap"),
    "ladder": Subcommand(LadderCommand, "airl_mav.cli.ladder"),
    "parameters": Subcommand(ParametersCommand, "airl_mav.cli.parameters"),
    "profile": Subcommand(ProfileCommand, "airl_mav.cli.profile", needs=()),
    "report": Subcommand(ReportCommand, "airl_mav.cli.report"),
    "sweep": Subcommand(SweepCommand, "airl_mav.cli.sweep"),
    "train": Subcommand(TrainOptions, "airl_mav.cli.train"),
}


def main() -> None:
    """Entry point of `airl`."""
    run_command(_run)


def _run() -> int:
    """Read the command line and run what it asks for."""
    # Typed as Any: a union made from a table is nothing that a type checker could read.
    union: Any = Union[  # noqa: UP007
        tuple(
            Annotated[entry.options, tyro.conf.subcommand(name, prefix_name=False)]
            for name, entry in SUBCOMMANDS.items()
        )
    ]
    command = tyro.cli(union, prog="airl", description=__doc__)
    (entry,) = (entry for entry in SUBCOMMANDS.values() if entry.options is type(command))
    check_installed(*entry.needs)
    return int(importlib.import_module(entry.module).run(command))


if __name__ == "__main__":
    main()
