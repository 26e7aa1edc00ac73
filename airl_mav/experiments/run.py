"""Python API of a run: fly a scenario; read episodes, quality, latencies, paths and report."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from airl_mav.core import addons
from airl_mav.core.console import new_console
from airl_mav.core.files import Arrays
from airl_mav.core.progress import Progress, RichProgress
from airl_mav.experiments.campaign import Cell, run_cell
from airl_mav.experiments.executors import Executor
from airl_mav.experiments.live import Ended, FlownRun, fly_live, tell_end
from airl_mav.experiments.process_executor import open_executor
from airl_mav.flight.episode_record import EpisodeRecord, run_sha256
from airl_mav.flight.statistics import Aggregate, aggregate
from airl_mav.flight.trajectory import Trajectory
from airl_mav.latency.stages import Samples, pool, stage_samples
from airl_mav.rehearsal.rehearsal import RehearsalError
from airl_mav.rehearsal.run_folder import LoadedRun, RunInfo, load
from airl_mav.rehearsal.signals import stop_on_signals
from airl_mav.scenario.model import Scenario
from airl_mav.scenario.resolve import resolve
from airl_mav.scenario.resolved import ResolvedScenario


@dataclass(frozen=True)
class Run:
    """Loaded run folder. Large data is read on first access."""

    path: Path

    @cached_property
    def _loaded(self) -> LoadedRun:
        return load(self.path)

    @property
    def info(self) -> RunInfo:
        """Settings, seeds, versions and machine of the run."""
        return self._loaded.info

    @property
    def episodes(self) -> tuple[EpisodeRecord, ...]:
        """Records of all episodes, by index."""
        return self._loaded.episodes

    @cached_property
    def quality(self) -> Aggregate:
        """Success rate, and means over the successful flights, each with its 95 % interval."""
        return aggregate(self.episodes)

    @cached_property
    def latency(self) -> dict[str, Samples]:
        """Durations (n,) [µs] by stage over all decisions; keys as in `latency.stages.STAGES`."""
        return pool(stage_samples(stamps) for stamps in self.stamps.values())

    @property
    def stamps(self) -> dict[int, Arrays]:
        """Raw stamps of the decisions (n,) [µs] by name, by episode index."""
        return self._loaded.latency

    @property
    def trajectories(self) -> dict[int, Trajectory]:
        """True paths, by episode index: time [µs], position and velocity NED, attitude, power."""
        return self._loaded.trajectories

    @property
    def sha256(self) -> str | None:
        """Digest of all lockstep flights, equal if bit-identical; None at other levels."""
        return run_sha256(self.episodes)

    @property
    def complete(self) -> bool:
        """True if all planned episodes have been flown."""
        return len(self.episodes) == len(self.info.seeds)

    def _repr_html_(self) -> str | None:
        """Return the notebook view: the verdict, the statistics and a map of the flights."""
        html = addons.entries("airl_mav", "NOTEBOOK").get("run")
        return None if html is None else str(addons.load(html)(self._loaded))

    def report(self) -> Path:
        """Write the page and pictures of the run and return the page, or raise UsageError."""
        # Imported here: matplotlib takes half a second, which runs without a page do not need.
        from airl_mav.report.run_report import write_report

        return write_report(self.path)


def load_run(path: Path | str) -> Run:
    """Read a run folder; raise UsageError if it is damaged or contains no run."""
    run = Run(Path(path))
    _ = run.info  # Checks the folder.
    return run


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
