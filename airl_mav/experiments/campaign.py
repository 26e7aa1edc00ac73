"""Campaigns: evaluations or trainings that belong together, in one resumable folder.

    campaign.json   the declaration: cells, comparisons, settings
    <cell>/         run folder of an evaluation, or training folder of a trial

The declaration is written first and atomically. Progress is derived from the cells' folders.
`run_cells` flies evaluations by one executor.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager, nullcontext
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from airl_mav.core import compiling, constants, errors, files, first_start, machine
from airl_mav.core.clock import WallClock
from airl_mav.core.progress import Progress
from airl_mav.experiments import executors, live
from airl_mav.flight.episode_record import EpisodeRecord
from airl_mav.rehearsal import observer, run_folder
from airl_mav.rehearsal.run_folder import (
    CAMPAIGN_FILE,
    FlownEpisode,
    RunFolder,
    another_config,
    check_folder,
    locked,
)
from airl_mav.scenario.resolve import PlannedEpisode, ResolvedScenario, plan_of

INTERVAL_S = 2.0
"""Interval between two saves of a small run [wall s]."""

INTERVAL_PER_SAVE = 9.0
"""Minimum interval between two saves, in multiples of the last save's duration. Each save copies
the archive; without this minimum, saving would dominate a run of ten thousand flights."""

MAX_WAITING = 1000
"""Maximum number of episodes that wait to be saved."""


class EpisodeSaver:
    """Saves episodes as they end. As a context manager, all are on disk at exit."""

    def __init__(self, folder: RunFolder) -> None:
        self._folder = folder
        self._changed = threading.Condition()
        self._waiting: list[FlownEpisode] = []
        self._ending = False
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name="episode saver")

    def __enter__(self) -> EpisodeSaver:
        """Start the thread."""
        self._thread.start()
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        """Save the rest. Raises a failed save's error unless another exception is active."""
        with self._changed:
            self._ending = True
            self._changed.notify_all()
        self._thread.join()
        self._folder.close()
        if error is None:
            self._raise_error()

    def add(self, episode: FlownEpisode) -> None:
        """Add an episode; blocks while the queue is full. Raises the error of a failed save."""
        with self._changed:
            # A bounded queue: episodes must not fill the memory if the disk is slower than the
            # flights.
            self._changed.wait_for(lambda: len(self._waiting) < MAX_WAITING or self._error)
            self._raise_error()
            self._waiting.append(episode)
            self._changed.notify_all()

    def _raise_error(self) -> None:
        if self._error is not None:
            raise self._error

    # --- the thread

    def _run(self) -> None:
        interval_s, ending = INTERVAL_S, False
        try:
            while not ending:
                ending, episodes = self._collect(interval_s)
                # Slow disks get fewer, larger saves.
                interval_s = max(INTERVAL_S, INTERVAL_PER_SAVE * self._save(episodes))
        except BaseException as error:  # Raised again in the caller's thread.
            with self._changed:
                self._error = error
                self._changed.notify_all()

    def _collect(self, interval_s: float) -> tuple[bool, list[FlownEpisode]]:
        """Wait for the next save; return True if it is the last one, and its episodes."""
        with self._changed:
            self._changed.wait_for(
                lambda: self._ending or len(self._waiting) >= MAX_WAITING, interval_s
            )
            # Taken under the lock, saved without it: flights continue during the save.
            episodes, self._waiting = self._waiting, []
            self._changed.notify_all()
            return self._ending, episodes

    def _save(self, episodes: list[FlownEpisode]) -> float:
        """Save the episodes; return the duration [wall s]."""
        clock = WallClock()
        if episodes:
            self._folder.save_episodes(episodes)
        return clock.time_us() / constants.US_PER_S


@dataclass(frozen=True)
class LockstepFlier:
    """Flier of level lockstep: one flight at a time in each worker. Implements `Flier`."""

    scenario: ResolvedScenario

    def episodes_per_job(self, episodes: int, workers: int) -> int:  # noqa: ARG002
        """Return the episodes per job; see `Flier`."""
        return 1

    def start(self, folder: run_folder.RunFolder, stop: executors.Stop) -> executors.FlyEpisodes:  # noqa: ARG002 (polled between flights)
        """Load simulator and policy once; see `Flier`."""
        # Imported here: only workers need the flight controller and MAVSDK.
        from airl_mav.lockstep.lockstep_flight import fly
        from firmware_sim.warm_up import warm_up

        scenario = self.scenario
        warm_up(scenario.vehicle, scenario.scenario.plant)
        log = folder.path / run_folder.FIRMWARE_PRINTS  # shared by parallel flights

        def fly_all(episodes: Sequence[PlannedEpisode]) -> Iterator[run_folder.FlownEpisode]:
            for episode in episodes:
                tlog = folder.tlog_path(episode.index) if scenario.scenario.tlogs else None
                policy = scenario.fresh_policy(episode.seed)
                yield fly(scenario, policy, episode.index, episode.seed, tlog=tlog, log=log)

        return fly_all


