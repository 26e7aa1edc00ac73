"""Timers that watch a flight and raise commander events, all in simulated time."""

from __future__ import annotations

from collections.abc import Callable

from airl_mav.core.constants import US_PER_S
from firmware_sim.autopilot.autopilot_state import Message, Mode, Severity
from firmware_sim.autopilot.commander import Event, Flight, Phase

# Bound once: looking up a member of an enumeration takes as long as a whole timer.
_GROUND, _AIR, _OFFBOARD = Phase.GROUND, Phase.AIR, Mode.OFFBOARD

# COM_OBL_RC_ACT -> event. 1 and 2 (altitude, manual) need a pilot's input as 0 does; 6 is
# flight termination.
OFFBOARD_LOSS = {
    0: Event.SETPOINT_LOST_POSITION,
    1: Event.SETPOINT_LOST_POSITION,
    2: Event.SETPOINT_LOST_POSITION,
    3: Event.SETPOINT_LOST_RETURN,
    4: Event.SETPOINT_LOST_LAND,
    5: Event.SETPOINT_LOST_HOLD,
    6: Event.SETPOINT_LOST_DISARM,
    7: Event.SETPOINT_LOST_DISARM,
}

BATTERY_TEXT = {
    1: Message(Severity.WARNING, "Low battery level, return advised"),
    2: Message(Severity.CRITICAL, "Critical battery level, land now"),
    3: Message(Severity.EMERGENCY, "Dangerously low battery level! Land immediately!"),
}
"""By level: low, critical, emergency."""

BATTERY_ACTION = {
    (2, 2): Event.BATTERY_LAND,
    (2, 3): Event.BATTERY_RETURN,
    (3, 2): Event.BATTERY_LAND,
    (3, 3): Event.BATTERY_LAND,
}
"""By level and COM_LOW_BAT_ACT."""


class FailsafeTimers:
    """Watches the age of setpoints, the time on the ground, the battery, the ground station."""

    def __init__(self, value: Callable[[str], float]) -> None:
        """Take a lookup of PX4 parameter names."""
        self._value = value
        self._setpoint_us: int | None = None
        self._gcs_us: int | None = None
        self._gcs_lost = False
        self._standing_since_us: int | None = None
        self._flown = False
        self._battery_level = 0
        self._battery_acted = 0
        self._offboard_lost = False

    def armed(self) -> None:
        """A flight begins: time on the ground before it does not count."""
        self._standing_since_us = None
        # A flight that begins with a low battery triggers its action anew.
        self._battery_acted = 0

    def setpoint(self, time_us: int) -> None:
        """Note a valid offboard setpoint."""
        self._setpoint_us = time_us

    def gcs_heartbeat(self, time_us: int) -> None:
        """Note a ground station's heartbeat."""
        self._gcs_us = time_us

    def setpoint_fresh(self, time_us: int) -> bool:
        """Return whether the newest setpoint is younger than COM_OF_LOSS_T."""
        limit_us = self._value("COM_OF_LOSS_T") * US_PER_S
        return self._setpoint_us is not None and time_us - self._setpoint_us <= limit_us

    def events(
        self, flight: Flight, time_us: int, battery: float, *, idle: bool
    ) -> list[Event | Message]:
        """Return the events and texts that are due, in the order in which they take effect.

        `battery` is the state of charge 0..1. `idle`: the motors are stopped; the spool-up and the
        ramp of a take-off do not count as time on the ground.
        """
        due: list[Event | Message] = []
        self._offboard(flight, time_us, due)
        self._ground(flight, time_us, idle, due)
        self._battery(flight, battery, due)
        self._ground_station(time_us, due)
        return due

    def _offboard(self, flight: Flight, time_us: int, due: list[Event | Message]) -> None:
        if flight.phase < _GROUND or flight.intended is not _OFFBOARD:
            self._offboard_lost = False
            return
        fresh = self.setpoint_fresh(time_us)
        if not self._offboard_lost and flight.mode is _OFFBOARD and not fresh:
            self._offboard_lost = True
            due.append(OFFBOARD_LOSS[int(self._value("COM_OBL_RC_ACT"))])
        elif self._offboard_lost and fresh:
            self._offboard_lost = False
            due.append(Event.SETPOINT_BACK)

    def _ground(self, flight: Flight, time_us: int, idle: bool, due: list[Event | Message]) -> None:
        if flight.phase is not _GROUND:
            self._standing_since_us = None
            self._flown = flight.phase is _AIR
            return
        if self._standing_since_us is None or not idle:
            self._standing_since_us = time_us
        limit_s = self._value("COM_DISARM_LAND" if self._flown else "COM_DISARM_PRFLT")
        if limit_s > 0.0 and time_us - self._standing_since_us >= limit_s * US_PER_S:
            due.append(Event.LANDED_TIMEOUT if self._flown else Event.DISARM_TIMEOUT)

    def _battery(self, flight: Flight, remaining: float, due: list[Event | Message]) -> None:
        value = self._value
        below = (
            remaining <= value("BAT_LOW_THR"),
            remaining <= value("BAT_CRIT_THR"),
            remaining <= value("BAT_EMERGEN_THR"),
        )
        level = max(self._battery_level, below.count(True))
        if level > self._battery_level:
            self._battery_level = level
            due.append(BATTERY_TEXT[level])
        if flight.phase is not _AIR or level <= self._battery_acted:
            return
        self._battery_acted = level
        event = BATTERY_ACTION.get((level, int(value("COM_LOW_BAT_ACT"))))
        if event is not None:
            # The battery failsafe takes precedence: setpoints that come back must not end it.
            self._offboard_lost = False
            due.append(event)

    def _ground_station(self, time_us: int, due: list[Event | Message]) -> None:
        if self._gcs_us is None:
            return
        lost = time_us - self._gcs_us > self._value("COM_DL_LOSS_T") * US_PER_S
        if lost == self._gcs_lost:
            return
        self._gcs_lost = lost
        text = "Connection to ground station lost" if lost else "GCS connection regained"
        due.append(Message(Severity.INFO, text))
