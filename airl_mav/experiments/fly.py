"""A scenario, flown into its run folder at any level; a run that was interrupted goes on."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

from rich.console import Console

from airl_mav.core.cpu_quota import remove_left
from airl_mav.core.errors import EXIT_BROKEN, EXIT_INTERRUPTED, UsageError
from airl_mav.core.progress import Progress, RichProgress, SilentProgress
from airl_mav.experiments.campaign import Cell, run_cell
from airl_mav.experiments.executors import Executor, ExecutorSettings, open_executor
from airl_mav.experiments.run import Run
from airl_mav.flight.record import EpisodeRecord
from airl_mav.lockstep.errors import LockstepError
from airl_mav.rehearsal.evaluation import open_folder
from airl_mav.rehearsal.lock import locked
from airl_mav.rehearsal.progress import LiveObserver
from airl_mav.rehearsal.rehearsal import Rehearsal, RehearsalError
from airl_mav.rehearsal.run_folder import RUN_FILE
from airl_mav.rehearsal.signals import stop_on_signals, terminated_as_interrupted
from airl_mav.scenario.model import Flights, Scenario, Workers
from airl_mav.scenario.resolve import resolve
from airl_mav.scenario.resolved import ResolvedScenario
from firmware_sim.external.programs import check_program

Ended = Literal["complete", "interrupted", "broken off"]

EXIT_CODES: dict[Ended, int] = {
    "complete": 0,
    "interrupted": EXIT_INTERRUPTED,
    "broken off": EXIT_BROKEN,
}


@dataclass(frozen=True)
class FlownRun:
    """What a run has come to."""

    path: Path
    """Its folder."""
    ended: Ended
    episodes: tuple[EpisodeRecord, ...]
    """All that the folder holds, by index."""
    new: int
    """How many of them were flown now."""
    problem: str = ""
    """Why it was broken off."""


def fly_live(
    scenario: ResolvedScenario,
    out: Path | None,
    progress: Progress,
    *,
    name: str | None = None,
    announce: Callable[[], None] = lambda: None,
) -> FlownRun:
    """Fly what is left of a scenario one flight after the other, at level sitl or lockstep.

    Args:
        scenario: What is flown.
        out: Run folder; one that holds episodes of the same run gets the others. None: a new one.
        progress: Who looks on.
        name: Name of a new run; None: after level and policy.
        announce: Called before the first flight, if there is one.

    Raises:
        UsageError: The input cannot be used; what was flown before is kept.
    """
    asked = scenario.scenario
    check_program(asked.real)
    say = partial(progress.note, style="yellow")
    known = out is not None and (out / RUN_FILE).exists()
    with ExitStack() as held, terminated_as_interrupted():
        if out is not None:
            # First of all: the processes of a run that was killed may be about to write.
            keeps = held.enter_context(locked(out, say))
        folder, done = open_folder(out, name or f"{asked.level}-{scenario.policy.name}", scenario)
        if out is None:
            keeps = held.enter_context(locked(folder.path, say))
        if done:
            progress.note(f"{folder.path}: {len(done)} of {asked.episodes} episodes are there")
        if len(done) == asked.episodes:
            return FlownRun(folder.path, "complete", done, 0)
        announce()
        observer = LiveObserver(progress, done, asked.episodes)
        indices = {record.index for record in done}
        ended: Ended = "complete"
        problem = ""
        try:
            if asked.level == "lockstep":
                # Imported here: level sitl starts its processes sooner without the simulator.
                from airl_mav.lockstep.rehearsal import rehearse

                rehearse(scenario, folder, observer, indices)
            else:
                with Rehearsal(scenario, folder, observer, keeps=(keeps,)) as rehearsal:
                    rehearsal.run(done=indices)
        except (RehearsalError, LockstepError) as error:
            ended, problem = "broken off", str(error)
        except KeyboardInterrupt:
            ended = "interrupted"
        except UsageError:
            if not known and not observer.finished_records:
                folder.discard()
            raise
        finally:
            observer.close()
            folder.sweep()
            if asked.cpu_quota is not None:
                remove_left()
        tell_end(folder.path, ended, problem, progress)
        new = observer.finished_records
        episodes = tuple(sorted((*done, *new), key=lambda record: record.index))
        return FlownRun(folder.path, ended, episodes, len(new), problem)


def fly_scenario(
    scenario: ResolvedScenario, out: Path | None, progress: Progress, *, name: str | None = None
) -> FlownRun:
    """Fly what is left of a scenario at any level, several flights at a time where that can be.

    Ctrl-C and SIGTERM end it with what has ended kept.

    Args:
        scenario: What is flown.
        out: Run folder; one that holds episodes of the same run gets the others. None: a new one.
        progress: Who looks on.
        name: Name of a new run; None: after level and policy.

    Raises:
        UsageError: The input cannot be used; what was flown before is kept.
    """
    asked = scenario.scenario
    name = name or run_name(scenario)
    if asked.level == "sitl":
        return fly_live(scenario, out, progress, name=name)
    cell = Cell(name, f"{scenario.policy.name} in {scenario.arena_name}", scenario)
    with stop_on_signals() as stop, executor_of(asked) as executor:
        run = run_cell(out, cell, executor, progress=progress, stop=stop)
        (flown,) = run.cells
        ended: Ended = "complete"
        if run.error is not None:
            ended = "broken off"
        elif not run.complete or stop():
            # Also when the last flight had ended by then: what would come after must not begin.
            ended = "interrupted"
    tell_end(flown.path, ended, run.error or "", progress)
    return FlownRun(flown.path, ended, flown.episodes, flown.new, run.error or "")


def executor_of(asked: Flights) -> AbstractContextManager[Executor]:
    """Give the executor that was asked for. Raises UsageError if Ray cannot be reached."""
    shared = {name: getattr(asked, name) for name in Workers.model_fields}
    return open_executor(ExecutorSettings(**shared), in_process=asked.level == "gym")


def run_name(scenario: ResolvedScenario) -> str:
    """Return the name of a run: what was flown where."""
    ablate = scenario.scenario.ablate
    without = f"-no-{ablate}" if ablate else ""
    return f"{scenario.policy.name}{without}-{scenario.arena_name}-{scenario.scenario.level}"


def rehearse(scenario: Scenario, *, out: Path | str | None = None, progress: bool = False) -> Run:
    """Fly a scenario and return the run.

    A run that was interrupted goes on with the same `out`; what is there is not flown again.

    Args:
        scenario: What is asked for.
        out: Run folder; None makes `runs/<UTC time>-...`.
        progress: Whether to draw a bar on standard error.

    Raises:
        UsageError: The scenario cannot be flown, or `out` holds another run.
        RehearsalError: The run was broken off: processes or workers were lost too often.
        KeyboardInterrupt: Ctrl-C; what was flown is kept in `out`.
    """
    with shown(progress) as shows:
        flown = fly_scenario(resolve(scenario), None if out is None else Path(out), shows)
    raise_unless_complete(flown.ended, flown.problem)
    return Run(flown.path)


@contextmanager
def shown(progress: bool) -> Iterator[Progress]:
    """Give a progress that draws on standard error, or one that is silent."""
    if not progress:
        yield SilentProgress()
        return
    with RichProgress(Console(stderr=True)) as drawn:
        yield drawn


def raise_unless_complete(ended: Ended, problem: str) -> None:
    """Raise what a caller in Python expects of work that ended early."""
    if ended == "broken off":
        raise RehearsalError(problem)
    if ended == "interrupted":
        raise KeyboardInterrupt


def tell_end(path: Path, ended: Ended, problem: str, progress: Progress) -> None:
    """Say why a run ended early, and how it goes on."""
    if problem:
        progress.note(f"error: {problem}", "red")
    if ended != "complete":
        progress.note(f"{ended}: what was flown is kept; --out {path} goes on", "yellow")
