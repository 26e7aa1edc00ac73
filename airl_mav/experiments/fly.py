"""Flights of a scenario into its run folder, at any level; resumes interrupted runs."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path

from airl_mav.core.console import new_console
from airl_mav.core.progress import Progress, RichProgress
from airl_mav.experiments.campaign import Cell, run_cell
from airl_mav.experiments.executors import Executor
from airl_mav.experiments.live import Ended, FlownRun, fly_live, tell_end
from airl_mav.experiments.process_executor import open_executor
from airl_mav.experiments.run import Run
from airl_mav.rehearsal.rehearsal import RehearsalError
from airl_mav.rehearsal.signals import stop_on_signals
from airl_mav.scenario.model import Scenario
from airl_mav.scenario.resolve import resolve
from airl_mav.scenario.resolved import ResolvedScenario


def workers_of(asked: Scenario) -> AbstractContextManager[Executor | None]:
    """Return the executor of a scenario; None at level sitl, whose processes serve one run."""
    return (
        nullcontext()
        if asked.level == "sitl"
        else open_executor(asked, in_process=asked.level == "gym")
    )


def fly_scenario(
    scenario: ResolvedScenario,
    out: Path | None,
    progress: Progress,
    *,
    executor: Executor | None = None,
) -> FlownRun:
    """Fly the rest of a scenario at any level, several flights in parallel if possible."""
    asked = scenario.scenario
    name = run_name(scenario)
    if asked.level == "sitl":
        return fly_live(scenario, out, progress, name=name)
    cell = Cell(name, f"{scenario.policy.name} in {scenario.arena_name}", scenario)
    with stop_on_signals() as stop, nullcontext(executor) if executor else workers_of(asked) as who:
        assert who is not None  # noqa: S101 (the level is not sitl)
        run = run_cell(out, cell, who, progress=progress, stop=stop)
    (flown,) = run.cells
    tell_end(flown.path, run.ended, run.error or "", progress)
    return FlownRun(flown.path, run.ended, flown.episodes, flown.new, run.error or "")


def run_name(scenario: ResolvedScenario) -> str:
    """Return the default name of a run."""
    ablate = scenario.scenario.ablate
    without = f"-no-{ablate}" if ablate else ""
    return f"{scenario.policy.name}{without}-{scenario.arena_name}-{scenario.scenario.level}"


def rehearse(scenario: Scenario, *, out: Path | str | None = None, progress: bool = False) -> Run:
    """Fly a scenario and return the run; the same `out` resumes an interrupted run.

    Args:
        scenario: Scenario to fly.
        out: Run folder; None = `runs/<UTC time>-...`.
        progress: Draw a progress bar on standard error.

    Raises:
        UsageError: The scenario cannot be flown, or `out` contains another run.
        RehearsalError: Processes or workers were lost too often.
        KeyboardInterrupt: Ctrl-C; finished flights are kept in `out`.
    """
    with shown(progress) as shows:
        flown = fly_scenario(resolve(scenario), None if out is None else Path(out), shows)
    raise_unless_complete(flown.ended, flown.problem)
    return Run(flown.path)


@contextmanager
def shown(progress: bool) -> Iterator[Progress]:
    """Yield a progress that draws on standard error, or a silent one."""
    if not progress:
        yield Progress()
        return
    with RichProgress(new_console(stderr=True)) as drawn:
        yield drawn


def raise_unless_complete(ended: Ended, problem: str) -> None:
    """Raise RehearsalError or KeyboardInterrupt for work that ended early."""
    if ended == "broken off":
        raise RehearsalError(problem)
    if ended == "interrupted":
        raise KeyboardInterrupt
