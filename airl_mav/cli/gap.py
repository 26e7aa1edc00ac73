"""`airl gap`: what a policy loses on an onboard computer, without mitigation and with it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console

from airl_mav.cli.common import GREATEST_SEED, check_range
from airl_mav.cli.gap_command import GapCommand
from airl_mav.core.clock import utc_now
from airl_mav.core.errors import UsageError
from airl_mav.rehearsal.workers import GREATEST_WORKERS

if TYPE_CHECKING:
    from airl_mav.cli.cells import FlownCell
    from airl_mav.cli.gap_plan import GapPlan
    from airl_mav.report.comparison.model import RunEntry


def run(command: GapCommand, console: Console | None = None) -> int:
    """Measure the gap.

    Args:
        command: What was asked for.
        console: Where to print; None means standard output.

    Returns:
        Exit status: 0 all episodes flown, 1 a process died (sitl, lockstep), 130 Ctrl-C.

    Raises:
        UsageError: The input cannot be used.
    """
    console = console or Console()
    _check(command)
    # Imported late: the kernels take a second to load, and a typo must not wait for them.
    from airl_mav.cli.cells import check_root, fly_cells
    from airl_mav.cli.gap_plan import plan_gap

    plan = plan_gap(command)
    name = f"{plan.policy.name}-{plan.target.name}"
    root = command.out or Path("runs") / f"{utc_now():%Y%m%dT%H%M%SZ}-gap-{_plain(name)}"
    check_root(root, but="gap")
    for remark in plan.remarks:
        console.print(remark, style="yellow", soft_wrap=True, markup=False, highlight=False)
    flown, code = fly_cells(root, [planned.cell for planned in plan.cells], console)
    if flown:
        from airl_mav.report.comparison.gap import gap_recipe
        from airl_mav.report.comparison.show import build_comparison, show_comparison

        recipe = gap_recipe(plan.facts, _entries(plan, flown))
        show_comparison(*build_comparison(root, "gap", recipe), root, console)
    return code


def _entries(plan: GapPlan, flown: Sequence[FlownCell]) -> list[RunEntry]:
    """Return the runs of the gap that have any flights, in the order of the tables."""
    from airl_mav.report.comparison.model import RunEntry

    by_key = {held.cell.key: held for held in flown}
    return [
        RunEntry(
            name=planned.cell.key,
            folder=held.folder,
            label=planned.title,
            role=planned.role,
            group=planned.arena,
            planned=planned.cell.command.episodes,
            rules=held.rules,
        )
        for planned in plan.cells
        if (held := by_key.get(planned.cell.key)) is not None
    ]


def _plain(name: str) -> str:
    """Return a name that can be one of a folder."""
    return "".join(c if c.isalnum() or c in "._-" else "-" for c in name)


def _check(command: GapCommand) -> None:
    """Check what needs no loading. Raises UsageError."""
    check_range("--episodes", command.episodes, 1, 100_000)
    check_range("--seed", command.seed, 0, GREATEST_SEED)
    if command.workers is not None:
        if command.level != "lockstep":
            raise UsageError(
                f"--workers {command.workers} with --level {command.level}: accepted: with --level "
                "lockstep"
            )
        check_range("--workers", command.workers, 1, GREATEST_WORKERS)
