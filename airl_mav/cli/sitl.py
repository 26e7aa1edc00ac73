"""`airl-sitl`: the front door. Rehearses a policy in a simulated vehicle, through real MAVLink."""

from __future__ import annotations

import signal
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, NoReturn

import tyro
from pydantic import BaseModel
from rich.console import Console

from airl_mav.cli.common import (
    EXIT_BROKEN,
    EXIT_INTERRUPTED,
    run_command,
)
from airl_mav.cli.evaluate_settings import fingerprint
from airl_mav.cli.firmware_options import api_port, arguments, how_to_start, load_timeout_s
from airl_mav.cli.sitl_command import ARRIVAL_SHARE, SitlCommand, check, wall_speed
from airl_mav.core.cpu_quota import remove_left
from airl_mav.core.errors import UsageError
from airl_mav.core.ports import LOOPBACK
from airl_mav.flight.setup import Setup
from airl_mav.lockstep.errors import LockstepError
from airl_mav.policy.registry import find_policy
from airl_mav.profiles.arena import ArenaSpec
from airl_mav.profiles.computer import load_computer
from airl_mav.profiles.loading import load_profile
from airl_mav.profiles.vehicle import load_vehicle
from airl_mav.rehearsal.episode import Plan, ProcessPlan
from airl_mav.rehearsal.evaluation import Evaluation, Job, open_folder
from airl_mav.rehearsal.lock import locked
from airl_mav.rehearsal.progress import RichObserver
from airl_mav.rehearsal.rehearsal import Rehearsal, RehearsalError
from airl_mav.rehearsal.run_folder import FIRMWARE_PRINTS, RUN_FILE, RunFolder
from companion.pilot import PilotSettings

LEAVES_RESULTS_ALONE = ("ports",)
"""Settings that may change when a run is taken up again."""

LEAVES_LOCKSTEP_ALONE = ("ports", "speed")
"""The same in lockstep. Paced by the wall clock, what this machine takes counts --speed times."""


def main() -> None:
    """Entry point of `airl-sitl`."""
    command = tyro.cli(SitlCommand, prog="airl-sitl")
    run_command(lambda: run(command))


@dataclass(frozen=True)
class Flown:
    """What a rehearsal has come to."""

    path: Path
    """Its run folder."""
    code: int
    """Exit status."""
    new: int
    """How many episodes were flown now."""


def run(command: SitlCommand, console: Console | None = None) -> int:
    """Fly what is left of the episodes and write the report.

    Args:
        command: What was asked for.
        console: Where to print; None means standard output.

    Returns:
        Exit status: 0 all episodes flown, 1 an episode was lost too often, 130 Ctrl-C.

    Raises:
        UsageError: The input cannot be used.
    """
    console = console or Console()
    flown = fly(command, console)
    conclude(flown.path, console)
    return flown.code


