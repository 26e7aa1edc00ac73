"""Commander runtime: applies the table, user requests and failsafe decisions."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

from airl_mav.core import constants, frames
from firmware_sim.autopilot import commander
from firmware_sim.autopilot.autopilot_state import OperatorText, Result, Severity
from firmware_sim.autopilot.failsafes.framework import NO_INTERVENTION, Intervention, Supervisor
from firmware_sim.autopilot.flight_modes import Mode
from firmware_sim.autopilot.guidance import Guidance, Home
from firmware_sim.autopilot.modes.interface import ModeRequest
from firmware_sim.autopilot.navigation.navigator import Navigator
from firmware_sim.autopilot.sensor_monitor import NewestSensors

_GROUND, _AIR = commander.FlightPhase.GROUND, commander.FlightPhase.AIR
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

    def event(
        self, flight: commander.CommanderState, time_us: int, *, idle: bool
    ) -> commander.CommanderEvent | None:
        """Return the event of an expired timeout, or None.

        `idle`: the motors cannot lift the vehicle; spool-up and take-off ramp can.
        """
        self.due_us = math.inf
        if flight.mode is _TERMINATION and flight.phase >= _GROUND:
            # Termination has its own timeout, on the ground and in the air.
            if self._stopped_since_us is None:
                self._stopped_since_us = time_us
            due_us = self._stopped_since_us + self._value("COM_KILL_DISARM") * constants.US_PER_S
            if time_us >= due_us:
                return commander.CommanderEvent.LOCKDOWN_TIMEOUT
            self.due_us = due_us
            return None
        self._stopped_since_us = None
        if flight.phase is not _GROUND:
            self._standing_since_us = None
            self._flown = flight.phase is _AIR
            return None
        # Motors that run on the ground restart the time.
        if self._standing_since_us is None or not idle:
            self._standing_since_us = time_us
        # A landing and an unused arming have separate timeouts.
        limit_s = self._value("COM_DISARM_LAND" if self._flown else "COM_DISARM_PRFLT")
        due_us = self._standing_since_us + limit_s * constants.US_PER_S
        self.due_us = due_us if limit_s > 0.0 and time_us < due_us else math.inf
        if limit_s > 0.0 and time_us >= due_us:
            return (
                commander.CommanderEvent.LANDED_TIMEOUT
                if self._flown
                else commander.CommanderEvent.DISARM_TIMEOUT
            )
        return None


REFUSAL_US = 2 * constants.US_PER_S
"""Time within which a rejected setpoint explains the loss of offboard [µs]."""


class Commanded(NamedTuple):
    """Components that execute the commander's decisions."""

    supervisor: Supervisor
    guidance: Guidance
    navigator: Navigator
    auto_disarm: AutoDisarm
    home: Home


class FlightCommander:
    """Commander state and its changes by events."""

    def __init__(
        self,
        commanded: Commanded,
        newest: NewestSensors,
        state: frames.Vector,
        say: Callable[[OperatorText], None],
    ) -> None:
        """Boot.

        Args:
            commanded: Components that execute decisions.
            newest: Newest sensors, for the time.
            state: Nominal state of the estimator (`error_state`), updated in place.
            say: Sends a text to the operator.
        """
        self._commanded, self._newest, self._state, self._say = commanded, newest, state, say
        self.flight = commander.CommanderState()
        self.status = commander.status_of(self.flight)
        """Reported status of `flight`, replaced with every change."""
        self.refusal = ("", 0)
        """Reason and time [µs] of the last rejected offboard setpoint."""
        self.armed_us = self.takeoff_us = 0
        """Times of arming and take-off [µs]; 0 while disarmed."""

    _now_us = property(lambda self: self._newest.time_us)

    def look(self) -> None:
        """Run the failsafe checks and apply their decision."""
        supervisor = self._commanded.supervisor
        if not supervisor.is_unchanged(self._now_us, self.flight):
            sample = self._newest.sample
            for text in [] if sample is None else supervisor.look(sample, self.flight):
                self._say(text)
        self.obey(NO_INTERVENTION)

    def handle(
        self,
        event: commander.Ask | commander.CommanderEvent,
        request: ModeRequest | None = None,
        granted: OperatorText | None = None,
    ) -> Result:
        """Process an event.

        Args:
            event: Event or mode request.
            request: Optional arguments of a mode.
            granted: Text to send upon acceptance.
        """
        step = commander.transition(self.flight, event)
        # A text of the table takes precedence over the command's.
        text = granted if step.text is None and step.result is Result.ACCEPTED else step.text
        if text is not None:
            self._say(text)
        flown = self.flight.mode
        requested = isinstance(event, commander.Ask) and step.result is Result.ACCEPTED
        if requested and step.flight.phase >= _GROUND:
            # A failsafe may persist, or yield to the user.
            self._become(step.flight, step.flight.mode)
            self.obey(Intervention(mode_chosen=True), flown, request)
        else:
            self._become(step.flight, flown, request if requested else None)
        return step.result

    def _become(
        self, flight: commander.CommanderState, flown: Mode, request: ModeRequest | None = None
    ) -> None:
        """Set a new state; `flown` is the mode in guidance, `request` the user's."""
        before = self.flight
        self.flight, self.status = flight, commander.status_of(flight)
        if flight.failsafe and before.mode is Mode.OFFBOARD and not before.failsafe:
            self._explain_loss()
        if self._newest.sample is None:
            return
        self._commanded.guidance.context.armed = flight.phase >= _GROUND
        # A request may repeat the mode with another target.
        if flight.mode is not flown or request is not None:
            self._commanded.navigator.due_us = 0
            self._commanded.guidance.enter(flight.mode, self._state, request)
        # Phase changes need a check at once.
        if flight.phase is not before.phase:
            self._note_times(flight.phase)
            self._commanded.supervisor.next_us = 0
        # Arming: home and timers start here, and the mode starts again at this place.
        if before.phase < _GROUND <= flight.phase:
            self._commanded.auto_disarm.armed()
            self._commanded.home.armed()
            self._commanded.guidance.enter(flight.mode, self._state)

    def obey(
        self,
        intervention: Intervention,
        flown: Mode | None = None,
        request: ModeRequest | None = None,
    ) -> None:
        """Apply the failsafes' decision; see `_become`."""
        flown, requested = self.flight.mode if flown is None else flown, self.flight.mode
        decision = self._commanded.supervisor.decide(self._now_us, self.flight, intervention)
        if decision is None:
            return
        if decision.text is not None:
            self._say(decision.text)
        flight = decision.flight
        # A request belongs to its mode: another mode must not receive it.
        request = request if flight.mode is requested else None
        if flight != self.flight or flight.mode is not flown or request is not None:
            self._become(flight, flown, request)
        if decision.disarm:
            self.handle(commander.CommanderEvent.FAILSAFE_DISARM)

    def _note_times(self, phase: commander.FlightPhase) -> None:
        """Record the times of arming and take-off; reset both when disarmed."""
        now_us = self._now_us
        if phase < _GROUND:
            self.armed_us = self.takeoff_us = 0
        elif self.armed_us == 0:
            self.armed_us = now_us
        if phase is _AIR and self.takeoff_us == 0:
            self.takeoff_us = now_us

    def _explain_loss(self) -> None:
        """Report the reason of recently rejected setpoints."""
        reason, refused_us = self.refusal
        if reason and self._now_us - refused_us <= REFUSAL_US:
            self._say(OperatorText(Severity.WARNING, f"Offboard setpoints refused: {reason}"))
