"""`airl-companion`: what runs on the drone's onboard computer."""

from __future__ import annotations

import signal
import threading

import tyro
from rich.console import Console

from airl_mav.cli import companion_lockstep
from airl_mav.cli.common import (
    EXIT_BROKEN,
    EXIT_INTERRUPTED,
    run_command,
)
from airl_mav.cli.companion_command import (
    CompanionCommand,
    check,
    load,
    lockstep_mission,
    open_camera,
    opened,
    sampler,
    watchdog_settings,
)
from airl_mav.cli.companion_service import serve
from airl_mav.core.clock import WallClock
from airl_mav.core.cpu_quota import held_to
from airl_mav.core.files import save_arrays
from airl_mav.scenario.model import PilotSettings
from companion.conducted import Abandoned
from companion.guard import ThreadGuard
from companion.interfaces import LinkError
from companion.mission import MissionResult, check_camera, fly_mission


def main() -> None:
    """Entry point of `airl-companion`."""
    command = tyro.cli(CompanionCommand, prog="airl-companion")
    run_command(lambda: serve(command) if command.control else stand_alone(command))


def stand_alone(command: CompanionCommand) -> int:
    """Fly one mission."""
    pilot = check(command)
    console = Console()
    clock = WallClock(command.speed)
    stop, abandon, interrupted = threading.Event(), threading.Event(), threading.Event()

    def interrupt(*_: object) -> None:
        interrupted.set()
        stop.set()

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, interrupt)
    if command.lockstep:
        return _alone_in_lockstep(command, pilot, stop, abandon, interrupted, console)
    policy = load(command, pilot)
    bounds = watchdog_settings(command)
    latency = sampler(command, command.seed)
    try:
        with (
            held_to(command.cpu_quota),
            opened(command, clock, abandon) as (link, frames),
        ):
            console.print(f"waiting for a flight controller on {command.connect}", markup=False)
            link.connect(command.connect_timeout, stop)
            check_camera(policy, frames, stop)
            result = fly_mission(
                link,
                frames,
                policy,
                command.goal,
                clock,
                stop,
                abandon,
                lambda phase: console.print(f"{clock.time_us() / 1e6:8.2f} s  {phase}"),
                pilot_settings=pilot,
                watchdog_settings=bounds,
                guard=ThreadGuard(clock),
                latency=latency,
            )
    except LinkError as error:
        console.print(f"error: {error}", style="red", markup=False)
        return EXIT_INTERRUPTED if interrupted.is_set() else EXIT_BROKEN
    return _conclude(command, result, interrupted, console)


def _alone_in_lockstep(
    command: CompanionCommand,
    pilot: PilotSettings,
    stop: threading.Event,
    abandon: threading.Event,
    interrupted: threading.Event,
    console: Console,
) -> int:
    """Fly one mission, taking turns with the simulator."""
    mission = lockstep_mission(command, pilot, load(command, pilot), command.goal, command.seed)
    console.print(f"waiting for a simulator on {command.connect}", markup=False)
    try:
        result, sha256 = companion_lockstep.fly(
            mission,
            command.connect,
            command.connect_timeout,
            lambda clock: open_camera(command.camera, clock),
            stop,
            abandon,
            lambda phase, time_us: console.print(f"{time_us / 1e6:8.2f} s  {phase}"),
        )
    except (LinkError, Abandoned) as error:
        console.print(f"error: {error}", style="red", markup=False, soft_wrap=True)
        return EXIT_INTERRUPTED if interrupted.is_set() else EXIT_BROKEN
    for name, digest in sha256.items():
        console.print(f"{name:<13} {digest}", highlight=False, soft_wrap=True)
    return _conclude(command, result, interrupted, console)


def _conclude(
    command: CompanionCommand,
    result: MissionResult,
    interrupted: threading.Event,
    console: Console,
) -> int:
    """Save the log and say how a mission ended; return the exit status."""
    if command.log is not None:
        save_arrays(command.log, result.log.columns())
    for note in result.notes:
        console.print(note, style="yellow", markup=False)
    console.print(f"{result.reason}; {len(result.log)} decisions")
    if result.reason == "goal reached":
        return 0
    return EXIT_INTERRUPTED if interrupted.is_set() else EXIT_BROKEN


if __name__ == "__main__":
    main()
