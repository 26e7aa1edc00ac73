"""One policy in one arena, flown at level gym or sitl, with what a person sees meanwhile."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from airl_mav.cli import report, sitl
from airl_mav.cli.common import EXIT_INTERRUPTED
from airl_mav.cli.evaluate_command import EvaluateCommand
from airl_mav.cli.evaluate_gym import plan_evaluation
from airl_mav.clock import utc_now
from airl_mav.envs.evaluation import Pilots
from airl_mav.errors import UsageError
from airl_mav.flight.judge import TIME_LIMIT_S, Outcome
from airl_mav.flight.record import EpisodeRecord
from airl_mav.harness.evaluation import GymPlan, another_config, fly_plan, open_folder
from airl_mav.harness.run_folder import RUN_FILE, load
from airl_mav.policy.registry import PolicyInfo, find_policy
from airl_mav.report.overview import write_overview
from airl_mav.report.rebuild import pictured_arenas
from companion.watchdog import WatchdogSettings

SAME_IN_SITL = ("policy", "arena", "vehicle", "computer", "workload", "episodes", "seed")
"""Settings by which a finished run of level sitl is known again."""


@dataclass(frozen=True)
class Result:
    """What was flown."""

    path: Path
    code: int
    """Exit status."""
    episodes: tuple[EpisodeRecord, ...]
    """All that the folder holds."""
    new: int
    """How many of them were flown now."""


@dataclass(frozen=True)
class Task:
    """One policy in one arena, checked and ready to fly."""

    policy: PolicyInfo
    arena: str
    rules: str
    """In words."""
    fly: Callable[[Path | None, Console], Result]
    """Flies what is left of it into a run folder; None: a new one."""

    @property
    def arena_name(self) -> str:
        """Name of the arena without its path."""
        return Path(self.arena).stem


def prepare(command: EvaluateCommand, policy: str, arena: str) -> Task:
    """Check everything that can be wrong before anything flies. Raises UsageError."""
    info = find_policy(policy)
    if command.level == "sitl":
        rehearsal = sitl_command(command, info, policy, arena)
        _, pilot = sitl.check(rehearsal)
        rules = pilot.goal_radius_m, pilot.hold_s, pilot.altitude_m, rehearsal.time_limit
        return Task(info, arena, _in_words(*rules), partial(_fly_sitl, rehearsal))
    plan, pilots = plan_evaluation(command, policy, arena)
    episode = plan.environment.episode
    rules = episode.goal_radius_m, episode.hold_s, episode.altitude_m, episode.time_limit_s
    return Task(info, arena, _in_words(*rules), partial(_fly_gym, plan, pilots))


def _in_words(radius_m: float, hold_s: float, altitude_m: float, limit_s: float) -> str:
    return (
        f"goal radius {radius_m:g} m, hold {hold_s:g} s, height {altitude_m:g} m, "
        f"time limit {limit_s:g} s"
    )


def _fly_gym(plan: GymPlan, pilots: Pilots, out: Path | None, console: Console) -> Result:
    """Fly what is left of a plan."""
    setup = plan.setup
    without = f"-no-{plan.config['ablate']}" if plan.config["ablate"] else ""
    label = f"evaluate-{setup.policy.name}{without}-{Path(setup.arena.name).stem}"
    folder, done = open_folder(out, label, plan)
    if done:
        console.print(
            f"{folder.path}: {len(done)} of {len(plan.seeds)} episodes are there",
            soft_wrap=True,
            markup=False,
            highlight=False,
        )
    flown: list[EpisodeRecord] = []
    title = f"{setup.policy.name} in {Path(setup.arena.name).stem}"
    with EpisodeBar(console, title, len(plan.seeds)) as bar, stop_on_signals() as stop:

        def finished(record: EpisodeRecord) -> None:
            flown.append(record)
            bar.finished(record)

        for record in done:
            finished(record)
        fly_plan(plan, folder, pilots, done, finished, stop)
    code = 0
    if len(flown) < len(plan.seeds):
        console.print(
            f"interrupted: what was flown is kept; --out {folder.path} goes on",
            style="yellow",
            soft_wrap=True,
            markup=False,
            highlight=False,
        )
        code = EXIT_INTERRUPTED
    episodes = tuple(sorted(flown, key=lambda record: record.index))
    return Result(folder.path, code, episodes, len(flown) - len(done))


def sitl_command(
    command: EvaluateCommand, policy: PolicyInfo, path: str, arena: str
) -> sitl.SitlCommand:
    """Return the rehearsal that an evaluation at level sitl is."""
    hover_s = command.hover_after
    if hover_s is None and policy.card is not None:
        hover_s = policy.card.hover_after_s
    return sitl.SitlCommand(
        vehicle=command.vehicle,
        arena=arena,
        policy=path,
        computer=command.computer,
        workload=command.workload,
        episodes=command.episodes,
        seed=command.seed,
        speed=command.speed,
        goal_radius=command.goal_radius,
        time_limit=TIME_LIMIT_S if command.time_limit is None else command.time_limit,
        hold=command.hold,
        altitude=command.altitude,
        watchdog=WatchdogSettings(hover_after_s=hover_s),
        ports=command.ports,
    )


def _fly_sitl(rehearsal: sitl.SitlCommand, out: Path | None, console: Console) -> Result:
    """Rehearse, unless the folder holds that very run already; show it."""
    name = find_policy(rehearsal.policy).name
    label = f"{utc_now():%Y%m%dT%H%M%SZ}-evaluate-{name}-{Path(rehearsal.arena).stem}-sitl"
    path = out or Path("runs") / label
    if (path / RUN_FILE).exists():
        _check_finished(path, rehearsal)
        report.run(report.ReportCommand(path), console)
        return Result(path, 0, load(path).episodes, 0)
    code = sitl.run(replace(rehearsal, out=path), console)
    run = load(path)
    if run.episodes:
        write_overview(run, pictured_arenas(run))
    return Result(path, code, run.episodes, len(run.episodes))


def _check_finished(path: Path, rehearsal: sitl.SitlCommand) -> None:
    """Raise UsageError unless a folder holds all episodes of a rehearsal."""
    run = load(path)
    wanted = {key: asdict(rehearsal)[key] for key in SAME_IN_SITL}
    held = {key: run.info.config.get(key) for key in SAME_IN_SITL}
    if (difference := another_config(held, wanted)) is not None:
        raise UsageError(f"--out {path}: holds a run with {difference}; accepted: a new folder")
    if len(run.episodes) < rehearsal.episodes:
        raise UsageError(
            f"--out {path}: {len(run.episodes)} of {rehearsal.episodes} episodes, and level sitl "
            "cannot go on; accepted: a new folder"
        )


class EpisodeBar:
    """A progress bar over the episodes, with the success rate so far."""

    def __init__(self, console: Console, title: str, episodes: int) -> None:
        self._progress = Progress(
            TextColumn(title, markup=False),
            BarColumn(bar_width=24),
            TextColumn("{task.completed:.0f}/{task.total:.0f}"),
            TimeElapsedColumn(),
            TextColumn("{task.fields[rate]}"),
            console=console,
            transient=True,
        )
        self._task = self._progress.add_task("episodes", total=episodes, rate="")
        self._flown = self._reached = 0

    def __enter__(self) -> EpisodeBar:
        """Start drawing, if there is somebody to see it."""
        if self._progress.console.is_interactive:
            self._progress.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Stop drawing."""
        if self._progress.console.is_interactive:
            self._progress.stop()

    def finished(self, record: EpisodeRecord) -> None:
        """Count an episode."""
        self._flown += 1
        self._reached += record.outcome is Outcome.SUCCESS
        rate = f"{100.0 * self._reached / self._flown:.1f} % reached the goal"
        self._progress.update(self._task, completed=self._flown, rate=rate)


@contextmanager
def stop_on_signals() -> Iterator[Callable[[], bool]]:
    """Give a function that says whether Ctrl-C or SIGTERM has come; a second one is not waited for.

    So nothing is torn: what has ended is saved before the command leaves.
    """
    seen: list[int] = []

    def note(number: int, _frame: object) -> None:
        if seen:
            raise KeyboardInterrupt
        seen.append(number)

    before = {number: signal.signal(number, note) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: bool(seen)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
