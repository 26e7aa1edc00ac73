"""Automatic disarming: after landing, without a take-off, or after a termination."""

from __future__ import annotations

import math
from collections.abc import Callable

from airl_mav.core.constants import US_PER_S
from firmware_sim.autopilot.autopilot_state import Mode
from firmware_sim.autopilot.commander import CommanderEvent, CommanderState, FlightPhase

_GROUND, _AIR = FlightPhase.GROUND, FlightPhase.AIR
_TERMINATION = Mode.TERMINATION


class AutoDisarm:
    """Timer for the time on the ground and the time since termination, in simulated time."""

    def __init__(self, value: Callable[[str], float]) -> None:
        """Store the look-up for PX4 parameters."""
        self._value = value
        self._standing_since_us: int | None = None
        self._stopped_since_us: int | None = None
        self._flown = False
        self.due_us = math.inf
        """Time of the next timeout if the flight does not change [µs]."""

    def armed(self) -> None:
        """Start a flight: earlier time on the ground does not count."""
        self._standing_since_us = None

    def event(self, flight: CommanderState, time_us: int, *, idle: bool) -> CommanderEvent | None:
        """Return the event of an expired timeout, or None.

        `idle`: the motors are stopped. Spool-up and take-off ramp do not count as ground time.
        """
        self.due_us = math.inf
        if flight.mode is _TERMINATION and flight.phase >= _GROUND:
            if self._stopped_since_us is None:
                self._stopped_since_us = time_us
            due_us = self._stopped_since_us + self._value("COM_KILL_DISARM") * US_PER_S
            if time_us >= due_us:
                return CommanderEvent.LOCKDOWN_TIMEOUT
            self.due_us = due_us
            return None
        self._stopped_since_us = None
        if flight.phase is not _GROUND:
            self._standing_since_us = None
            self._flown = flight.phase is _AIR
            return None
        if self._standing_since_us is None or not idle:
            self._standing_since_us = time_us
        limit_s = self._value("COM_DISARM_LAND" if self._flown else "COM_DISARM_PRFLT")
        due_us = self._standing_since_us + limit_s * US_PER_S
        self.due_us = due_us if limit_s > 0.0 and time_us < due_us else math.inf
        if limit_s > 0.0 and time_us >= due_us:
            return CommanderEvent.LANDED_TIMEOUT if self._flown else CommanderEvent.DISARM_TIMEOUT
        return None
