"""One policy in one arena, flown at any level, with what a person sees meanwhile."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from rich.console import Console

from airl_mav.cli import sitl
from airl_mav.cli.common import EXIT_BROKEN, EXIT_INTERRUPTED
from airl_mav.cli.episode_bar import EpisodeBar, stop_on_signals
from airl_mav.cli.evaluate_command import EvaluateCommand
from airl_mav.cli.evaluate_gym import plan_evaluation
from airl_mav.cli.evaluate_lockstep import plan_lockstep
from airl_mav.cli.sitl_command import SitlCommand, check
from airl_mav.flight.judge import TIME_LIMIT_S
from airl_mav.flight.record import EpisodeRecord
from airl_mav.policy.registry import PolicyInfo, find_policy
from airl_mav.rehearsal.evaluation import Evaluation, Watch, open_folder
from airl_mav.rehearsal.evaluation_gym import fly_gym
from airl_mav.rehearsal.evaluation_lockstep import fly_lockstep
from airl_mav.rehearsal.lock import locked
from airl_mav.rehearsal.run_folder import RunFolder, load
from airl_mav.rehearsal.workers import WorkerError
from airl_mav.report.flights_above import write_overview
from airl_mav.report.run_report import pictured_arenas
from companion.watchdog import WatchdogSettings

FlyRest = Callable[[RunFolder, Sequence[EpisodeRecord], Watch], None]
"""Flies what is left into a folder that holds some episodes already."""


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
    if command.level == "gym":
        plan, pilots = plan_evaluation(command, policy, arena)
        episode = plan.environment.episode
        rules = episode.goal_radius_m, episode.hold_s, episode.altitude_m, episode.time_limit_s
        fly = partial(_fly, plan.evaluation, partial(fly_gym, plan, pilots))
        return Task(info, arena, _in_words(*rules), fly)
    rehearsal = sitl_command(command, info, policy, arena)
    if command.level == "lockstep":
        run, pilot = plan_lockstep(command, rehearsal)
        fly = partial(_fly, run.evaluation, partial(fly_lockstep, run))
    else:
        _, pilot = check(rehearsal)
        fly = partial(_fly_sitl, rehearsal)
    rules = pilot.goal_radius_m, pilot.hold_s, pilot.altitude_m, rehearsal.time_limit
    return Task(info, arena, _in_words(*rules), fly)


def _in_words(radius_m: float, hold_s: float, altitude_m: float, limit_s: float) -> str:
    return (
        f"goal radius {radius_m:g} m, hold {hold_s:g} s, height {altitude_m:g} m, "
        f"time limit {limit_s:g} s"
    )


def _fly(evaluation: Evaluation, fly_rest: FlyRest, out: Path | None, console: Console) -> Result:
    """Fly what is left of an evaluation, alone in its folder."""
    with locked(out, partial(_say, console)) if out is not None else nullcontext():
        return _fly_alone(evaluation, fly_rest, out, console)


def _fly_alone(
    evaluation: Evaluation, fly_rest: FlyRest, out: Path | None, console: Console
) -> Result:
    setup, config = evaluation.setup, evaluation.config
    arena = Path(setup.arena.name).stem
    without = f"-no-{config['ablate']}" if config["ablate"] else ""
    level = "" if setup.level == "gym" else f"-{setup.level}"
    label = f"evaluate-{setup.policy.name}{without}-{arena}{level}"
    folder, done = open_folder(out, label, evaluation)
    planned = len(evaluation.seeds)
    if done:
        _say(console, f"{folder.path}: {len(done)} of {planned} episodes are there")
    flown = list(done)
    broken = False
    title = f"{setup.policy.name} in {arena}"
    with EpisodeBar(console, title, done, planned) as bar, stop_on_signals() as stop:

        def finished(record: EpisodeRecord) -> None:
            flown.append(record)
            bar.finished(record)

        try:
            fly_rest(folder, done, Watch(finished, bar.say, stop))
        except WorkerError as error:
            _say(console, f"error: {error}", "red")
            broken = True
        # Also when the last flight had ended by then: what would come after it must not begin.
        stopped = stop()
    if left := len(flown) < planned:
        ended = "broken off" if broken else "interrupted"
        _say(console, f"{ended}: what was flown is kept; --out {folder.path} goes on", "yellow")
    episodes = tuple(sorted(flown, key=lambda record: record.index))
    code = EXIT_BROKEN if broken else EXIT_INTERRUPTED if left or stopped else 0
    return Result(folder.path, code, episodes, len(flown) - len(done))


def _say(console: Console, text: str, style: str | None = None) -> None:
    console.print(text, style=style, soft_wrap=True, markup=False, highlight=False)


def sitl_command(
    command: EvaluateCommand, policy: PolicyInfo, path: str, arena: str
) -> SitlCommand:
    """Return the rehearsal that an evaluation at level sitl or lockstep is."""
    hover_s = command.hover_after
    if hover_s is None and policy.card is not None:
        hover_s = policy.card.hover_after_s
    return SitlCommand(
        vehicle=command.vehicle,
        arena=arena,
        policy=path,
        computer=command.computer,
        workload=command.workload,
        latency=command.latency,
        latency_seed=command.latency_seed,
        arena_seed=command.arena_seed,
        episodes=command.episodes,
        seed=command.seed,
        lockstep=command.level == "lockstep",
        speed=command.speed,
        goal_radius=command.goal_radius,
        time_limit=TIME_LIMIT_S if command.time_limit is None else command.time_limit,
        hold=command.hold,
        altitude=command.altitude,
        watchdog=WatchdogSettings(hover_after_s=hover_s),
        ports=command.ports,
    )


def _fly_sitl(rehearsal: SitlCommand, out: Path | None, console: Console) -> Result:
    """Rehearse what is left."""
    name, arena = find_policy(rehearsal.policy).name, Path(rehearsal.arena).stem
    flown = sitl.fly(replace(rehearsal, out=out), console, f"evaluate-{name}-{arena}-sitl")
    run = load(flown.path)
    if flown.new:
        write_overview(run, pictured_arenas(run))
    return Result(flown.path, flown.code, run.episodes, flown.new)
