"""`airl-firmware`, `airl firmware`: flight controller, vehicle and camera, for any client."""

from __future__ import annotations

import signal
import threading

from rich.console import Console

from airl_mav.cli.options import run_command
from airl_mav.core.addons import load_entry
from airl_mav.core.errors import EXIT_BROKEN
from airl_mav.core.first_start import compile_shown
from airl_mav.core.frames import Goal
from airl_mav.core.progress import new_console
from airl_mav.lockstep.turns import LockstepError
from airl_mav.profiles import arena, loading
from airl_mav.rehearsal.firmware_process import Listener, aircraft_of, fly_vehicle
from airl_mav.scenario import resolve, stand_alone
from firmware_sim.autopilot.autopilot_state import OperatorText
from firmware_sim.interfaces import FirmwareLostError


class FirmwareOptions(stand_alone.StandAloneVehicle):
    """Run the flight controller with its vehicle, until Ctrl-C.

    Examples:
        airl-firmware --arena static-obstacles --seed 3
        airl-firmware --speed max --duration 60
        airl-firmware --lockstep          (with airl-companion --lockstep)
        airl-firmware --firmware px4 --px4-dir ~/PX4-Autopilot
    """


OPTIONS = FirmwareOptions


def run(options: FirmwareOptions, console: Console | None = None) -> int:
    """Fly until Ctrl-C or, in lockstep, the companion's end; return 1 for a lost connection."""
    console = console or new_console(soft_wrap=True)
    vehicle, _ = aircraft_of(options)
    loading.load_profile("arenas", options.arena, arena.ArenaSpec)  # refused before kernels compile
    compile_shown([resolve.flight_plan(vehicle, options.plant)])
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    fly = fly_vehicle
    if options.lockstep:
        fly = load_entry("airl_mav", "LOCKSTEP", "firmware", ("lockstep", True), "remote_lockstep")
    try:
        fly(options, stop, _listener(options, console))
    except (FirmwareLostError, LockstepError) as error:
        console.print(f"error: {error}", style="red")
        return EXIT_BROKEN
    return 0


def _listener(options: FirmwareOptions, console: Console) -> Listener:
    def say(line: str) -> None:
        console.print(line, highlight=False)

    def ready(camera: str, goal: Goal) -> None:
        say(f"MAVSDK            udpin://{options.companion_host}:{options.companion_port}")
        if not options.lockstep and options.firmware != "attach":
            say(f"QGroundControl    UDP port {options.ports.gcs_port} (connects by itself)")
            if options.firmware == "builtin":
                ports = options.open_ports
                say(
                    f"system            {options.real.instance + 1}, listens on UDP ports"
                    f" {ports.api_local_port} (onboard) and {ports.gcs_local_port} (ground)"
                )
        say(f"depth camera      {camera}")
        if options.firmware != "builtin":
            say(f"firmware          {resolve.FIRMWARE_TITLES[options.firmware]}")
        # In lockstep all digits matter.
        metres = " ".join(repr(m) if options.lockstep else f"{m:.1f}" for m in goal)
        say(f"goal              {metres} (north east{' down' if len(goal) == 3 else ''}, m)")
        if options.lockstep:
            say("waiting for a companion that passes turns. Ctrl-C ends it.")
        else:
            say("Ctrl-C ends it.")

    def text(message: OperatorText) -> None:
        say(f"[{message.severity.name.lower()}] {message.text}")

    return Listener(lambda hint: say(f"waiting for {hint}"), ready, text, say)


if __name__ == "__main__":
    run_command("airl-firmware", "airl_mav.cli.firmware_command")
