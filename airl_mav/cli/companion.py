"""`airl-companion`, `airl companion`: what runs on the drone's onboard computer."""

from __future__ import annotations

import signal
import threading

from rich.console import Console

from airl_mav.cli.options import run_command
from airl_mav.core.errors import EXIT_BROKEN, EXIT_INTERRUPTED
from airl_mav.core.files import save_arrays
from airl_mav.scenario.stand_alone import StandAloneCompanion
from companion.conducted import Abandoned
from companion.interfaces import LinkError
from companion.program import fly_alone, prepare


class CompanionOptions(StandAloneCompanion):
    """Fly a policy from take-off to a goal, through MAVSDK.

    Examples:
        airl-companion --goal 20 5
        airl-companion --connect serial:///dev/ttyAMA0:921600 --camera tcp://192.168.1.10:5600
        airl-companion --lockstep --goal 20 5     (with airl-firmware --lockstep)
    """


OPTIONS = CompanionOptions


def run(options: CompanionOptions, console: Console | None = None) -> int:
    """Fly one mission.

    Exit status: 0 the goal was reached, 1 it was not, 130 Ctrl-C.
    """
    console = console or Console(soft_wrap=True)
    mission = prepare(options)
    stop, abandon, interrupted = threading.Event(), threading.Event(), threading.Event()

    def interrupt(*_: object) -> None:
        interrupted.set()
        stop.set()

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, interrupt)
    what = "simulator" if options.lockstep else "flight controller"

    def waiting() -> None:
        console.print(f"waiting for a {what} on {options.connect}", markup=False)

    def progress(phase: str, time_us: int) -> None:
        console.print(f"{time_us / 1e6:8.2f} s  {phase}")

    sha256: dict[str, str] = {}
    try:
        if options.lockstep:
            # Imported here: a companion on a drone needs nothing of it.
            from airl_mav.lockstep.token_companion import fly_in_lockstep

            result, sha256 = fly_in_lockstep(options, mission, stop, abandon, waiting, progress)
        else:
            result = fly_alone(options, mission, stop, abandon, waiting, progress)
    except (LinkError, Abandoned) as error:
        console.print(f"error: {error}", style="red", markup=False)
        return EXIT_INTERRUPTED if interrupted.is_set() else EXIT_BROKEN
    for name, digest in sha256.items():
        console.print(f"{name:<13} {digest}", highlight=False)
    if options.log is not None:
        save_arrays(options.log, result.log.columns())
    for note in result.notes:
        console.print(note, style="yellow", markup=False)
    console.print(f"{result.reason}; {len(result.log)} decisions")
    if result.reason == "goal reached":
        return 0
    return EXIT_INTERRUPTED if interrupted.is_set() else EXIT_BROKEN


if __name__ == "__main__":
    run_command("airl-companion", "airl_mav.cli.companion")