def _gym_flier(scenario: ResolvedScenario) -> executors.Flier:
    # Imported here: level lockstep does not need the vectorized simulator.
    from airl_mav.experiments.gym_flier import GymFlier

    return GymFlier(scenario)


FLIERS: dict[str, Callable[[ResolvedScenario], executors.Flier]] = {
    "gym": _gym_flier,
    "lockstep": LockstepFlier,
}
"""Levels whose flights run in workers."""


@dataclass(frozen=True)
class Cell:
    """One evaluation of a campaign: one policy in one arena, under one set of conditions."""

    name: str
    """Name of the run folder inside the campaign's folder."""
    title: str
    scenario: ResolvedScenario
    label: str = ""
    """Label in the comparison; empty = the title. For role and group see `RunEntry`."""
    role: str = ""
    group: str = ""

    def __post_init__(self) -> None:
        """Raise UsageError if the level's environment does not support the scenario."""
        if self.scenario.scenario.level in FLIERS:
            # Report unsupported scenarios before the first flight of the campaign.
            _ = self.flier

    @property
    def flier(self) -> executors.Flier:
        """Flier of the cell's episodes."""
        return FLIERS[self.scenario.scenario.level](self.scenario)


@dataclass(frozen=True)
class CellRun:
    """Cell with its results so far."""

    cell: Cell
    path: Path
    """Run folder; cells with the same flights share the first cell's folder."""
    episodes: tuple[EpisodeRecord, ...]
    """All episodes in the folder, by index."""
    new: int
    """Number of episodes flown by this call."""

    @property
    def complete(self) -> bool:
        """True if all episodes have been flown."""
        return len(self.episodes) == len(self.cell.scenario.seeds)


@dataclass(frozen=True)
class CampaignRun:
    """Result of a campaign."""

    cells: tuple[CellRun, ...]
    """Started cells, in the order of the campaign, including earlier calls."""
    complete: bool
    """True if all episodes of all cells have been flown."""
    ended: live.Ended
    """Also "interrupted" if the last flight had ended: subsequent work must not start."""
    error: str | None
    """Error that ended the campaign: a job failed, or lost its worker too often."""


def run_cell(
    out: Path | None,
    cell: Cell,
    executor: executors.Executor,
    *,
    progress: Progress | None = None,
    stop: executors.Stop = executors.never,
) -> CampaignRun:
    """Fly the rest of one evaluation; see `run_cells`. Without `out` a new folder is created."""
    return _run({cell.name: out}, [cell], executor, progress or Progress(), stop)


def run_cells(
    root: Path,
    cells: Sequence[Cell],
    executor: executors.Executor,
    *,
    progress: Progress | None = None,
    stop: executors.Stop = executors.never,
    ended: Callable[[CellRun], None] = lambda _: None,
) -> CampaignRun:
    """Fly the rest of a campaign in `root` until `stop`, polled several times per second.

    `cells` have unique names; cells with the same flights share a run folder. `ended` is called for
    each complete cell, also if it was complete before.
    """
    first_of = shared_flights(cells)
    # Equal flights are flown once.
    unique = [cell for cell in cells if first_of[cell.name] is cell]
    paths = {cell.name: files.subfolder(root.absolute(), cell.name) for cell in unique}
    run = _run(paths, unique, executor, progress or Progress(), stop, ended)
    flown = {each.cell.name: each for each in run.cells}
    shown = [
        CellRun(cell, held.path, held.episodes, held.new)
        for cell in cells
        if (held := flown.get(first_of[cell.name].name)) is not None
    ]
    return replace(run, cells=tuple(shown))


def shared_flights(cells: Sequence[Cell]) -> dict[str, Cell]:
    """Return, by cell name, the first cell with the same flights, usually the cell itself."""
    firsts: list[Cell] = []
    first_of: dict[str, Cell] = {}
    for cell in cells:
        mine = cell.scenario
        for first in firsts:
            theirs = first.scenario
            # Seeds first: comparing configurations is slower.
            if theirs.seeds == mine.seeds and not run_folder.another_config(
                theirs.config, mine.config
            ):
                first_of[cell.name] = first
                break
        else:
            firsts.append(cell)
            first_of[cell.name] = cell
    return first_of


@dataclass(frozen=True)
class _Job:
    """Episodes of one cell, flown as one job."""

    cell: str
    folder: run_folder.RunFolder
    episodes: tuple[PlannedEpisode, ...]

    def seeds(self) -> str:
        """Return the seeds as text for messages."""
        first, last = self.episodes[0].seed, self.episodes[-1].seed
        return f"seed {first}" if len(self.episodes) == 1 else f"seeds {first} to {last}"


