"""`airl report`: build a run's report again."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro
from rich.console import Console

from airl_mav.report.ladder import LADDER_FILE, read_ladder
from airl_mav.report.ladder_page import build_page
from airl_mav.report.ladder_terminal import print_ladder
from airl_mav.report.rebuild import rebuild
from airl_mav.report.terminal import print_report


@dataclass(frozen=True)
class ReportCommand:
    """Print the tables of a run or a ladder and write its page and pictures again."""

    run: tyro.conf.Positional[Path]
    """Run folder, as airl-sitl left it, or folder of a ladder, as airl ladder did."""


def run(command: ReportCommand, console: Console | None = None) -> int:
    """Build the report.

    Args:
        command: What was asked for.
        console: Where to print; None means standard output.

    Returns:
        Exit status, 0.

    Raises:
        UsageError: The folder holds neither, or an arena of it cannot be made any more.
    """
    console = console or Console()
    if (command.run / LADDER_FILE).exists():
        ladder = read_ladder(command.run)
        print_ladder(ladder, console, build_page(ladder))
        return 0
    flown, page = rebuild(command.run)
    print_report(flown, console, page)
    return 0
