"""Return: climb to RTL_RETURN_ALT, fly home, land."""

from __future__ import annotations

import math

from airl_mav.control.cascade import Demand
from airl_mav.core.frames import Vector
from firmware_sim.autopilot.error_state import P
from firmware_sim.autopilot.modes.interface import (
    NAN,
    FlightContext,
    FlightMode,
    Place,
    here,
    over,
    triple,
)
from firmware_sim.autopilot.modes.land import landing_speed

HEIGHT_REACHED_M = 0.2
"""The climb of a return ends this close to its height [m]."""

HOME_REACHED_M = 0.5
"""From this close to home the vehicle descends [m]."""


class ReturnToLaunch(FlightMode):
    """Climbs, flies home and lands there."""

    def __init__(self, context: FlightContext, /) -> None:
        self._context = context
        self._place = Place((0.0, 0.0, 0.0), 0.0)
        self._leg = 0
        """0 = climb, 1 = fly home, 2 = land."""

    def enter(self, state: Vector, _destination: Place | None, /) -> None:
        """Begin with the climb."""
        self._place, self._leg = here(state), 0

    def demand(self, state: Vector, _time_us: int, /) -> Demand:
        """Fly the present leg, and on to the next when it is over."""
        value, home = self._context.value, self._context.home
        position = triple(state, P)
        north, east = position[0] - home[0], position[1] - home[1]
        away = math.hypot(north, east)
        if self._leg == 0:
            height = self._context.height(state)
            target = max(value("RTL_RETURN_ALT"), height)
            if height > target - HEIGHT_REACHED_M or away < value("NAV_ACC_RAD"):
                self._leg = 1
                self._place = self._place._replace(position=position)
            down = home[2] - target - 0.5
            limit = value("MPC_Z_VEL_MAX_UP")
            return over(
                self._place, min(limit, max(-limit, value("MPC_Z_P") * (down - position[2])))
            )
        if self._leg == 1:
            if away > HOME_REACHED_M:
                cruise = min(value("MPC_XY_CRUISE"), value("MPC_XY_P") * away)
                velocity = (-north / away * cruise, -east / away * cruise, NAN)
                return Demand((NAN, NAN, self._place.position[2]), velocity, self._place.yaw, NAN)
            self._leg = 2
            # Almost at rest: descend to home itself.
            self._place = self._place._replace(position=home)
        return over(self._place, landing_speed(value, self._context.height(state)))