def fly(command: SitlCommand, console: Console, label: str | None = None) -> Flown:
    """Fly what is left of the episodes.

    Args:
        command: What was asked for.
        console: Where to print.
        label: Name of the run, and of its folder when none was asked for; None: after the policy.

    Raises:
        UsageError: The input cannot be used; what was flown before is kept.
    """
    setup, pilot = check(command)
    evaluation = Evaluation(
        setup,
        tuple(range(command.seed, command.seed + command.episodes)),
        settings(command, setup, pilot),
    )
    free = LEAVES_LOCKSTEP_ALONE if command.lockstep else LEAVES_RESULTS_ALONE
    known = command.out is not None and (command.out / RUN_FILE).exists()
    say = partial(_say, console, style="yellow")
    with ExitStack() as held, terminated_as_interrupted():
        if command.out is not None:
            # First of all: the processes of a run that was killed may be about to write.
            keeps = held.enter_context(locked(command.out, say))
        folder, done = open_folder(
            command.out,
            label or f"sitl-{setup.policy.name}",
            evaluation,
            free=free,
            may_grow=True,
        )
        if command.out is None:
            keeps = held.enter_context(locked(folder.path, say))
        if done:
            _say(console, f"{folder.path}: {len(done)} of {command.episodes} episodes are there")
        jobs = evaluation.jobs(done)
        if not jobs:
            return Flown(folder.path, 0, 0)
        _say_what_flies(command, setup, console)
        code = EXIT_BROKEN
        with RichObserver(console, command.episodes, len(done)) as observer:
            try:
                if command.lockstep:
                    _rehearse_in_lockstep(command, setup, pilot, jobs, folder, observer)
                else:
                    planned = plan(command, setup, pilot, folder.path)
                    with Rehearsal(planned, folder, observer, keeps=(keeps,)) as rehearsal:
                        rehearsal.run(done={record.index for record in done})
                code = 0
            except (RehearsalError, LockstepError) as error:
                _say(console, f"error: {error}", "red")
                say(f"broken off: {_kept(folder)}")
            except KeyboardInterrupt:
                say(f"interrupted: {_kept(folder)}")
                code = EXIT_INTERRUPTED
            except UsageError:
                if not known and not observer.finished_episodes:
                    folder.discard()
                raise
            finally:
                folder.sweep()
                if command.cpu_quota is not None:
                    remove_left()
        return Flown(folder.path, code, observer.finished_episodes)


def settings(command: SitlCommand, setup: Setup, pilot: PilotSettings) -> dict[str, Any]:
    """Return all that is written down of a run: what was left open is filled in.

    Profiles and policy by their content too: a name does not tell a changed one.
    """
    latency = setup.injection.latency
    profiles: dict[str, BaseModel] = {
        "vehicle": load_vehicle(command.vehicle),
        "arena": load_profile("arenas", command.arena, ArenaSpec),
        "computer": load_computer(command.computer),
        **({} if latency is None else {"latency": latency}),
    }
    asked = asdict(command)
    del asked["out"]
    return {
        **asked,
        "hold": pilot.hold_s,
        "altitude": pilot.altitude_m,
        "goal_radius": pilot.goal_radius_m,
        "speed": setup.speed,
        "policy_sha256": find_policy(command.policy).sha256,
        "profiles_sha256": {kind: fingerprint(profile) for kind, profile in profiles.items()},
    }


