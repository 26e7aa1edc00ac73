"""`airl-sitl`: the front door. Rehearses a policy in a simulated vehicle, through real MAVLink."""

from __future__ import annotations

import signal
from dataclasses import asdict
from typing import NoReturn

import tyro
from rich.console import Console

from airl_mav.cli.common import (
    EXIT_BROKEN,
    EXIT_INTERRUPTED,
    run_command,
)
from airl_mav.cli.sitl_command import ARRIVAL_SHARE, SitlCommand, check, wall_speed
from airl_mav.errors import UsageError
from airl_mav.flight.setup import Setup
from airl_mav.harness.episode import Plan, ProcessPlan
from airl_mav.harness.lockstep.errors import LockstepError
from airl_mav.harness.progress import RichObserver
from airl_mav.harness.rehearsal import Rehearsal, RehearsalError
from airl_mav.harness.run_folder import RunFolder
from airl_mav.ports import LOOPBACK
from companion.pilot import PilotSettings


def main() -> None:
    """Entry point of `airl-sitl`."""
    command = tyro.cli(SitlCommand, prog="airl-sitl")
    run_command(lambda: run(command))


def run(command: SitlCommand, console: Console | None = None) -> int:
    """Fly all episodes and write the report.

    Args:
        command: What was asked for.
        console: Where to print; None means standard output.

    Returns:
        Exit status: 0 all episodes flown, 1 a process died, 130 Ctrl-C.

    Raises:
        UsageError: The input cannot be used; nothing was flown.
    """
    console = console or Console()
    setup, pilot = check(command)
    signal.signal(signal.SIGTERM, _interrupt)
    folder = RunFolder.create(
        command.out,
        f"sitl-{setup.policy.name}",
        # As flown: what was left open is filled in.
        asdict(command)
        | {
            "hold": pilot.hold_s,
            "altitude": pilot.altitude_m,
            "goal_radius": pilot.goal_radius_m,
        },
        setup=setup,
        seeds=[command.seed + i for i in range(command.episodes)],
    )
    console.print(
        f"airl-sitl  {setup.vehicle.name} in {setup.arena.name}, policy {setup.policy.name}"
    )
    if command.lockstep:
        console.print("lockstep   one process, one simulated clock, MAVSDK on raw bytes")
    else:
        console.print(f"MAVSDK     udpin://{LOOPBACK}:{command.ports.api_port} (the companion's)")
        console.print(f"QGC        UDP port {command.ports.gcs_port} (connects by itself)")
    code = 0
    with RichObserver(console, command.episodes) as observer:
        try:
            if command.lockstep:
                _rehearse_in_lockstep(command, setup, pilot, folder, observer)
            else:
                with Rehearsal(plan(command, setup, pilot), folder, observer) as rehearsal:
                    rehearsal.run()
        except (RehearsalError, LockstepError) as error:
            console.print(f"error: {error}", style="red", markup=False, highlight=False)
            code = EXIT_BROKEN
        except KeyboardInterrupt:
            console.print("interrupted: what was flown is kept", style="yellow")
            code = EXIT_INTERRUPTED
        except UsageError:
            folder.discard()
            raise
        finally:
            folder.sweep()
    conclude(folder, console)
    return code


def plan(command: SitlCommand, setup: Setup, pilot: PilotSettings) -> Plan:
    """Turn the command into the arguments of the two processes."""
    ports, wind, watchdog = command.ports, command.wind, command.watchdog
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
    ]
    companion = [
        *("--control", "stdio"),
        *("--policy", command.policy, "--runtime", command.runtime),
        *("--threads", f"{command.threads}"),
        *("--computer", command.computer),
        *(("--workload", command.workload) if command.workload is not None else ()),
        *(("--latency", command.latency) if command.latency is not None else ()),
        *("--latency-seed", f"{command.latency_seed}"),
        *("--connect", f"udpin://{LOOPBACK}:{ports.api_port}"),
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
    )


def _rehearse_in_lockstep(
    command: SitlCommand,
    setup: Setup,
    pilot: PilotSettings,
    folder: RunFolder,
    observer: RichObserver,
) -> None:
    # Imported late: two processes of their own load the simulator otherwise.
    from airl_mav.cli.lockstep import lockstep_plan, policies
    from airl_mav.harness.lockstep.rehearsal import rehearse
    from firmware_sim.warm_up import warm_up

    observer.waiting("loading")
    planned = lockstep_plan(command, setup, pilot)
    warm_up(planned.vehicle)
    seeds = [command.seed + i for i in range(command.episodes)]
    rehearse(planned, seeds, policies(command, pilot.hold_s), folder, observer)


def conclude(folder: RunFolder, console: Console) -> None:
    """Print the tables and write the report of what was flown."""
    # Imported late: the figures take a second to load, and nobody waits for them before a flight.
    from airl_mav.report.rebuild import rebuild
    from airl_mav.report.terminal import print_report

    flown, page = rebuild(folder.path)
    if page is None:
        console.print(f"no episode was finished; logs in {folder.path}")
        return
    print_report(flown, console, page)


def _interrupt(*_: object) -> NoReturn:
    """Treat SIGTERM like Ctrl-C."""
    raise KeyboardInterrupt


if __name__ == "__main__":
    main()
