"""Kinds of real firmware, and PX4 SITL as a program; light, as options are checked first.

PX4 is built in. Add-ons register other kinds in the table `FIRMWARE`.
"""

from __future__ import annotations

import socket
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from airl_mav.core import addons, constants, errors
from airl_mav.profiles.vehicle import VehicleProfile
from airl_mav.scenario.aircraft import Aircraft, RealFirmware
from firmware_sim.external import launcher, parameters
from firmware_sim.interfaces import FirmwareMissingError


@dataclass(frozen=True)
class FirmwareKind:
    """Kind of real firmware: a value of `--firmware`."""

    airframe: Callable[[VehicleProfile], parameters.RequiredAirframe]
    """Return the configuration that a vehicle requires, or raise FirmwareMissingError."""
    parameter_file: Callable[[Mapping[str, parameters.Value]], str]
    """Return a file with parameters for the firmware's tools."""
    parts: str
    """Function that binds the ports of a `flight_stack.FirmwareRequest`, as `module:name`."""
    behind_us: int = 0
    """Delay of ticks that follow a vehicle elsewhere [µs]; 0 = the vehicle is simulated here."""
    check_program: Callable[[RealFirmware], object] = lambda _real: None
    """Find the program to start. Raises UsageError if it does not exist."""
    how_to_start: Callable[[Aircraft, VehicleProfile], str | None] = lambda _asked, _vehicle: None
    """Return the user's command to start the awaited firmware; None = no firmware is awaited."""


def firmware_kind(name: str) -> FirmwareKind:
    """Return a kind of real firmware by its name. Raises FieldError without its add-on."""
    if name == "px4":
        return PX4
    option = "firmware", name
    kind: FirmwareKind = addons.load_entry(
        "firmware_sim", "FIRMWARE", name, option, name.replace("-", "_")
    )
    return kind


def check_program(aircraft: Aircraft) -> None:
    """Find the program to start. Raises UsageError if it does not exist."""
    if aircraft.firmware != "builtin":
        firmware_kind(aircraft.firmware).check_program(aircraft.real)


def behind_us(aircraft: Aircraft) -> int:
    """Return the delay of ticks that follow a vehicle elsewhere [µs]; 0 = simulated here."""
    return 0 if aircraft.firmware == "builtin" else firmware_kind(aircraft.firmware).behind_us


def load_timeout_s(aircraft: Aircraft) -> float | None:
    """Return the start-up timeout [wall s]; None = the timeout of any reply.

    It covers connection, heartbeat, parameters read and set, and ready to arm, one timeout each.
    """
    if aircraft.firmware == "builtin":
        return None
    return 30.0 + 5.0 * aircraft.real.firmware_timeout


def how_to_start(aircraft: Aircraft, vehicle: VehicleProfile) -> str | None:
    """Return the user's command to start the awaited firmware; None = no firmware is awaited."""
    if aircraft.firmware == "builtin":
        return None
    return firmware_kind(aircraft.firmware).how_to_start(aircraft, vehicle)


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

    def start(self, instance: int, airframe: int, folder: Path) -> launcher.StartCommand:
        """Return the command to start an instance with an airframe (SYS_AUTOSTART)."""
        argv = [
            str(self.binary),
            *("-d", "-i", str(instance)),
            *("-w", str(folder), "-s", SCRIPT, str(self.etc)),
        ]
        return launcher.StartCommand(argv, environment(airframe))


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


def check_free(instance: int) -> None:
    """Raise UsageError if a port required by PX4 or its bridge is taken."""
    simulator = (socket.SOCK_STREAM, constants.LOOPBACK, SIMULATOR_PORT + instance)
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
                raise errors.UsageError(
                    f"{name} port {port}, which PX4 of instance {instance} needs, is taken "
                    "(another simulator, or airl-firmware?): choose another with --instance"
                ) from error


def _check_px4(real: RealFirmware) -> None:
    if real.px4_dir is not None:
        find_px4(real.px4_dir)


def _how_to_start_px4(aircraft: Aircraft, vehicle: VehicleProfile) -> str | None:
    """Return the shell loop that restarts PX4 from its source tree after every flight."""
    if not aircraft.real.px4_connect or vehicle.px4 is None:
        return None
    settings = environment(vehicle.px4.airframe)
    variables = " ".join(f"{name}={value}" for name, value in settings.items())
    program = f"build/px4_sitl_default/bin/px4 -d -i {aircraft.real.instance}"
    return f"while {variables} {program}; do sleep 1; done"


PX4 = FirmwareKind(
    airframe=partial(parameters.px4_airframe, output=parameters.SITL_OUTPUT),
    parameter_file=parameters.qgroundcontrol_file,
    parts="firmware_sim.external.px4_sitl:px4_parts",
    check_program=_check_px4,
    how_to_start=_how_to_start_px4,
)
