"""Experiments: named scenarios, flown and compared.

`Run` is the Python API of a run: fly a scenario; read episodes, quality, latencies, paths, report.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import groupby
from pathlib import Path
from typing import Any

from airl_mav.core.child_process import stop_on_signals
from airl_mav.core.clock import utc_now
from airl_mav.core.files import Arrays, subfolder
from airl_mav.core.progress import Progress, RichProgress, new_console
from airl_mav.experiments import campaign
from airl_mav.experiments.executors import Executor, open_executor
from airl_mav.experiments.live import Ended, FlownRun, fly_live, tell_end
from airl_mav.flight import episode_record, statistics, trajectory
from airl_mav.latency.stages import Samples, pool, stage_samples
from airl_mav.rehearsal import rehearsal, run_folder
from airl_mav.report import document, run_columns
from airl_mav.report.comparison.comparison_model import Comparison, Kind, RunEntry
from airl_mav.scenario.model import Scenario, free_fields
from airl_mav.scenario.resolve import ResolvedScenario, resolve


@dataclass(frozen=True)
class Experiment:
    """Cells to fly, and their comparison."""

    kind: Kind
    name: str
    facts: dict[str, Any]
    cells: tuple[campaign.Cell, ...]
    remarks: tuple[str, ...] = ()
    """Warnings to print before the first flight."""

    def root(self, out: Path | None) -> Path:
        """Return `out`, or a new folder under `runs`."""
        name = f"{utc_now():%Y%m%dT%H%M%SZ}-{self.kind}-{file_name(self.name)}"
        return out or Path("runs") / name

    @property
    def declaration(self) -> campaign.Declaration:
        """Content of the folder's declaration file."""
        shared = campaign.shared_flights(self.cells)
        return campaign.Declaration(
            kind=self.kind,
            settings={},
            cells={
                cell.name: campaign.DeclaredCell(
                    title=cell.title,
                    settings=cell.scenario.config,
                    folder=None if shared[cell.name] is cell else shared[cell.name].name,
                    role=cell.role,
                    group=cell.group,
                )
                for cell in self.cells
            },
        )


@dataclass(frozen=True)
class ExperimentRun:
    """Experiment with its results so far."""

    experiment: Experiment
    path: Path
    """Folder of the experiment, with a run folder for each cell."""
    cells: tuple[campaign.CellRun, ...]
    """Cells with flights, in the order of the experiment."""
    ended: Ended
    problem: str = ""

    @property
    def runs(self) -> dict[str, Run]:
        """Runs by cell name."""
        return {flown.cell.name: Run(flown.path) for flown in self.cells}

    def compare(self) -> tuple[Comparison, dict[str, run_folder.LoadedRun]]:
        """Return the comparison and its runs by name. Raises UsageError if no cell has flights."""
        # Imported here: a single evaluation does not need the figures.
        from airl_mav.report.comparison.show import build_comparison

        here, experiment = self.path.absolute(), self.experiment
        entries = [
            entry_of(flown.cell, flown.path.absolute().relative_to(here).as_posix())
            for flown in self.cells
        ]
        return build_comparison(self.path, experiment.kind, experiment.facts, entries)


@dataclass(frozen=True)
class ExperimentResult:
    """Result of an experiment."""

    path: Path
    runs: dict[str, Run]
    comparison: Comparison
    """Statistics of every run, and paired differences between runs."""
    page: Path


def file_name(text: str) -> str:
    """Return a text as a valid folder name."""
    return "".join(c if c.isalnum() or c in "._-" else "-" for c in text)


def make_cell(
    name: str, title: str, scenario: Scenario, *, label: str = "", role: str = "", group: str = ""
) -> campaign.Cell:
    """Resolve a scenario as a cell. Raises UsageError if it cannot be flown."""
    # A copy without the loaded network: many large networks would fill the memory.
    return campaign.Cell(name, title, replace(resolve(scenario)), label, role, group)


def entry_of(cell: campaign.Cell, folder: str) -> RunEntry:
    """Return a cell's entry in the comparison; `folder` is relative to the comparison's folder."""
    card = cell.scenario.policy.card
    trained_in = None if card is None else card.training.arena
    return RunEntry(
        name=cell.name,
        folder=folder,
        label=cell.label or cell.title,
        role=cell.role,
        group=cell.group,
        planned=len(cell.scenario.seeds),
        rules=cell.scenario.rules,
        trained_in=None if trained_in is None else Path(trained_in).stem,
    )


def run_and_compare(
    experiment: Experiment, out: Path | str | None, *, progress: bool
) -> ExperimentResult:
    """Fly an experiment and compare its runs, for the Python API; raises as `evaluate`."""
    from airl_mav.report.comparison.show import write_comparison

    with shown(progress) as shows:
        flown = run_experiment(experiment, None if out is None else Path(out), shows)
    raise_unless_complete(flown.ended, flown.problem)
    comparison, loaded = flown.compare()
    page = write_comparison(comparison, loaded, flown.path)
    return ExperimentResult(flown.path, flown.runs, comparison, page)


