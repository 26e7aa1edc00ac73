"""Changing the mode: by PX4's main and sub mode, or by a MAVLink standard mode."""

from __future__ import annotations

from firmware_sim.autopilot.autopilot_state import Message, Result
from firmware_sim.mavlink.codec import dialect
from firmware_sim.mavlink.px4_custom_mode import requested_mode
from firmware_sim.mavlink.services.command import Action, Command
from firmware_sim.mavlink.services.context import Context
from firmware_sim.mavlink.streams.flight_modes import KNOWN

_CUSTOM: int = dialect.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED


def change_mode(base: int, main: int, sub: int, context: Context) -> Result:
    """Change the mode as DO_SET_MODE asks: MAV_MODE_FLAG bits, main and sub mode."""
    request = requested_mode(base, main, sub)
    if isinstance(request, Message):
        context.announce(request)
        return Result.TEMPORARILY_REJECTED
    return Result.ACCEPTED if request is None else context.port.set_mode(request)


def _set_standard_mode(command: Command, context: Context) -> Result:
    """Parameter 1: MAV_STANDARD_MODE; FAILED for one that a multicopter does not have."""
    asked = command.integer(1) or 0
    if asked != dialect.MAV_STANDARD_MODE_NON_STANDARD:
        for known in KNOWN:
            if known.standard == asked:
                return change_mode(_CUSTOM, known.main, known.sub, context)
    return Result.FAILED


ACTIONS: dict[int, Action] = {
    dialect.MAV_CMD_DO_SET_STANDARD_MODE: _set_standard_mode,
}