@contextmanager
def terminated_as_interrupted() -> Iterator[None]:
    """Treat SIGTERM as Ctrl-C for a while."""
    before = signal.signal(signal.SIGTERM, _interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _kept(folder: RunFolder) -> str:
    return f"what was flown is kept; --out {folder.path} goes on"


def _say(console: Console, text: str, style: str | None = None) -> None:
    console.print(text, style=style, soft_wrap=True, markup=False, highlight=False)


def _say_what_flies(command: SitlCommand, setup: Setup, console: Console) -> None:
    """Print what flies, and where to connect to it."""
    console.print(
        f"airl-sitl  {setup.vehicle.name} in {setup.arena.name}, policy {setup.policy.name}"
    )
    if command.lockstep:
        console.print("lockstep   one process, one simulated clock, MAVSDK on raw bytes")
        return
    port = api_port(command.firmware, command.real, command.ports)
    console.print(f"MAVSDK     udpin://{LOOPBACK}:{port} (the companion's)")
    console.print(f"QGC        UDP port {command.ports.gcs_port} (connects by itself)")
    if setup.level == "firmware":
        console.print(f"firmware   {setup.firmware}")
        hint = how_to_start(command, load_vehicle(command.vehicle))
        if hint is not None:
            _say(console, f"           start one for every flight: {hint}")


def plan(command: SitlCommand, setup: Setup, pilot: PilotSettings, folder: Path) -> Plan:
    """Turn the command into the arguments of the two processes of a run folder."""
    ports, wind, watchdog = command.ports, command.wind, command.watchdog
    port = api_port(command.firmware, command.real, ports)
    firmware = [
        *("--control", "stdio"),
        *("--vehicle", command.vehicle),
        *("--speed", f"{wall_speed(command)!r}"),
        # One word each: -1e-05 by itself would be taken for an option.
        *(f"--wind.north-m-s={wind.north_m_s!r}", f"--wind.east-m-s={wind.east_m_s!r}"),
        *(f"--wind.gust-m-s={wind.gust_m_s!r}", f"--wind.gust-time-s={wind.gust_time_s!r}"),
        *("--estimator", command.estimator),
        *("--api-port", f"{ports.api_port}", "--api-local-port", f"{ports.api_local_port}"),
        *("--gcs-port", f"{ports.gcs_port}", "--gcs-local-port", f"{ports.gcs_local_port}"),
        *("--camera-port", f"{ports.camera_port}"),
        *arguments(command.firmware, command.real),
    ]
    if command.firmware != "builtin":
        firmware += ["--firmware-log", str((folder / FIRMWARE_PRINTS).absolute())]
    companion = [
        *("--control", "stdio"),
        *("--policy", command.policy, "--runtime", command.runtime),
        *("--threads", f"{command.threads}"),
        *(("--cpu-quota", f"{command.cpu_quota!r}") if command.cpu_quota is not None else ()),
        *("--computer", command.computer),
        *(("--workload", command.workload) if command.workload is not None else ()),
        *(("--latency", command.latency) if command.latency is not None else ()),
        *("--latency-seed", f"{command.latency_seed}"),
        *("--connect", f"udpin://{LOOPBACK}:{port}"),
        *("--camera", f"tcp://{LOOPBACK}:{ports.camera_port}"),
        *("--speed", f"{wall_speed(command)!r}"),
        *("--hold-s", f"{pilot.hold_s!r}", "--altitude-m", f"{pilot.altitude_m!r}"),
        *("--goal-radius-m", f"{ARRIVAL_SHARE * pilot.goal_radius_m!r}"),
        *("--decision-timeout-s", f"{watchdog.decision_timeout_s!r}"),
        *("--leave-after-s", f"{watchdog.leave_after_s!r}"),
        *("--hover-after-s", f"{watchdog.hover_after_s!r}"),
    ]
    return Plan(
        firmware=ProcessPlan("airl_mav.cli.firmware", firmware),
        companion=ProcessPlan("airl_mav.cli.companion", companion),
        arena=command.arena,
        seed=command.seed,
        arena_seed=command.arena_seed,
        episodes=command.episodes,
        goal_radius_m=pilot.goal_radius_m,
        time_limit_s=command.time_limit,
        speed=wall_speed(command),
        computer_watts=setup.computer_watts,
        load_timeout_s=load_timeout_s(command.firmware, command.real),
    )


def _rehearse_in_lockstep(
    command: SitlCommand,
    setup: Setup,
    pilot: PilotSettings,
    jobs: Sequence[Job],
    folder: RunFolder,
    observer: RichObserver,
) -> None:
    # Imported late: two processes of their own load the simulator otherwise.
    from airl_mav.cli.lockstep import lockstep_plan, policies
    from airl_mav.lockstep.rehearsal import rehearse
    from firmware_sim.warm_up import warm_up

    observer.waiting("loading")
    planned = lockstep_plan(command, setup, pilot)
    warm_up(planned.vehicle)
    rehearse(planned, jobs, policies(command, pilot.hold_s), folder, observer)


def conclude(path: Path, console: Console) -> None:
    """Print the tables and write the report of what was flown."""
    # Imported late: the figures take a second to load, and nobody waits for them before a flight.
    from airl_mav.report.loading import load_run
    from airl_mav.report.run_report import print_report, write_report

    run = load_run(path)
    if not run.episodes:
        _say(console, f"no episode was finished; logs in {path}")
        return
    print_report(run, console, write_report(run))


def _interrupt(*_: object) -> NoReturn:
    """Treat SIGTERM like Ctrl-C."""
    raise KeyboardInterrupt


if __name__ == "__main__":
    main()
