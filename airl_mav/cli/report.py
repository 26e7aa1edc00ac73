"""`airl report`: build a run's report again, or compare runs."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console

from airl_mav.cli.report_command import ReportCommand
from airl_mav.core.clock import utc_now
from airl_mav.core.errors import UsageError
from airl_mav.rehearsal.run_folder import RUN_FILE
from airl_mav.report.compare.build import COMPARE_FILE, load_compared, run_folders
from airl_mav.report.compare.page import build_comparison
from airl_mav.report.compare.terminal import print_comparison
from airl_mav.report.gap.file import GAP_FILE, read_gap
from airl_mav.report.gap.terminal import show_gap
from airl_mav.report.ladder.build import LADDER_FILE, read_ladder
from airl_mav.report.ladder.page import build_page
from airl_mav.report.ladder.terminal import print_ladder
from airl_mav.report.rebuild import rebuild
from airl_mav.report.terminal import print_report


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
    ladder_there = (command.run / LADDER_FILE).exists()
    if command.others or (not ladder_there and len(run_folders(command.run)) > 1):
        return _compare(command, console)
    for option, value in (("--out", command.out), ("--names", " ".join(command.names))):
        if value:
            raise UsageError(f"{option} {value}: accepted: with two runs or more")
    if (command.run / GAP_FILE).exists():
        show_gap(read_gap(command.run), console)
        return 0
    if ladder_there:
        ladder = read_ladder(command.run)
        print_ladder(ladder, console, build_page(ladder))
        return 0
    flown, page = rebuild(command.run)
    print_report(flown, console, page)
    return 0


def _compare(command: ReportCommand, console: Console) -> int:
    """Compare runs."""
    out = command.out or Path("runs") / f"{utc_now():%Y%m%dT%H%M%SZ}-compare"
    if (out / RUN_FILE).exists():
        raise UsageError(f"--out {out}: holds a run; accepted: another folder")
    if out.is_dir() and any(out.iterdir()) and not (out / COMPARE_FILE).exists():
        raise UsageError(f"--out {out}: holds something else; accepted: a new or empty folder")
    compared = load_compared([command.run, *command.others], command.names)
    try:
        page = build_comparison(compared, out)
    except OSError as error:
        raise UsageError(f"--out {out}: {error.strerror}") from None
    print_comparison(compared, console, page)
    return 0
