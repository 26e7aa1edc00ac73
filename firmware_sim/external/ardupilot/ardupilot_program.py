"""ArduCopter SITL as a program: its location, start command and ports."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from airl_mav.core.constants import LOOPBACK
from airl_mav.core.frames import HOME
from firmware_sim.external.parameter_file import ardupilot_file
from firmware_sim.external.process import StartCommand
from firmware_sim.interfaces import FirmwareMissingError

SIMULATOR_PORT, PORTS_PER_INSTANCE = 9002, 10
"""Port to which instance 0 sends its servo packets, and the step to the next instance (`-I`)."""

LAYOUTS = (".", "bin", "build/sitl/bin")
"""Subfolders searched for arducopter: the program's folder, a build, a source tree."""

PROGRAM = "arducopter"
OBSERVER_PORT = 14030
"""UDP port of the observer of an ArduPilot started by the user; plus one per instance."""

PARAMETERS = "vehicle.parm"


@dataclass(frozen=True)
class Links:
    """UDP ports on the loopback address to which ArduPilot's serial ports connect."""

    api: int
    """Port of the companion's MAVSDK (serial 0)."""
    gcs: int
    """Port of the ground station (serial 1)."""
    observer: int
    """Port of the observer (serial 2)."""


def find_arducopter(path: Path) -> Path:
    """Return the program at or below a path, or raise FirmwareMissingError."""
    if path.is_file():
        return path.resolve()
    for layout in LAYOUTS:
        program = (path / layout / PROGRAM).resolve()
        if program.is_file():
            return program
    raise FirmwareMissingError(
        f"--ardupilot-dir {path}: no {PROGRAM}: accepted: the program, its folder, or the source "
        "tree after `./waf configure --board sitl && ./waf copter`"
    )


def simulator_port(instance: int) -> int:
    """Return the UDP port of an instance's simulator."""
    return SIMULATOR_PORT + PORTS_PER_INSTANCE * instance


def command(program: str, instance: int, links: Links, defaults: str) -> list[str]:
    """Return program and arguments; `instance` shifts the port, `defaults` is a relative file."""
    home = f"{HOME.latitude_deg},{HOME.longitude_deg},{HOME.altitude_m},0"
    return [
        program,
        *("--model", f"JSON:{LOOPBACK}", "--sim-port-out", str(simulator_port(instance))),
        *(f"-I{instance}", "--wipe", "--speedup", "1", "--home", home, "--defaults", defaults),
        *("--serial0", f"udpclient:{LOOPBACK}:{links.api}"),
        *("--serial1", f"udpclient:{LOOPBACK}:{links.gcs}"),
        *("--serial2", f"udpclient:{LOOPBACK}:{links.observer}"),
    ]


def start(
    program: Path, instance: int, links: Links, settings: Mapping[str, float], folder: Path
) -> StartCommand:
    """Write the parameter file to the working folder; return the start command."""
    (folder / PARAMETERS).write_text(ardupilot_file(settings), encoding="ascii")
    return StartCommand(command(str(program), instance, links, PARAMETERS), {})


def how_to_start(instance: int, links: Links) -> str:
    """Return the user's command to start ArduCopter from its source tree."""
    return shlex.join(command(f"build/sitl/bin/{PROGRAM}", instance, links, PARAMETERS))
