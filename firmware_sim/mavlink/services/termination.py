"""MAV_CMD_DO_FLIGHTTERMINATION: stop the motors for good."""

from __future__ import annotations

from firmware_sim.autopilot.autopilot_state import Result
from firmware_sim.mavlink.services.command import Command
from firmware_sim.mavlink.services.context import Context

TERMINATE_FROM = 0.5
"""Parameter 1 must exceed this; a termination cannot be undone (PX4: DENIED)."""


def terminate(command: Command, context: Context) -> Result:
    """Carry it out: DENIED where the vehicle is not armed, as PX4."""
    wanted = command.params[0] > TERMINATE_FROM
    return context.port.terminate() if wanted else Result.DENIED