def run_experiment(experiment: Experiment, out: Path | None, progress: Progress) -> ExperimentRun:
    """Fly the rest of an experiment; Ctrl-C and SIGTERM stop it and keep finished flights."""
    root = experiment.root(out)
    for remark in (*experiment.remarks, *known_seeds(experiment.cells)):
        progress.note(remark, "yellow")

    def tell(run: campaign.CellRun) -> None:
        progress.note(f"{run.cell.title}: {outcome_line(run)}")

    runs: list[campaign.CellRun] = []
    state: Ended = "complete"
    problem = ""
    with campaign.open_campaign(
        root,
        experiment.declaration,
        command=" ".join(sys.argv),
        free=free_fields("gym"),
        growing=("episodes",),
        mixed=any(cell.scenario.scenario.mixed_code for cell in experiment.cells),
        say=lambda text: progress.note(text, "yellow"),
    ):
        for level, group in groupby(
            experiment.cells, key=lambda cell: cell.scenario.scenario.level
        ):
            fly = _fly_live if level == "sitl" else _fly_by_workers
            flown = fly(root, tuple(group), progress, tell)
            runs += flown.cells
            state, problem = flown.ended, flown.error or ""
            if state != "complete":
                break
    tell_end(root, state, problem, progress)
    return ExperimentRun(
        experiment, root, tuple(run for run in runs if run.episodes), state, problem
    )


def _fly_by_workers(
    root: Path,
    cells: Sequence[campaign.Cell],
    progress: Progress,
    tell: Callable[[campaign.CellRun], None],
) -> campaign.CampaignRun:
    asked = cells[0].scenario.scenario
    in_process = asked.level == "gym"
    with stop_on_signals() as stop, open_executor(asked, in_process=in_process) as executor:
        return campaign.run_cells(root, cells, executor, progress=progress, stop=stop, ended=tell)


def _fly_live(
    root: Path,
    cells: Sequence[campaign.Cell],
    progress: Progress,
    tell: Callable[[campaign.CellRun], None],
) -> campaign.CampaignRun:
    runs: list[campaign.CellRun] = []
    first_of = campaign.shared_flights(cells)
    for cell in cells:
        if (first := first_of[cell.name]) is not cell:
            runs.append(replace(next(run for run in runs if run.cell is first), cell=cell))
            continue
        out = subfolder(root.absolute(), cell.name)
        flown = fly_live(cell.scenario, out, progress, name=cell.name)
        runs.append(campaign.CellRun(cell, flown.path, flown.episodes, flown.new))
        if flown.ended != "complete":
            return campaign.CampaignRun(tuple(runs), False, flown.ended, flown.problem)
        tell(runs[-1])
    return campaign.CampaignRun(tuple(runs), True, "complete", None)


def outcome_line(run: campaign.CellRun) -> str:
    """Return the outcomes of a cell's flights as text."""
    told = document.count_flights(run.episodes)
    return told if run.new else f"{told} (flown before)"


def known_seeds(cells: Sequence[campaign.Cell]) -> list[str]:
    """Return a warning for each policy whose training may have included the seeds."""
    warnings: dict[str, str] = {}
    for cell in cells:
        policy, asked = cell.scenario.policy, cell.scenario.scenario
        training = None if policy.card is None else policy.card.training
        if training is None or training.first_arena_seed is None:
            continue
        first, last = training.first_arena_seed, training.last_arena_seed
        if asked.seed + asked.episodes > first and (last is None or asked.seed <= last):
            warnings[policy.name] = (
                f"{policy.name} was trained on seeds from {first} on: not all episodes are new to"
                f" it"
            )
    return list(warnings.values())


@dataclass(frozen=True)
class Run:
    """Loaded run folder. Large data is read on first access."""

    path: Path

    @cached_property
    def _loaded(self) -> run_folder.LoadedRun:
        return run_folder.load(self.path)

    @property
    def info(self) -> run_folder.RunInfo:
        """Settings, seeds, versions and machine of the run."""
        return self._loaded.info

    @property
    def episodes(self) -> tuple[episode_record.EpisodeRecord, ...]:
        """Records of all episodes, by index."""
        return self._loaded.episodes

    @cached_property
    def quality(self) -> statistics.Aggregate:
        """Success rate, and medians over the successful flights, each with its 95 % interval."""
        return statistics.aggregate(self.episodes)

    @cached_property
    def latency(self) -> dict[str, Samples]:
        """Durations (n,) [µs] by stage over all decisions; keys as in `latency.stages.STAGES`."""
        return pool(stage_samples(stamps) for stamps in self.stamps.values())

    @property
    def stamps(self) -> dict[int, Arrays]:
        """Raw stamps of the decisions (n,) [µs] by name, by episode index."""
        return self._loaded.latency

    @property
    def trajectories(self) -> dict[int, trajectory.Trajectory]:
        """True paths, by episode index: time [µs], position and velocity NED, attitude, power."""
        return self._loaded.trajectories

    @property
    def sha256(self) -> str | None:
        """Digest of all lockstep flights, equal if bit-identical; None at other levels."""
        return episode_record.run_sha256(self.episodes)

    @property
    def complete(self) -> bool:
        """True if all planned episodes have been flown."""
        return len(self.episodes) == len(self.info.seeds)

    def table(self, name: run_columns.TableName = "episodes") -> run_columns.Columns:
        """Return a table as columns by name; `pandas.DataFrame(run.table())` reads it.

        Args:
            name: `episodes`, `decisions`, `latency` or `trajectories`.
        """
        return run_columns.TABLES[name](self._loaded)

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
    cell = campaign.Cell(name, f"{scenario.policy.name} in {scenario.arena_name}", scenario)
    with stop_on_signals() as stop, nullcontext(executor) if executor else workers_of(asked) as who:
        assert who is not None  # noqa: S101 (the level is not sitl)
        run = campaign.run_cell(out, cell, who, progress=progress, stop=stop)
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
        raise rehearsal.RehearsalError(problem)
    if ended == "interrupted":
        raise KeyboardInterrupt
