"""The levels of a ladder, each flown as `airl evaluate` flies it."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

from rich.console import Console

from airl_mav.cli.evaluate_command import EvaluateCommand
from airl_mav.cli.evaluate_task import SAME_IN_SITL, prepare, sitl_command
from airl_mav.cli.ladder_command import LadderCommand, LevelName
from airl_mav.errors import UsageError
from airl_mav.flight.judge import Outcome
from airl_mav.harness.evaluation import another_config
from airl_mav.harness.run_folder import RUN_FILE, LoadedRun, load
from airl_mav.policy.registry import find_policy
from airl_mav.report.html import REPORT_FILE
from airl_mav.report.ladder import Held
from airl_mav.report.rebuild import rebuild
from airl_mav.report.tables import OUTCOME_WORDS

SAME_IN_PARTS = tuple(key for key in SAME_IN_SITL if key not in ("episodes", "seed"))


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

    def _evaluation(self, level: LevelName, skip: int = 0) -> EvaluateCommand:
        """Return a level as an evaluation, without its first episodes."""
        command = self._command
        return EvaluateCommand(
            (command.policy,),
            arena=(self._arena,),
            episodes=command.episodes_at(level) - skip,
            seed=command.seed + skip,
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

    def fly(self, root: Path, console: Console) -> tuple[list[Held], int]:
        """Fly what is left of all levels.

        Returns:
            Where the flights of those levels lie that have any, and the exit status.

        Raises:
            UsageError: A folder holds another run.
        """
        held: list[Held] = []
        code = 0
        for level in self._command.levels:
            if level == "sitl":
                code = self._fly_in_parts(root, console)
                folders = tuple(path.name for path, run in _parts(root) if run.episodes)
            else:
                code = self._fly_whole(level, root, console)
                folders = (level,)
            runs = [load(root / folder) for folder in folders]
            if any(run.episodes for run in runs):
                held.append(Held(level, folders, self._command.episodes_at(level)))
                _say_how_it_went(level, runs, console)
            if code:
                break
        return held, code

    def _fly_whole(self, level: LevelName, root: Path, console: Console) -> int:
        """Fly a level that goes on by itself."""
        result = self._tasks[level].fly(root / level, console)
        if result.episodes and (result.new or not (result.path / REPORT_FILE).exists()):
            rebuild(result.path)
        return result.code

    def _fly_in_parts(self, root: Path, console: Console) -> int:
        """Fly what is left of level sitl into a folder of its own: a rehearsal cannot go on."""
        command, parts = self._command, _parts(root)
        planned = command.episodes_at("sitl")
        done = 0
        for path, run in parts:
            self._check_part(path, run, command.seed + done)
            done += _flown(run)
        if done >= planned:
            return 0
        evaluation = self._evaluation("sitl", skip=done)
        out = _part_path(root, len(parts) + 1)
        if done:
            console.print(
                f"sitl: {done} of {planned} episodes are there, the others go to {out}",
                soft_wrap=True,
                markup=False,
                highlight=False,
            )
        return prepare(evaluation, command.policy, self._arena).fly(out, console).code

    def _check_part(self, path: Path, run: LoadedRun, seed: int) -> None:
        """Raise UsageError unless a folder holds a part of this very run."""
        command = self._command
        evaluation = self._evaluation("sitl")
        asked = asdict(sitl_command(evaluation, self.policy, command.policy, self._arena))
        wanted = {key: asked[key] for key in SAME_IN_PARTS} | {"seed": seed}
        held = {key: run.info.config.get(key) for key in wanted}
        if (difference := another_config(held, wanted)) is not None:
            raise UsageError(
                f"--out {path.parent}: {path.name} holds a run with {difference}; accepted: a new "
                "folder, or the same settings to go on"
            )


def _part_path(root: Path, number: int) -> Path:
    return root / ("sitl" if number == 1 else f"sitl-{number}")


def _parts(root: Path) -> list[tuple[Path, LoadedRun]]:
    """Return the rehearsals that a ladder holds, in the order they were flown."""
    parts: list[tuple[Path, LoadedRun]] = []
    while ((path := _part_path(root, len(parts) + 1)) / RUN_FILE).exists():
        parts.append((path, load(path)))
    return parts


def _flown(run: LoadedRun) -> int:
    """Return how many of a rehearsal's first episodes need not fly again: up to the last good one.

    What was aborted at its end, by a lost process as by Ctrl-C, flies again.
    """
    whole = [n for n, e in enumerate(run.episodes, start=1) if e.outcome is not Outcome.ABORTED]
    return max(whole, default=0)


def _say_how_it_went(level: str, runs: list[LoadedRun], console: Console) -> None:
    """Print one line."""
    outcomes = [episode.outcome for run in runs for episode in run.episodes]
    told = ", ".join(
        f"{outcomes.count(outcome)} {words}"
        for outcome, words in OUTCOME_WORDS.items()
        if outcome in outcomes
    )
    console.print(f"{level}: {told}", soft_wrap=True, markup=False, highlight=False)