@dataclass(frozen=True)
class _Start:
    """Initializer of a worker. A worker holds one cell at a time; the next cell replaces it."""

    fliers: Mapping[str, executors.Flier]

    def __call__(self, stop: executors.Stop) -> Callable[[_Job], Iterable[run_folder.FlownEpisode]]:
        """Return the function that carries out a job."""
        loaded: tuple[str, executors.FlyEpisodes] | None = None

        def fly(job: _Job) -> Iterable[run_folder.FlownEpisode]:
            nonlocal loaded
            if loaded is None or loaded[0] != job.cell:
                loaded = None  # Memory may be too small for the networks of two cells.
                loaded = job.cell, self.fliers[job.cell].start(job.folder, stop)
            return loaded[1](job.episodes)

        return fly


class _OpenCell:
    """Cell in flight, with a locked folder and each flight saved when it ends."""

    def __init__(self, cell: Cell, out: Path | None, progress: Progress) -> None:
        self.cell = cell
        self.stack = ExitStack()
        with ExitStack() as stack:
            say = partial(progress.note, style="yellow")
            # Lock before reading: another process may be saving its last episode.
            stack.enter_context(nullcontext() if out is None else locked(out, say))
            self.folder, self.done = run_folder.open_folder(out, cell.name, cell.scenario, say)
            planned = len(cell.scenario.seeds)
            if self.done:
                progress.note(
                    f"{self.folder.path}: {len(self.done)} of {planned} episodes are there",
                    "yellow",
                )
            self._saver = stack.enter_context(EpisodeSaver(self.folder))
            self._tally = observer.Tally(progress, cell.title, self.folder.path, self.done, planned)
            stack.callback(self._tally.close)
            # Only a fully opened cell keeps its lock; an error before releases it.
            self.stack = stack.pop_all()
        self.episodes = {record.index: record for record in self.done}

    def add(self, episode: run_folder.FlownEpisode) -> None:
        """Save a finished episode."""
        record = episode.record
        self._saver.add(episode)
        self.episodes[record.index] = record
        self._tally.add(record)

    @property
    def complete(self) -> bool:
        """True if all episodes have been flown."""
        return len(self.episodes) == len(self.cell.scenario.seeds)

    def run(self) -> CellRun:
        """Return the results so far."""
        # Workers finish in any order; results are in the order of seeds.
        episodes = tuple(self.episodes[index] for index in sorted(self.episodes))
        return CellRun(self.cell, self.folder.path, episodes, len(episodes) - len(self.done))


def _run(
    paths: Mapping[str, Path | None],
    cells: Sequence[Cell],
    executor: executors.Executor,
    progress: Progress,
    stop: executors.Stop,
    tell: Callable[[CellRun], None] = lambda _: None,
) -> CampaignRun:
    """Fly the remaining episodes of cells with different flights, each into its folder."""
    opened: dict[str, _OpenCell] = {}
    error: str | None = None
    # A single cell has its own bar. Opening a cell finds its earlier flights.
    several = progress if len(cells) > 1 else Progress()
    planned = sum(len(cell.scenario.seeds) for cell in cells)
    with ExitStack() as stack:
        everything = several.bar(f"all {len(cells)} runs", planned, unit="flights")
        stack.callback(everything.close)

        def open_cell(cell: Cell) -> _OpenCell:
            nonlocal planned
            new = opened[cell.name] = _OpenCell(cell, paths[cell.name], progress)
            # Closes the cell at any exit, so no saved flight is lost.
            stack.push(new.stack)
            # Earlier flights do not count for the estimate of the remaining time.
            planned -= len(new.done)
            everything.update(total=planned)
            return new

        def close(cell: _OpenCell) -> None:
            cell.stack.close()
            tell(cell.run())

        def jobs() -> Iterator[_Job]:
            for cell in cells:
                flying = opened.get(cell.name) or open_cell(cell)
                left = cell.scenario.left(flying.done)
                if not left:
                    close(flying)
                    continue
                # Compile here, once, or every worker would compile the same kernels.
                first_start.compile_first([plan_of(cell.scenario)], progress, stop)
                size = len(left)
                # Executors that stream results take whole cells; others return a job's results at
                # its end.
                if not executor.streams:
                    size = cell.flier.episodes_per_job(len(left), executor.workers)
                # Workers may have another working directory.
                folder = run_folder.RunFolder(flying.folder.path.absolute())
                for i in range(0, len(left), size):
                    yield _Job(cell.name, folder, tuple(left[i : i + size]))

        def name(job: _Job) -> str:
            return job.seeds() if len(cells) == 1 else f"{job.cell}: {job.seeds()}"

        if cells:
            # Open the first cell even if no flights remain, to report its results.
            open_cell(cells[0])
        results = executor.run(
            jobs(),
            _Start({cell.name: cell.flier for cell in cells}),
            name=name,
            stop=stop,
            lost=partial(progress.note, style="yellow"),
            compiling=lambda begins: progress.status(compiling.COMPILING if begins else None),
        )
        try:
            # Stops the workers before the folders are closed.
            with closing(results):
                for job, episode in results:
                    flying = opened[job.cell]
                    flying.add(episode)
                    everything.advance()
                    if flying.complete:
                        close(flying)
        except executors.WorkerError as problem:
            error = str(problem)
    runs = [opened[cell.name].run() for cell in cells if cell.name in opened]
    complete = len(runs) == len(cells) and all(run.complete for run in runs)
    ended: live.Ended = "complete"
    if error is not None:
        ended = "broken off"
    # A stop after the last flight also counts: subsequent work must not start.
    elif not complete or stop():
        ended = "interrupted"
    return CampaignRun(tuple(runs), complete, ended, error)


