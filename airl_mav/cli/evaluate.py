"""`airl evaluate`: fly policies through seeded episodes and say how well, with intervals."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console

from airl_mav.cli import report
from airl_mav.cli.common import GREATEST_SEED, check_draws, check_range
from airl_mav.cli.evaluate_command import EvaluateCommand
from airl_mav.cli.report_command import ReportCommand
from airl_mav.core.clock import utc_now
from airl_mav.core.errors import UsageError
from airl_mav.flight.record import run_sha256
from airl_mav.flight.statistics import aggregate
from airl_mav.policy.card import MeasuredResult, add_result
from airl_mav.policy.registry import PolicyInfo, find_policy
from airl_mav.rehearsal.run_folder import RUN_FILE
from airl_mav.rehearsal.workers import GREATEST_WORKERS
from airl_mav.report.matrix import (
    MATRIX_FILE,
    MATRIX_TABLE_FILE,
    Cell,
    matrix_tables,
    write_matrix,
)

if TYPE_CHECKING:
    from airl_mav.cli.evaluate_task import Result as EvaluationResult
    from airl_mav.cli.evaluate_task import Task

SHARED = ("level", "vehicle", "computer", "workload", "latency", "ablate", "episodes", "seed")
"""Options that head a table: the same for all of it."""

DEFAULT_ARENA = "static-obstacles"
"""For policies that were not trained in any."""


def run(command: EvaluateCommand, console: Console | None = None) -> int:
    """Evaluate.

    Args:
        command: What was asked for.
        console: Where to print; None means standard output.

    Returns:
        Exit status: 0 all episodes flown, 1 a process died (sitl, lockstep), 130 Ctrl-C.

    Raises:
        UsageError: The input cannot be used.
    """
    console = console or Console()
    arenas = check_evaluation(command)
    # Imported late: the kernels take a second to load, and a typo must not wait for them.
    from airl_mav.cli.evaluate_task import prepare

    tasks = [prepare(command, policy, arena) for policy in command.policies for arena in arenas]
    for policy in {task.policy.name: task.policy for task in tasks}.values():
        warn_of_known_seeds(command, policy, console)
    if len(tasks) == 1:
        return _fly_one(command, tasks[0], console)
    return _fly_matrix(command, tasks, console)


def check_evaluation(command: EvaluateCommand) -> list[str]:
    """Check what all tasks share; return the arenas. Raises UsageError."""
    if not command.policies:
        raise UsageError("no policy; accepted: one or more names or folders")
    check_range("--episodes", command.episodes, 1, 100_000)
    check_range("--seed", command.seed, 0, GREATEST_SEED)
    check_draws(command.latency_seed, command.arena_seed)
    _check_level(command)
    found = [find_policy(name) for name in command.policies]
    if command.on_card:
        _check_plain(command, found)
    _check_names("policies", [policy.name for policy in found])
    if command.arena:
        _check_names("--arena", [Path(arena).stem for arena in command.arena])
        return list(command.arena)
    trained = [None if policy.card is None else policy.card.training.arena for policy in found]
    return list(dict.fromkeys(arena or DEFAULT_ARENA for arena in trained))


def _check_level(command: EvaluateCommand) -> None:
    """Raise UsageError for options that the level does not have."""
    level = command.level
    if level == "sitl" and command.ablate is not None:
        raise UsageError(f"--ablate {command.ablate}: accepted: with --level gym or lockstep")
    if level != "lockstep" and command.tlogs:
        raise UsageError(f"--tlogs with --level {level}: accepted: with --level lockstep")
    if command.workers is None:
        return
    if level != "lockstep":
        raise UsageError(
            f"--workers {command.workers} with --level {level}: accepted: with --level lockstep"
        )
    check_range("--workers", command.workers, 1, GREATEST_WORKERS)


def _check_plain(command: EvaluateCommand, policies: Sequence[PolicyInfo]) -> None:
    """Raise UsageError for results that are not the policies' own."""
    for option in (
        "ablate",
        "arena_seed",
        "goal_radius",
        "time_limit",
        "hold",
        "hover_after",
    ):
        if (value := getattr(command, option)) is not None:
            raise UsageError(
                f"--on-card with --{option.replace('_', '-')} {value}: accepted: without it"
            )
    for policy in policies:
        if policy.folder is None:
            raise UsageError(f"--on-card: {policy.name} has no card")


