"""ArduCopter SITL as a program: its location, start command and ports."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from airl_mav.core import constants, frames
from airl_mav.profiles.vehicle import CORNERS, Corner, VehicleProfile
from airl_mav.scenario.aircraft import Aircraft, RealFirmware
from firmware_sim.external import launcher, parameters, programs
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
    home = f"{frames.HOME.latitude_deg},{frames.HOME.longitude_deg},{frames.HOME.altitude_m},0"
    return [
        program,
        *("--model", f"JSON:{constants.LOOPBACK}", "--sim-port-out", str(simulator_port(instance))),
        *(f"-I{instance}", "--wipe", "--speedup", "1", "--home", home, "--defaults", defaults),
        *("--serial0", f"udpclient:{constants.LOOPBACK}:{links.api}"),
        *("--serial1", f"udpclient:{constants.LOOPBACK}:{links.gcs}"),
        *("--serial2", f"udpclient:{constants.LOOPBACK}:{links.observer}"),
    ]


def start(
    program: Path, instance: int, links: Links, settings: Mapping[str, float], folder: Path
) -> launcher.StartCommand:
    """Write the parameter file to the working folder; return the start command."""
    (folder / PARAMETERS).write_text(ardupilot_file(settings), encoding="ascii")
    return launcher.StartCommand(command(str(program), instance, links, PARAMETERS), {})


def ardupilot_file(settings: Mapping[str, parameters.Value]) -> str:
    """Return a file in ArduPilot's format: `--defaults` of its SITL, Mission Planner, MAVProxy."""
    return "".join(f"{name} {value:g}\n" for name, value in settings.items())


_ARDUPILOT_MOTOR_1 = 33
"""ArduPilot's SERVOn_FUNCTION of motor 1."""

_ARDUPILOT_QUAD_X: Mapping[int, Corner] = dict(enumerate(CORNERS, start=1))
"""Corner of each motor of ArduCopter's quad X: AP_MotorsMatrix, MOTOR_FRAME_TYPE_X."""


def ardupilot_airframe(vehicle: VehicleProfile) -> parameters.RequiredAirframe:
    """Return a quad by ArduCopter's frame class, type and outputs; else FirmwareMissingError."""
    copter = vehicle.ardupilot
    if copter is None:
        raise parameters.no_table("ardupilot")
    kind = {"FRAME_CLASS": copter.frame_class, "FRAME_TYPE": copter.frame_type}
    return parameters.RequiredAirframe(
        "ArduPilot",
        copter.motors,
        frame={
            f"SERVO{i + 1}_FUNCTION": _ARDUPILOT_MOTOR_1 + CORNERS.index(copter.motors[i])
            for i in range(len(copter.motors))
        },
        # With no_time_sync ArduPilot's default is 10: the true state in place of an estimate.
        settings={"AHRS_EKF_TYPE": 3.0, **kind, **copter.parameters},
        problem=partial(_ardupilot_problem, copter.motors, kind),
    )


def _ardupilot_problem(
    motors: Sequence[Corner], kind: Mapping[str, int], held: Mapping[str, parameters.Value]
) -> str | None:
    for name, expected in kind.items():
        if held[name] != expected:
            return f"ArduPilot's {name} is {held[name]}, the vehicle's {expected}: wrong frame"
    for output, corner in enumerate(motors, start=1):
        function = int(held[f"SERVO{output}_FUNCTION"])
        found = _ARDUPILOT_QUAD_X.get(function - _ARDUPILOT_MOTOR_1 + 1)
        if found != corner:
            return (
                f"ArduPilot's output {output} (SERVO{output}_FUNCTION = {function}) turns "
                f"{'no motor' if found is None else 'the motor ' + found}, the vehicle's is "
                f"{corner}: wrong motor order"
            )
    return None


def _check_arducopter(real: RealFirmware) -> None:
    if real.ardupilot_dir is not None:
        find_arducopter(real.ardupilot_dir)


def _how_to_start(aircraft: Aircraft, _: VehicleProfile) -> str | None:
    """Return the user's command to start ArduCopter from its source tree."""
    real, ports = aircraft.real, aircraft.ports
    if not real.ardupilot_connect:
        return None
    links = Links(ports.api_port, ports.gcs_port, OBSERVER_PORT + real.instance)
    start = shlex.join(command(f"build/sitl/bin/{PROGRAM}", real.instance, links, PARAMETERS))
    file = shlex.join(["--vehicle", aircraft.vehicle, "--out", PARAMETERS])
    return f"airl parameters ardupilot {file} && {start}"


ARDUPILOT = programs.FirmwareKind(
    airframe=ardupilot_airframe,
    parameter_file=ardupilot_file,
    parts="firmware_sim.addons.ardupilot.bridge:ardupilot_parts",
    check_program=_check_arducopter,
    how_to_start=_how_to_start,
)
