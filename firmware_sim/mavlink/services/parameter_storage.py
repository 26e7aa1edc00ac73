"""PREFLIGHT_STORAGE: parameters loaded from where they are kept, saved, and reset.

Source: PX4 1.16, Commander::handle_command.
"""

from __future__ import annotations

from firmware_sim.autopilot.autopilot_state import Arming, Result
from firmware_sim.mavlink.codec import dialect
from firmware_sim.mavlink.services.command import Action, Command
from firmware_sim.mavlink.services.context import Context

_LOAD, _SAVE, _RESET, _RESET_SENSORS, _FACTORY_RESET = range(5)


def _store(command: Command, context: Context) -> Result | None:
    """Parameter 1: what is done; PX4 does not acknowledge what it does not know."""
    if context.port.state().status.arming is Arming.ARMED:
        return Result.TEMPORARILY_REJECTED
    parameters = context.port.parameters
    asked = command.integer(1)
    if asked in (_RESET, _FACTORY_RESET):
        parameters.reset()
    elif asked == _LOAD:
        return Result.ACCEPTED if parameters.load() else Result.FAILED
    elif asked == _SAVE:
        return Result.ACCEPTED if parameters.save() else Result.FAILED
    elif asked != _RESET_SENSORS:  # which have no calibration that could be reset
        return None
    return Result.ACCEPTED


ACTIONS: dict[int, Action] = {dialect.MAV_CMD_PREFLIGHT_STORAGE: _store}