SCHEMA = 1


@dataclass(frozen=True)
class DeclaredCell:
    """One evaluation or one training trial."""

    title: str
    settings: dict[str, Any] = field(default_factory=dict)
    """Settings of the flights or the training, which identify the cell."""
    folder: str | None = None
    """Cell with the same flights, whose folder is shared; None = a separate folder."""
    role: str = ""
    """Role in the comparison: `reference`, `target`, a latency, a level."""
    group: str = ""
    """Group of cells that are compared with each other."""


@dataclass(frozen=True)
class Declaration:
    """Contents of a campaign."""

    kind: str
    """Kind of experiment: hardware-gap, compare-levels, sweep, ..."""
    settings: dict[str, Any]
    cells: dict[str, DeclaredCell]
    """Cells by name, which is the name of the cell's folder."""

    def __post_init__(self) -> None:
        """Raise ValueError for a cell name that is not a valid folder name."""
        for name in self.cells:
            # A cell must not write outside the campaign's folder, or over its file.
            if Path(name).name != name or name in ("", "..", CAMPAIGN_FILE):
                raise ValueError(f"cell {name!r}: accepted: the name of a folder")


@dataclass(frozen=True)
class Campaign:
    """Content of `campaign.json`."""

    declaration: Declaration
    made: dict[str, Any]
    """Provenance at creation: `created_utc`, `command`, `versions`, `machine`, `git`."""
    schema: int = SCHEMA


_CAMPAIGN = TypeAdapter(Campaign)


def load_campaign(path: Path) -> Campaign:
    """Read the declaration of the campaign in a folder. Raises UsageError."""
    return files.read_typed(path / CAMPAIGN_FILE, _CAMPAIGN, SCHEMA, "campaign")


@contextmanager
def open_campaign(
    path: Path,
    declaration: Declaration,
    *,
    command: str,
    free: Collection[str] = (),
    growing: Collection[str] = (),
    mixed: bool = False,
    say: Callable[[str], None] = lambda _: None,
) -> Iterator[Campaign]:
    """Open and lock a campaign's folder, new or to resume; cells may be added or left for later.

    Settings in `free`, or in tables named there, may differ on resumption. Numeric cell settings in
    `growing` may grow. `mixed` accepts results of other code. `say` is called when another process
    has locked the folder. Raises UsageError for other content, changed settings or other code.
    """
    path = path.absolute()
    with locked(path, say):
        check_folder(path, CAMPAIGN_FILE)
        held = load_campaign(path) if (path / CAMPAIGN_FILE).exists() else None
        if held and (difference := _difference(held.declaration, declaration, free, growing)):
            raise errors.UsageError(
                f"--out {path}: holds a campaign with {difference}; accepted: another folder, or "
                "the same settings to go on"
            )
        if held:
            machine.check_code(f"--out {path}", held.made, mixed=mixed, say=say)
        campaign = Campaign(declaration, held.made if held else machine.provenance(command))
        # An unchanged file keeps its date.
        if campaign != held:
            files.write_json(path / CAMPAIGN_FILE, asdict(campaign))
        yield campaign


def _difference(
    held: Declaration, asked: Declaration, free: Collection[str], growing: Collection[str]
) -> str | None:
    """Return a description of the first difference, or None."""
    if held.kind != asked.kind:
        return f"kind = {held.kind!r}, not {asked.kind!r}"
    if difference := another_config(held.settings, asked.settings, free):
        return difference
    for name, cell in asked.cells.items():
        # New cells may join a campaign.
        if (theirs := held.cells.get(name)) is None:
            continue
        old, new = theirs.settings, cell.settings
        # More episodes continue a cell; fewer would contradict its folder.
        grown = {each for each in growing if old.get(each, 0) < new.get(each, 0)}
        if difference := another_config(old, new, {*free, *grown}):
            return f"another cell {name}: {difference}"
    return None
