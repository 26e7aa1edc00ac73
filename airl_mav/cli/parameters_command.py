"""`airl parameters`: export a vehicle's parameters to a file for real firmware."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from airl_mav.cli.options import POSITIONAL
from airl_mav.core import errors, fields, files
from airl_mav.profiles.vehicle import load_vehicle
from airl_mav.scenario.aircraft import DEFAULT_VEHICLE, VehicleName
from firmware_sim.external.programs import firmware_kind


class ParametersOptions(fields.ProfileModel):
    """Write the parameters that real firmware needs to fly a vehicle, for firmware that you start.

    For PX4, the file is for QGroundControl; for ArduPilot, for the option --defaults. airl-sitl
    sets these parameters on firmware that it starts.

    Examples:
        airl parameters px4-hitl --out quad.params
        airl parameters ardupilot --vehicle my-quad.toml
    """

    firmware: Annotated[Literal["px4", "px4-hitl", "ardupilot"], POSITIONAL] = Field(
        description="whose parameters"
    )
    vehicle: VehicleName = DEFAULT_VEHICLE
    out: Path | None = Field(default=None, description="file to write; by default printed")


OPTIONS = ParametersOptions


def run(options: ParametersOptions) -> int:
    """Write or print the parameters; return 0."""
    kind = firmware_kind(options.firmware)
    airframe = kind.airframe(load_vehicle(options.vehicle))
    text = kind.parameter_file({**airframe.frame, **airframe.settings})
    if options.out is None:
        sys.stdout.write(text)
        return 0
    if not options.out.parent.is_dir():
        raise errors.FieldError("out", f"{options.out}", problem=f"no folder {options.out.parent}")
    files.replace_file(options.out, text.encode())
    return 0
