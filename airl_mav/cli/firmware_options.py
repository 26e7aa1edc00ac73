"""Which flight controller flies: the built-in one, or real firmware. Shared by two commands."""

from __future__ import annotations

import shlex
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal, Protocol

from airl_mav.cli.common import check_range
from airl_mav.core.errors import UsageError
from airl_mav.flight.setup import BUILT_IN
from airl_mav.profiles.vehicle import VehicleProfile
from airl_mav.scenario.model import Ports
from firmware_sim.external.ardupilot import program as ardupilot_program
from firmware_sim.external.px4 import program as px4_program

FirmwareName = Literal["builtin", "px4", "ardupilot", "px4-hitl"]

TITLES: dict[FirmwareName, str] = {
    "builtin": BUILT_IN,
    "px4": "PX4 SITL",
    "ardupilot": "ArduPilot SITL",
    "px4-hitl": "PX4 on a board",
}

GREATEST_INSTANCE = 9


@dataclass(frozen=True)
class RealFirmwareOptions:
    """Real firmware: what to start, or how to reach what the user started."""

    px4_dir: Path | None = None
    """With --firmware px4: start this PX4 for every flight; a SITL build, its source tree or an
    unpacked package."""

    px4_connect: bool = False
    """With --firmware px4: wait for a PX4 that you start, one for every flight."""

    ardupilot_dir: Path | None = None
    """With --firmware ardupilot: start this ArduCopter for every flight; a SITL build or its source
    tree, or the program itself."""

    ardupilot_connect: bool = False
    """With --firmware ardupilot: wait for an ArduCopter that you start, one for every flight."""

    instance: int = 0
    """With PX4 or ArduPilot SITL: instance number, 0 to 9; moves all ports of theirs as their own
    -i and -I do."""

    serial: str | None = None
    """With --firmware px4-hitl: serial device of the board: /dev/ttyACM0."""

    baud: int = 921_600
    """With --serial: bits a second; USB takes no notice of it."""

    firmware_timeout: float = 60.0
    """Longest wait for real firmware to connect, and for each of its answers before take-off, s of
    wall time."""

    firmware_dir: Path | None = None
    """Keep what real firmware leaves (parameters, flight logs), a folder a flight, in this one.
    None: it is removed."""


NEEDS = {
    "px4": ("px4_dir", "px4_connect"),
    "ardupilot": ("ardupilot_dir", "ardupilot_connect"),
    "px4-hitl": ("serial",),
}
"""Exactly one of these options comes with each kind of real firmware."""


def option_of(name: str) -> str:
    """Return an option as it is typed."""
    return "--" + name.replace("_", "-")


class FirmwareWords(Protocol):
    """What a command line says of the flight controller."""

    @property
    def vehicle(self) -> str:
        """Its profile."""
        ...

    @property
    def firmware(self) -> FirmwareName:
        """Which one."""
        ...

    @property
    def real(self) -> RealFirmwareOptions:
        """How a real one is reached."""
        ...

    @property
    def ports(self) -> Ports:
        """Of all links."""
        ...

    @property
    def lockstep(self) -> bool:
        """Whether simulated time waits for the companion."""
        ...

    @property
    def speed(self) -> float | str | None:
        """Multiple of real time; None = as usual."""
        ...


def check_firmware(command: FirmwareWords) -> None:
    """Check what is asked of a flight controller. Raises UsageError."""
    firmware, options = command.firmware, command.real
    given = {name for name, value in asdict(options).items() if value not in (None, False)}
    for kind, names in NEEDS.items():
        mine = [name for name in names if name in given]
        if kind != firmware and mine:
            raise UsageError(f"{option_of(mine[0])}: accepted: with --firmware {kind}")
        if kind == firmware and len(mine) != 1:
            wanted = " or ".join(option_of(name) for name in names)
            raise UsageError(f"--firmware {firmware}: accepted: with {wanted}")
    check_range("--instance", options.instance, 0, GREATEST_INSTANCE)
    check_range("--baud", options.baud, 9_600, 12_000_000)
    check_range("--firmware-timeout", options.firmware_timeout, 1.0, 3600.0)
    if firmware == "builtin":
        return
    if command.lockstep:
        raise UsageError(
            f"--firmware {firmware} with --lockstep: accepted: without; only the built-in autopilot"
            " and its companion share one simulated clock"
        )
    if firmware == "px4-hitl" and command.speed not in (None, 1.0):
        raise UsageError(
            f"--speed {command.speed} with --firmware px4-hitl: accepted: 1, a board's own pace"
        )
    if firmware == "px4" and (moved := _moved(command.ports)):
        raise UsageError(
            f"{moved}: PX4 SITL has ports of its own: accepted: --instance moves them all"
        )


def api_port(firmware: FirmwareName, options: RealFirmwareOptions, ports: Ports) -> int:
    """Return the UDP port that a companion listens on for the flight controller."""
    return ports.api_port + (options.instance if firmware == "px4" else 0)


def arguments(firmware: FirmwareName, options: RealFirmwareOptions) -> list[str]:
    """Return the words that hand these options to another command that takes them."""
    words = ["--firmware", firmware]
    for name, value in asdict(options).items():
        if value is True:
            words.append(option_of(name))
        elif value not in (None, False):
            word = str(value.absolute()) if isinstance(value, Path) else f"{value}"
            words += [option_of(name), word]
    return words


def _moved(ports: Ports) -> str | None:
    """Return the first option of the MAVLink ports that is not at its default."""
    usual = asdict(Ports())
    for name, value in asdict(ports).items():
        if name != "camera_port" and value != usual[name]:
            return f"{option_of(name)} {value}"
    return None


def load_timeout_s(firmware: FirmwareName, options: RealFirmwareOptions) -> float | None:
    """Return how long a harness waits until the vehicle stands ready [wall s]; None: as usual.

    To connect, a heartbeat, the parameters read and set, ready to arm: each within the time-out.
    """
    return None if firmware == "builtin" else 30.0 + 5.0 * options.firmware_timeout


def check_program(options: RealFirmwareOptions) -> None:
    """Look for the program that is to be started. Raises UsageError when there is none."""
    if options.px4_dir is not None:
        px4_program.find_px4(options.px4_dir)
    if options.ardupilot_dir is not None:
        ardupilot_program.find_arducopter(options.ardupilot_dir)


def how_to_start(command: FirmwareWords, vehicle: VehicleProfile) -> str | None:
    """Return the command with which the user starts what is waited for; None: nothing is."""
    options, ports = command.real, command.ports
    if options.px4_connect and vehicle.px4 is not None:
        return px4_program.how_to_start(options.instance, vehicle.px4.airframe)
    if options.ardupilot_connect:
        observer = ardupilot_program.OBSERVER_PORT + options.instance
        links = ardupilot_program.Links(ports.api_port, ports.gcs_port, observer)
        start = ardupilot_program.how_to_start(options.instance, links)
        file = shlex.join(["--vehicle", command.vehicle, "--out", ardupilot_program.PARAMETERS])
        return f"airl parameters ardupilot {file} && {start}"
    return None
