"""`airl report`: build a run's report again, or compare runs."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console

from airl_mav.cli.report_command import ReportCommand
from airl_mav.core.clock import utc_now
from airl_mav.core.errors import UsageError
from airl_mav.rehearsal.run_folder import RUN_FILE
from airl_mav.report.comparison.model import comparison_file, kind_of
from airl_mav.report.comparison.runs import compare_folders
from airl_mav.report.comparison.show import rebuild_comparison, show_comparison
from airl_mav.report.run_report import show_report


def run(command: ReportCommand, console: Console | None = None) -> int:
    """Build the report.

    Args:
        command: What was asked for.
        console: Where to print; None means standard output.

    Returns:
        Exit status, 0.

    Raises:
        UsageError: A folder holds neither, an arena of it cannot be made any more, or runs cannot
            be compared.
    """
    console = console or Console()
    if command.others or kind_of(command.run) == "matrix":
        return _compare(command, console)
    for option, value in (("--out", command.out), ("--names", " ".join(command.names))):
        if value:
            raise UsageError(f"{option} {value}: accepted: with two runs or more")
    if kind_of(command.run) is None:
        show_report(command.run, console)
    else:
        show_comparison(*rebuild_comparison(command.run), command.run, console)
    return 0


def _compare(command: ReportCommand, console: Console) -> int:
    """Compare runs."""
    out = command.out or Path("runs") / f"{utc_now():%Y%m%dT%H%M%SZ}-compare"
    if (out / RUN_FILE).exists():
        raise UsageError(f"--out {out}: holds a run; accepted: another folder")
    held = comparison_file(out, "compare").exists()
    if out.is_dir() and any(out.iterdir()) and not held:
        raise UsageError(f"--out {out}: holds something else; accepted: a new or empty folder")
    comparison, runs = compare_folders([command.run, *command.others], command.names)
    show_comparison(comparison, runs, out, console)
    return 0
