"""Offboard: what the companion computer commands."""

from __future__ import annotations

import math

from airl_mav.control.demand import AnyDemand, Demand
from airl_mav.core.frames import Vector
from firmware_sim.autopilot.autopilot_state import Setpoint
from firmware_sim.autopilot.modes.hold import Hold
from firmware_sim.autopilot.modes.interface import FlightContext, FlightMode, triple
from firmware_sim.autopilot.requests import Request

CLIMBS_M_S = 0.1
"""A setpoint that asks to climb faster than this lifts a standing vehicle [m/s]."""

ABOVE_HOME_M = 0.3
"""So does one that lies this much above home [m]."""


class Offboard(FlightMode):
    """Flies the newest setpoint; holds as long as there was none."""

    def __init__(self, context: FlightContext, /) -> None:
        self._context = context
        self._waiting = Hold(context)
        self._setpoint: Setpoint | None = None
        self._flown: Demand | None = None

    @property
    def lifts(self) -> bool:
        """Whether the setpoint lies above the ground or goes up."""
        demand = self._newest()
        if demand is None:
            return False
        above = self._context.home[2] - ABOVE_HOME_M
        return demand.velocity[2] < -CLIMBS_M_S or demand.position[2] < above

    def enter(self, state: Vector, _request: Request | None, /) -> None:
        """Begin."""
        self._waiting.enter(state, None)

    def demand(self, state: Vector, time_us: int, /) -> AnyDemand:
        """Return what the companion commands."""
        return self._newest() or self._waiting.demand(state, time_us)

    def _newest(self) -> Demand | None:
        """Return the newest setpoint as a demand, made once."""
        setpoint = self._context.setpoint
        if setpoint is not None and setpoint is not self._setpoint:
            self._setpoint = setpoint
            north, east, down = triple(setpoint.velocity, 0)
            # An axis that is not commanded gets zero velocity.
            velocity = _or_zero(north), _or_zero(east), _or_zero(down)
            self._flown = Demand(
                triple(setpoint.position, 0), velocity, setpoint.yaw, setpoint.yaw_rate
            )
        return self._flown


def _or_zero(value: float) -> float:
    return 0.0 if math.isnan(value) else value
