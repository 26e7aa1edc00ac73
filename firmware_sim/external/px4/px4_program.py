"""PX4 SITL as a program: its location, start command and ports."""

from __future__ import annotations

import socket
from dataclasses import dataclass
from pathlib import Path

from airl_mav.core.constants import LOOPBACK
from airl_mav.core.errors import UsageError
from firmware_sim.external.process import StartCommand
from firmware_sim.interfaces import FirmwareMissingError

SIMULATOR_PORT = 4560
API_PORT, API_LOCAL_PORT = 14540, 14580
PAYLOAD_PORT, PAYLOAD_LOCAL_PORT = 14030, 14280
"""Ports of PX4's instance 0; other instances add their number (px4-rc.simulator, px4-rc.mavlink).
Instances above 9 share one API port."""

LOCAL_PORTS = (API_LOCAL_PORT, 18_570, PAYLOAD_LOCAL_PORT, 13_030)
"""UDP ports bound by instance 0: onboard API, ground station, payload, gimbal."""

MODEL = "none_iris"
"""PX4_SIM_MODEL that keeps PX4's scripts from starting another simulator."""

SCRIPT = "etc/init.d-posix/rcS"

UNAWAITED_THREADS = (b"commander", b"navigator", b"mavlink_if1", b"mavlink_if2")
"""Threads that affect a flight but that PX4 does not await before it answers a sample: modules with
a separate thread, and the links of companion and observer (px4-rc.mavlink starts 0 for the ground
station, 1 onboard, 2 for a payload, 3 for a gimbal). PX4 awaits the work queues, which run its
controllers and estimator."""

LAYOUTS = (".", "build/px4_sitl_default", "usr", "opt/px4")
"""Subfolders searched for bin/px4 and etc/: a build, a source tree, a package."""


@dataclass(frozen=True)
class Px4Program:
    """Executable of PX4 and its etc/ folder."""

    binary: Path
    etc: Path

    def start(self, instance: int, airframe: int, folder: Path) -> StartCommand:
        """Return the command to start an instance with an airframe (SYS_AUTOSTART)."""
        argv = [
            str(self.binary),
            *("-d", "-i", str(instance)),
            *("-w", str(folder), "-s", SCRIPT, str(self.etc)),
        ]
        return StartCommand(argv, environment(airframe))


def find_px4(folder: Path) -> Px4Program:
    """Return the PX4 of a build, source tree or unpacked package, or raise FirmwareMissingError."""
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
    """Return the environment variables for PX4's start-up script."""
    return {"PX4_SIM_MODEL": MODEL, "PX4_SYS_AUTOSTART": str(airframe)}


def how_to_start(instance: int, airframe: int) -> str:
    """Return the shell loop that restarts PX4 from its source tree after every flight."""
    variables = " ".join(f"{name}={value}" for name, value in environment(airframe).items())
    program = f"build/px4_sitl_default/bin/px4 -d -i {instance}"
    return f"while {variables} {program}; do sleep 1; done"


def check_free(instance: int) -> None:
    """Raise UsageError if a port required by PX4 or its bridge is taken."""
    simulator = (socket.SOCK_STREAM, LOOPBACK, SIMULATOR_PORT + instance)
    # PX4 binds its ports on all interfaces.
    links = ((socket.SOCK_DGRAM, "", port + instance) for port in LOCAL_PORTS)
    for kind, host, port in (simulator, *links):
        with socket.socket(socket.AF_INET, kind) as trial:
            if kind == socket.SOCK_STREAM:
                trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                trial.bind((host, port))
            except OSError as error:
                name = "TCP" if kind == socket.SOCK_STREAM else "UDP"
                raise UsageError(
                    f"{name} port {port}, which PX4 of instance {instance} needs, is taken "
                    "(another simulator, or airl-firmware?): choose another with --instance"
                ) from error
