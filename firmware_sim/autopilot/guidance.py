"""Turns the mode into a demand for the cascade; what each mode flies stands in `modes`."""

from __future__ import annotations

import math
from collections.abc import Callable

from airl_mav.control.cascade import Demand
from airl_mav.core.constants import GRAVITY_M_S2, US_PER_S
from airl_mav.core.frames import Vector
from firmware_sim.autopilot.autopilot_state import Mode
from firmware_sim.autopilot.commander import Phase
from firmware_sim.autopilot.error_state import P
from firmware_sim.autopilot.modes import MODES
from firmware_sim.autopilot.modes.interface import NAN, FlightContext, FlightMode, triple

# Bound once: looking up a member of an enumeration at every tick is slow.
_GROUND, _AIR = Phase.GROUND, Phase.AIR


class Guidance:
    """Flies the present mode; `enter` notifies it of mode changes.

    Every `state` is the estimator's newest nominal state (`error_state`).
    """

    def __init__(self, value: Callable[[str], float]) -> None:
        """Take a lookup of PX4 parameter names."""
        self.context = FlightContext(value)
        """What the modes share."""
        self._modes = {mode: new(self.context) for mode, new in MODES.items()}
        self._flown: FlightMode = self._modes[Mode.HOLD]
        self._spool_since_us: int | None = None

    def enter(self, mode: Mode, state: Vector) -> None:
        """Begin a new mode at the present state."""
        destination = self._flown.destination(state)
        self._flown = self._modes[mode]
        self._flown.enter(state, destination)

    def at_home(self, state: Vector) -> None:
        """Make the present position home: the ground under the vehicle at arming."""
        self.context.home = triple(state, P)
        self._spool_since_us = None

    def is_done(self, state: Vector) -> bool:
        """Return whether the present mode has reached its end."""
        return self._flown.is_done(state)

    def demand(self, state: Vector, phase: Phase, time_us: int) -> Demand | None:
        """Return what to fly now; None = the motors are stopped."""
        if phase is _AIR:
            self._spool_since_us = None
            return self._flown.demand(state, time_us)
        if phase is _GROUND and self._flown.lifts:
            return self._ramped(self._flown.demand(state, time_us), time_us)
        self._spool_since_us = None
        return None

    def _ramped(self, demand: Demand, time_us: int) -> Demand:
        """Return a demand for a vehicle on the ground, its climb rate limited by the take-off ramp.

        PX4's Takeoff: after COM_SPOOLUP_TIME the vertical speed limit rises in MPC_TKO_RAMP_T
        from the value that commands zero thrust to the take-off speed. A height becomes that rate.
        """
        if self._spool_since_us is None:
            self._spool_since_us = time_us
        value = self.context.value
        elapsed_s = (time_us - self._spool_since_us) / US_PER_S
        ramp_s = elapsed_s - value("COM_SPOOLUP_TIME")
        limit = -GRAVITY_M_S2 / value("MPC_Z_VEL_P_ACC")
        if ramp_s > 0.0:
            share = min(1.0, ramp_s / max(value("MPC_TKO_RAMP_T"), 1e-3))
            limit += share * (value("MPC_TKO_SPEED") - limit)
        # Off the floor, the climb goes on from the ramp.
        self.context.climb.restart(max(0.0, limit))
        position, velocity, yaw, yaw_rate = demand
        down = -limit if math.isnan(velocity[2]) else max(velocity[2], -limit)
        return Demand(
            (position[0], position[1], NAN), (velocity[0], velocity[1], down), yaw, yaw_rate
        )
