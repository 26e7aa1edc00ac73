"""Presence and start commands of real firmware, checked before heavy imports."""

from __future__ import annotations

import shlex

from airl_mav.profiles.vehicle import VehicleProfile
from airl_mav.scenario.aircraft import Aircraft, RealFirmware
from firmware_sim.external.ardupilot import ardupilot_program
from firmware_sim.external.ardupilot.ardupilot_program import find_arducopter
from firmware_sim.external.px4 import px4_program
from firmware_sim.external.px4.px4_program import find_px4


def check_program(real: RealFirmware) -> None:
    """Find the program to start. Raises UsageError if it does not exist."""
    if real.px4_dir is not None:
        find_px4(real.px4_dir)
    if real.ardupilot_dir is not None:
        find_arducopter(real.ardupilot_dir)


def load_timeout_s(aircraft: Aircraft) -> float | None:
    """Return the start-up timeout [wall s]; None = the timeout of any reply.

    It covers connection, heartbeat, parameters read and set, and ready to arm, one timeout each.
    """
    if aircraft.firmware == "builtin":
        return None
    return 30.0 + 5.0 * aircraft.real.firmware_timeout


def how_to_start(aircraft: Aircraft, vehicle: VehicleProfile) -> str | None:
    """Return the user's command to start the awaited firmware; None = no firmware is awaited."""
    real, ports = aircraft.real, aircraft.ports
    if real.px4_connect and vehicle.px4 is not None:
        return px4_program.how_to_start(real.instance, vehicle.px4.airframe)
    if real.ardupilot_connect:
        observer = ardupilot_program.OBSERVER_PORT + real.instance
        links = ardupilot_program.Links(ports.api_port, ports.gcs_port, observer)
        start = ardupilot_program.how_to_start(real.instance, links)
        file = shlex.join(["--vehicle", aircraft.vehicle, "--out", ardupilot_program.PARAMETERS])
        return f"airl parameters ardupilot {file} && {start}"
    return None
