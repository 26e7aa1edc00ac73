"""`airl parameters`: a vehicle's parameters as a file for real firmware."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping

from airl_mav.cli.parameters_command import ParametersCommand
from airl_mav.core.errors import UsageError
from airl_mav.core.files import replace_file
from airl_mav.profiles.vehicle import VehicleProfile, load_vehicle
from firmware_sim.external.airframe_check import (
    HITL_OUTPUT,
    SITL_OUTPUT,
    Airframe,
    ardupilot_airframe,
    px4_airframe,
)
from firmware_sim.external.parameter_client import Value
from firmware_sim.external.parameter_file import ardupilot_file, qgroundcontrol_file

Kind = tuple[Callable[[VehicleProfile], Airframe], Callable[[Mapping[str, Value]], str]]

KINDS: dict[str, Kind] = {
    "px4": (lambda vehicle: px4_airframe(vehicle, SITL_OUTPUT), qgroundcontrol_file),
    "px4-hitl": (lambda vehicle: px4_airframe(vehicle, HITL_OUTPUT), qgroundcontrol_file),
    "ardupilot": (ardupilot_airframe, ardupilot_file),
}
"""How the parameters are found, and written, by kind of firmware."""


def run(command: ParametersCommand) -> int:
    """Write or print the parameters; return the exit status."""
    airframe_of, file_of = KINDS[command.firmware]
    airframe = airframe_of(load_vehicle(command.vehicle))
    text = file_of({**airframe.frame, **airframe.settings})
    if command.out is None:
        sys.stdout.write(text)
        return 0
    if not command.out.parent.is_dir():
        raise UsageError(f"--out {command.out}: no folder {command.out.parent}")
    replace_file(command.out, text.encode())
    return 0
