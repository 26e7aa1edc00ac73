"""The levels of a ladder, each flown as `airl evaluate` flies it."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console

from airl_mav.cli.evaluate_command import EvaluateCommand
from airl_mav.cli.evaluate_task import Result, prepare
from airl_mav.cli.ladder_command import LadderCommand, LevelName
from airl_mav.policy.registry import find_policy
from airl_mav.report.comparison.model import RunEntry
from airl_mav.report.document import REPORT_FILE
from airl_mav.report.run_report import write_report
from airl_mav.report.table import count_outcomes


class Climb:
    """All levels of one ladder, checked and ready to fly."""

    def __init__(self, command: LadderCommand, arena: str) -> None:
        """Check everything that can be wrong before anything flies. Raises UsageError."""
        self._command, self._arena = command, arena
        self.policy = find_policy(command.policy)
        evaluations = {level: self._evaluation(level) for level in command.levels}
        self._tasks = {
            level: prepare(evaluation, command.policy, arena)
            for level, evaluation in evaluations.items()
        }
        self.rules = "; ".join(dict.fromkeys(task.rules for task in self._tasks.values()))
        """Goal radius, hold, height and time limit in words."""

    def _evaluation(self, level: LevelName) -> EvaluateCommand:
        """Return a level as an evaluation."""
        command = self._command
        return EvaluateCommand(
            (command.policy,),
            arena=(self._arena,),
            episodes=command.episodes_at(level),
            seed=command.seed,
            level=level,
            vehicle=command.vehicle,
            computer=command.computer,
            workload=command.workload,
            latency=command.latency,
            latency_seed=command.latency_seed,
            arena_seed=command.arena_seed,
            workers=command.workers if level == "lockstep" else None,
            speed=command.speed if level == "sitl" else None,
            ports=command.ports,
        )

    def fly(self, root: Path, console: Console) -> tuple[list[RunEntry], int]:
        """Fly what is left of all levels.

        Returns:
            Where the flights of those levels lie that have any, and the exit status.

        Raises:
            UsageError: A folder holds another run.
        """
        held: list[RunEntry] = []
        code = 0
        for level in self._command.levels:
            result = self._tasks[level].fly(root / level, console)
            if result.episodes:
                if result.new or not (result.path / REPORT_FILE).exists():
                    write_report(result.path)
                planned = self._command.episodes_at(level)
                held.append(RunEntry(level, level, planned=planned))
                _say_how_it_went(level, result, console)
            if code := result.code:
                break
        return held, code


def _say_how_it_went(level: str, result: Result, console: Console) -> None:
    """Print one line."""
    told = count_outcomes([episode.outcome for episode in result.episodes])
    console.print(f"{level}: {told}", soft_wrap=True, markup=False, highlight=False)
