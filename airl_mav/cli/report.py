"""`airl report`: build a run's report again."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro
from rich.console import Console

from airl_mav.report.rebuild import rebuild
from airl_mav.report.terminal import print_report


@dataclass(frozen=True)
class ReportCommand:
    """Print a run's tables and write its report.html and pictures again."""

    run: tyro.conf.Positional[Path]
    """Run folder, as airl-sitl left it."""


def run(command: ReportCommand, console: Console | None = None) -> int:
    """Build the report.

    Args:
        command: What was asked for.
        console: Where to print; None means standard output.

    Returns:
        Exit status, 0.

    Raises:
        UsageError: The folder holds no run, or an arena of it cannot be made any more.
    """
    flown, page = rebuild(command.run)
    print_report(flown, console or Console(), page)
    return 0