def _write_on_card(command: EvaluateCommand, task: Task, result: EvaluationResult) -> None:
    """Write what a finished evaluation found onto the policy's card."""
    if not command.on_card or result.code or task.policy.folder is None:
        return
    quality = aggregate(result.episodes)
    add_result(
        task.policy.folder,
        MeasuredResult(
            arena=task.arena_name,
            level=command.level,
            latency=command.latency or _workload(command),
            episodes=len(result.episodes),
            seed=command.seed,
            success_rate=quality.success_rate.value or 0.0,
            flight_time_s=quality.flight_time_s.value,
            distance_m=quality.distance_m.value,
            energy_j=quality.energy_j.value,
        ),
    )


def _workload(command: EvaluateCommand) -> str | None:
    """Return the workload that was flown as, as a source of latency."""
    if command.workload is None:
        return None
    return f"{command.computer}/{command.workload}"


def _check_names(option: str, names: Sequence[str]) -> None:
    """Raise UsageError when two of them would share a row, a column and a folder."""
    for name in names:
        if names.count(name) > 1:
            raise UsageError(f"{option}: {name} twice; accepted: each name once")


def warn_of_known_seeds(command: EvaluateCommand, policy: PolicyInfo, console: Console) -> None:
    """Say so when a policy may know the episodes from its training."""
    training = None if policy.card is None else policy.card.training
    if training is None or training.first_arena_seed is None:
        return
    first, last = training.first_arena_seed, training.last_arena_seed
    if command.seed + command.episodes > first and (last is None or command.seed <= last):
        console.print(
            f"{policy.name} was trained on seeds from {first} on: not all episodes are new to it",
            style="yellow",
            soft_wrap=True,
            markup=False,
            highlight=False,
        )


def _fly_one(command: EvaluateCommand, task: Task, console: Console) -> int:
    """Evaluate one policy in one arena and show the run."""
    if command.out is not None and (command.out / MATRIX_FILE).exists():
        raise UsageError(f"--out {command.out}: holds a table of policies x arenas")
    result = task.fly(command.out, console)
    _write_on_card(command, task, result)
    if not result.episodes:
        console.print(f"no episode was finished; {result.path}", soft_wrap=True)
    else:
        report.run(ReportCommand(result.path), console)
    _say_fingerprint(result, console)
    return result.code


def _fly_matrix(command: EvaluateCommand, tasks: Sequence[Task], console: Console) -> int:
    """Evaluate every policy in every arena and show the tables."""
    from airl_mav.report.html import REPORT_FILE
    from airl_mav.report.rebuild import rebuild
    from airl_mav.report.terminal import print_table

    root = command.out or Path("runs") / f"{utc_now():%Y%m%dT%H%M%SZ}-evaluate"
    if (root / RUN_FILE).exists():
        raise UsageError(f"--out {root}: holds a single run; accepted: another folder")
    facts = {key: getattr(command, key) for key in SHARED}
    cells: list[Cell] = []
    code = 0
    for task in tasks:
        result = task.fly(root / f"{task.policy.name}-{task.arena_name}", console)
        _write_on_card(command, task, result)
        if result.episodes:
            shown = (result.path / REPORT_FILE).exists() and not result.new
            if not shown:
                rebuild(result.path)
            cells.append(_cell(task, result))
            write_matrix(root, facts, cells)
            _say_how_it_went(cells[-1], console)
            _say_fingerprint(result, console)
        if code := result.code:
            break
    for view in matrix_tables(cells):
        console.print()
        print_table(view, console, wrap=True)
    if cells:
        console.print(
            f"\ntables  {root / MATRIX_TABLE_FILE}", soft_wrap=True, markup=False, highlight=False
        )
    return code


def _say_how_it_went(cell: Cell, console: Console) -> None:
    """Print one line; a table of many flights takes a while."""
    counts = cell.quality.outcomes.items()
    told = ", ".join(f"{count} {outcome.value}" for outcome, count in counts if count)
    console.print(
        f"{cell.policy} in {cell.arena}: {told}", soft_wrap=True, markup=False, highlight=False
    )


def _say_fingerprint(result: EvaluationResult, console: Console) -> None:
    """Print one line that compares whole runs, where flights are the same every time."""
    if not result.code and (sha256 := run_sha256(result.episodes)) is not None:
        console.print(f"sha256 of the flights  {sha256}", soft_wrap=True, highlight=False)


def _cell(task: Task, result: EvaluationResult) -> Cell:
    """Return a task's row and column of the table."""
    card = task.policy.card
    trained_in = None if card is None else card.training.arena
    return Cell(
        policy=task.policy.name,
        arena=task.arena_name,
        folder=result.path.name,
        trained_in=None if trained_in is None else Path(trained_in).stem,
        rules=task.rules,
        quality=aggregate(result.episodes),
    )
