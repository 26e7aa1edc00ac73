"""A campaign: many evaluations in one folder, flown one after the other, resumable.

What flies several evaluations to compare them (the hardware gap, the studies) says which; this says
early what is wrong with any of them, flies what is missing, and knows what was flown before.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console

from airl_mav.cli.common import EXIT_INTERRUPTED
from airl_mav.cli.evaluate_command import EvaluateCommand
from airl_mav.core.errors import UsageError
from airl_mav.core.ports import Ports
from airl_mav.flight.record import EpisodeRecord
from airl_mav.policy.registry import PolicyInfo, find_policy
from airl_mav.rehearsal.run_folder import RUN_FILE
from airl_mav.report.comparison.model import KIND_NAMES, Kind, comparison_file
from airl_mav.report.table import count_outcomes

if TYPE_CHECKING:
    from airl_mav.cli.evaluate_task import Task


@dataclass(frozen=True)
class Cell:
    """One evaluation of a campaign: one policy in one arena."""

    key: str
    """Its run folder, inside that of the campaign; no two the same."""
    title: str
    """One line for people."""
    command: EvaluateCommand
    """What is flown; its `out` is passed over."""

    @property
    def policy(self) -> str:
        """Name or path of the policy. Raises ValueError unless there is one."""
        return _only(self.key, "policy", self.command.policies)

    @property
    def arena(self) -> str:
        """Name or path of the arena. Raises ValueError unless there is one."""
        return _only(self.key, "arena", self.command.arena)


@dataclass(frozen=True)
class FlownCell:
    """A cell of which some flights are there."""

    cell: Cell
    folder: str
    """Run folder inside that of the campaign: that of the first cell with the same flights."""
    policy: PolicyInfo
    arena_name: str
    """Name of the arena without its path."""
    rules: str
    """Goal radius, hold, height and time limit in words."""
    episodes: tuple[EpisodeRecord, ...]
    """All that the folder holds."""
    code: int
    """Exit status of the evaluation: 0 when it is complete."""


def _only(key: str, what: str, names: Sequence[str]) -> str:
    if len(names) != 1:
        raise ValueError(f"cell {key}: {len(names)} of {what}: must be one")
    return names[0]


def check_root(root: Path, *, but: Kind | None = None) -> None:
    """Raise UsageError for a campaign's folder that holds something else.

    Args:
        root: Where the campaign is to go.
        but: The kind of comparison that the campaign makes.
    """
    others = {root / RUN_FILE: "single run"}
    others |= {comparison_file(root, k): name for k, name in KIND_NAMES.items() if k != but}
    for file, what in others.items():
        if file.exists():
            raise UsageError(f"--out {root}: holds a {what}; accepted: another folder")


def check_cells(cells: Sequence[Cell]) -> None:
    """Check everything that can be wrong before anything flies.

    Raises:
        UsageError: The input of a cell cannot be used.
        ValueError: Two cells share a key, or one has not exactly one policy and one arena.
    """
    # Imported late: the kernels take a second to load, and a typo must not wait for them.
    from airl_mav.cli.evaluate import check_evaluation
    from airl_mav.cli.evaluate_task import prepare

    keys = [cell.key for cell in cells]
    if len(set(keys)) != len(keys):
        raise ValueError(f"keys {keys}: must be different")
    for cell in _first_of_each(cells).values():
        policy, arena = cell.policy, cell.arena
        check_evaluation(cell.command)
        # Not kept: a campaign of large networks would fill the memory with them.
        prepare(cell.command, policy, arena)


def fly_cells(
    root: Path, cells: Sequence[Cell], console: Console, *, reports: bool = False
) -> tuple[list[FlownCell], int]:
    """Fly what is left of a campaign.

    Args:
        root: Its folder; each cell has a run folder in it, by its key.
        cells: What is flown, in this order. Cells with the same flights share those.
        console: Where to print: one line a cell.
        reports: Whether each cell gets a report page of its own. They take longer than flights;
            `airl report` makes one at any time.

    Returns:
        The cells that have flights, in the given order, and the exit status: 0 all is flown,
        1 a process died, 130 Ctrl-C.

    Raises:
        UsageError: The input of a cell cannot be used: before anything flies; or a folder holds
            another run.
        ValueError: See `check_cells`.
    """
    check_cells(cells)
    firsts = _first_of_each(cells)
    _warn(firsts.values(), console)
    flown: dict[str, FlownCell] = {}
    code = 0
    for number, cell in enumerate(firsts.values(), start=1):
        try:
            held, new = _fly(root, cell, console, reports)
        except KeyboardInterrupt:  # A second Ctrl-C, or one between two flights.
            code = EXIT_INTERRUPTED
            break
        if held.episodes:
            flown[cell.key] = held
            _say(console, f"[{number}/{len(firsts)}] {cell.title}: {_in_words(held, new)}")
        if code := held.code:
            break
    if code:
        ended = "interrupted" if code == EXIT_INTERRUPTED else "broken off"
        _say(console, f"{ended}: the same command with --out {root} goes on", "yellow")
    return [
        replace(flown[first.key], cell=cell)
        for cell in cells
        if (first := firsts[_flights(cell)]).key in flown
    ], code


def _warn(cells: Iterable[Cell], console: Console) -> None:
    """Say which policies may know their episodes from training."""
    from airl_mav.cli.evaluate import warn_of_known_seeds

    warned: set[str] = set()
    for cell in cells:
        policy = find_policy(cell.policy)
        if policy.name not in warned:
            warned.add(policy.name)
            warn_of_known_seeds(cell.command, policy, console)


def _flights(cell: Cell) -> EvaluateCommand:
    """Return the settings that decide a cell's flights: the same for cells that share them."""
    return replace(
        cell.command, slots=1, workers=None, tlogs=False, on_card=False, ports=Ports(), out=None
    )


def _first_of_each(cells: Sequence[Cell]) -> dict[EvaluateCommand, Cell]:
    """Return the cells without those whose flights an earlier one has, by their settings."""
    firsts: dict[EvaluateCommand, Cell] = {}
    for cell in cells:
        firsts.setdefault(_flights(cell), cell)
    return firsts


def _fly(root: Path, cell: Cell, console: Console, reports: bool) -> tuple[FlownCell, int]:
    """Fly what is left of a cell; return it, and how many flights are new."""
    from airl_mav.cli.evaluate_task import prepare

    task: Task = prepare(cell.command, cell.policy, cell.arena)
    result = task.fly(root / cell.key, console)
    if reports and result.episodes:
        _report(result.path, new=result.new)
    held = FlownCell(
        cell=cell,
        folder=cell.key,
        policy=task.policy,
        arena_name=task.arena_name,
        rules=task.rules,
        episodes=result.episodes,
        code=result.code,
    )
    return held, result.new


def _report(path: Path, *, new: int) -> None:
    """Write a cell's page, unless it is there already."""
    from airl_mav.report.document import REPORT_FILE
    from airl_mav.report.run_report import write_report

    if new or not (path / REPORT_FILE).exists():
        write_report(path)


def _in_words(held: FlownCell, new: int) -> str:
    """Return how a cell's flights ended."""
    told = count_outcomes([episode.outcome for episode in held.episodes])
    return told if new else f"{told} (flown before)"


def _say(console: Console, text: str, style: str | None = None) -> None:
    console.print(text, style=style, soft_wrap=True, markup=False, highlight=False)
