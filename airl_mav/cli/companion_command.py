"""`airl-companion`, `airl companion`: companion program for the drone's onboard computer."""

from __future__ import annotations

import signal
import threading

from rich.console import Console

from airl_mav.cli.options import run_command
from airl_mav.core.addons import load_entry
from airl_mav.core.errors import EXIT_BROKEN, EXIT_INTERRUPTED
from airl_mav.core.files import save_arrays
from airl_mav.core.progress import new_console
from airl_mav.scenario.stand_alone import StandAloneCompanion
from companion.link_interface import LinkError
from companion.program import MissionSetup, check_on_ground, fly_alone, prepare
from companion.systemd import service
from companion.watchdog import Abandoned


class CompanionOptions(StandAloneCompanion):
    """Fly a policy from take-off to a goal, through MAVSDK.

    A first word that ends in .toml is a file of options, overridden by the command line.

    Examples:
        airl-companion --goal 20 5
        airl-companion companion.toml --goal 20 5
        airl-companion --connect serial:///dev/ttyAMA0:921600 --camera realsense --system-id 2
        airl-companion --check --camera realsense --policy policies/mine
        airl-companion --lockstep --goal 20 5     (with airl-firmware --lockstep)
    """


OPTIONS = CompanionOptions


def run(options: CompanionOptions, console: Console | None = None) -> int:
    """Fly one mission; return 0 if the goal was reached, else 1, or 130 after Ctrl-C."""
    console = console or new_console(soft_wrap=True)
    mission = prepare(options)
    stop, abandon, interrupted = threading.Event(), threading.Event(), threading.Event()

    def interrupt(*_: object) -> None:
        interrupted.set()
        stop.set()

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, interrupt)
    if options.check:
        return show_check(options, mission, stop, console)
    what = "simulator" if options.lockstep else "flight controller"

    def waiting() -> None:
        console.print(f"waiting for a {what} on {options.connect}")
        manager.tell(READY="1", STATUS=f"waiting for a {what} on {options.connect}")

    def progress(phase: str, time_us: int) -> None:
        console.print(f"{time_us / 1e6:8.2f} s  {phase}")
        manager.tell(STATUS=phase)

    sha256: dict[str, str] = {}
    try:
        with service() as manager:
            if options.lockstep:
                option = "lockstep", True
                fly = load_entry("airl_mav", "LOCKSTEP", "companion", option, "remote_lockstep")
                result, sha256 = fly(options, mission, stop, abandon, waiting, progress)
            else:
                result = fly_alone(options, mission, stop, abandon, waiting, progress)
            manager.tell(STATUS=result.reason)
    except (LinkError, Abandoned) as error:
        console.print(f"error: {error}", style="red")
        return EXIT_INTERRUPTED if interrupted.is_set() else EXIT_BROKEN
    for name, digest in sha256.items():
        console.print(f"{name:<13} {digest}", highlight=False)
    if options.log is not None:
        save_arrays(options.log, result.log.columns())
    for note in result.notes:
        console.print(note, style="yellow")
    console.print(f"{result.reason}; {len(result.log)} decisions")
    if result.reason == "goal reached":
        return 0
    return EXIT_INTERRUPTED if interrupted.is_set() else EXIT_BROKEN


def show_check(
    options: CompanionOptions, mission: MissionSetup, stop: threading.Event, console: Console
) -> int:
    """Print the findings of the ground check; return exit status 0 if all are good, else 1."""
    console.print(f"looking at {options.camera} and {options.connect}")
    good = True
    for finding in check_on_ground(options, mission, stop):
        good &= finding.good
        mark, colour = ("ok", "green") if finding.good else ("WRONG", "red")
        console.print(f"{finding.what:<18} {mark:<6} {finding.told}", style=colour)
    return 0 if good and not stop.is_set() else EXIT_BROKEN


if __name__ == "__main__":
    run_command("airl-companion", "airl_mav.cli.companion_command")
