"""PX4 SITL as a program: its location, start command and ports."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path

from firmware_sim.external.process import StartCommand
from firmware_sim.flight_controller import FirmwareMissingError

SIMULATOR_PORT = 4560
API_PORT, API_LOCAL_PORT = 14540, 14580
PAYLOAD_PORT, PAYLOAD_LOCAL_PORT = 14030, 14280
"""Ports of PX4's instance 0; each further one has the next (px4-rc.simulator, px4-rc.mavlink).
Instances above 9 share one API port."""

MODEL = "none_iris"
"""PX4_SIM_MODEL without which PX4's scripts would start a simulator of their own."""

SCRIPT = "etc/init.d-posix/rcS"

LAYOUTS = (".", "build/px4_sitl_default", "usr", "opt/px4")
"""Where below a folder bin/px4 and etc/ are looked for: a build, a source tree, a package."""


@dataclass(frozen=True)
class Px4Program:
    """An executable PX4."""

    binary: Path
    etc: Path
    """Folder of its start-up scripts."""

    def start(self, instance: int, airframe: int, folder: Path) -> StartCommand:
        """Return the command that starts it in a folder: in the background, without a shell.

        The instance number moves all its ports; `airframe` is its SYS_AUTOSTART.
        """
        argv = [
            str(self.binary),
            *("-d", "-i", str(instance)),
            *("-w", str(folder), "-s", SCRIPT, str(self.etc)),
        ]
        return StartCommand(argv, environment(airframe))


def find_px4(folder: Path) -> Px4Program:
    """Return the PX4 of a build, a source tree or an unpacked package.

    Raises FirmwareMissingError when there is none.
    """
    for layout in LAYOUTS:
        root = (folder / layout).resolve()
        binary, etc = root / "bin" / "px4", root / "etc"
        if binary.is_file() and (root / SCRIPT).is_file():
            return Px4Program(binary, etc)
    raise FirmwareMissingError(
        f"--px4-dir {folder}: no bin/px4 with {SCRIPT}: accepted: a build (build/px4_sitl_default "
        "after `make px4_sitl_default`), its source tree, or an unpacked package"
    )


def environment(airframe: int) -> dict[str, str]:
    """Return the environment variables that PX4's start-up script reads."""
    return {"PX4_SIM_MODEL": MODEL, "PX4_SYS_AUTOSTART": str(airframe)}


def how_to_start(instance: int, airframe: int) -> str:
    """Return the command with which a user starts a PX4 from its source tree."""
    words = [f"{name}={value}" for name, value in environment(airframe).items()]
    return " ".join([*words, "build/px4_sitl_default/bin/px4", "-i", shlex.quote(str(instance))])
