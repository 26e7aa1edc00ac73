"""`airl ladder`: the same policy and seeds at several levels of the fidelity ladder."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rich.console import Console

from airl_mav.cli.common import EXIT_INTERRUPTED, GREATEST_SEED, check_draws, check_range
from airl_mav.cli.evaluate import DEFAULT_ARENA
from airl_mav.cli.ladder_command import LadderCommand
from airl_mav.core.clock import utc_now
from airl_mav.core.errors import UsageError
from airl_mav.policy.registry import find_policy
from airl_mav.rehearsal.workers import GREATEST_WORKERS

FACTS = ("vehicle", "computer", "workload", "latency", "seed")
"""Options that head a ladder, beside policy and arena."""


def run(command: LadderCommand, console: Console | None = None) -> int:
    """Fly the levels and show what differs.

    Args:
        command: What was asked for.
        console: Where to print; None means standard output.

    Returns:
        Exit status: 0 all episodes flown, 1 a process died (sitl, lockstep), 130 Ctrl-C.

    Raises:
        UsageError: The input cannot be used.
    """
    console = console or Console()
    arena = _check(command)
    # Imported late: the kernels take a second to load, and a typo must not wait for them.
    from airl_mav.cli.cells import check_root
    from airl_mav.cli.ladder_levels import Climb

    climb = Climb(command, arena)
    name = f"{climb.policy.name}-{Path(arena).stem}"
    root = command.out or Path("runs") / f"{utc_now():%Y%m%dT%H%M%SZ}-ladder-{name}"
    check_root(root, but="ladder")
    held, code = climb.fly(root, console)
    if len(held) > 1:
        from airl_mav.report.comparison.ladder import ladder_recipe
        from airl_mav.report.comparison.show import build_comparison, show_comparison

        facts: dict[str, Any] = {"policy": climb.policy.name, "arena": arena}
        facts |= {key: getattr(command, key) for key in FACTS} | {"rules": climb.rules}
        recipe = ladder_recipe(facts, held)
        show_comparison(*build_comparison(root, "ladder", recipe), root, console)
    if code == EXIT_INTERRUPTED:
        console.print(
            f"interrupted: the same command with --out {root} goes on",
            style="yellow",
            soft_wrap=True,
            markup=False,
            highlight=False,
        )
    return code


def _check(command: LadderCommand) -> str:
    """Check what needs no loading; return the arena. Raises UsageError."""
    levels = command.levels
    if len(set(levels)) < len(levels) or len(levels) < 2:
        told = " ".join(levels) or "nothing"
        raise UsageError(f"--levels {told}: accepted: two or more of gym lockstep sitl, each once")
    check_range("--episodes", command.episodes, 1, 100_000)
    check_range("--seed", command.seed, 0, GREATEST_SEED)
    check_draws(command.latency_seed, command.arena_seed)
    if command.workers is not None:
        check_range("--workers", command.workers, 1, GREATEST_WORKERS)
    if command.sitl_episodes is not None:
        check_range("--sitl-episodes", command.sitl_episodes, 1, command.episodes)
    if command.arena is not None:
        return command.arena
    card = find_policy(command.policy).card
    return (None if card is None else card.training.arena) or DEFAULT_ARENA
