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
from airl_mav.experiments.executors import MAX_WORKERS

if TYPE_CHECKING:
    from airl_mav.cli.cells import FlownCell
    from airl_mav.cli.gap_plan import GapPlan
    from airl_mav.report.gap.build import HeldArena


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
    from airl_mav.report.gap.file import GAP_FILE

    plan = plan_gap(command)
    name = f"{plan.policy.name}-{plan.target.name}"
    root = command.out or Path("runs") / f"{utc_now():%Y%m%dT%H%M%SZ}-gap-{_plain(name)}"
    check_root(root, but=GAP_FILE)
    for remark in plan.remarks:
        console.print(remark, style="yellow", soft_wrap=True, markup=False, highlight=False)
    flown, code = fly_cells(root, [planned.cell for planned in plan.cells], console)
    if flown:
        from airl_mav.report.gap.build import build_gap
        from airl_mav.report.gap.terminal import show_gap

        show_gap(build_gap(root, plan.facts, _held(plan, flown)), console)
    return code


def _held(plan: GapPlan, flown: Sequence[FlownCell]) -> list[HeldArena]:
    """Return where the flights of each column lie, of those columns that have any."""
    from airl_mav.report.gap.build import Held, HeldArena

    by_key = {held.cell.key: held for held in flown}
    columns: dict[str, list[Held]] = {}
    for planned in plan.cells:
        if (held := by_key.get(planned.cell.key)) is not None:
            columns.setdefault(planned.arena, []).append(
                Held(
                    role=planned.role,
                    title=planned.title,
                    folder=held.folder,
                    planned=planned.cell.command.episodes,
                    rules=held.rules,
                )
            )
    return [HeldArena(arena, tuple(held)) for arena, held in columns.items()]


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
        check_range("--workers", command.workers, 1, MAX_WORKERS)
