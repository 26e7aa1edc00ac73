"""Hold: brake, then stay there."""

from __future__ import annotations

import math

from airl_mav.control.cascade import Demand
from airl_mav.core.frames import Vector
from firmware_sim.autopilot.error_state import P, V
from firmware_sim.autopilot.modes.interface import (
    FREE,
    NAN,
    FlightContext,
    FlightMode,
    Place,
    here,
    triple,
)
from firmware_sim.autopilot.modes.takeoff import climb_on

SETTLED_M = 0.01
"""From this close to it, the take-off altitude is held like any other [m]."""

STANDING_M_S = 0.3
"""From this speed on the vehicle counts as at rest: hold keeps the place where it is [m/s]."""


class Hold(FlightMode):
    """Brakes, then holds the place where the vehicle came to rest."""

    def __init__(self, context: FlightContext, /) -> None:
        self._context = context
        self._place = Place((0.0, 0.0, 0.0), 0.0)
        self._braking = False
        self._settling = False
        """Whether hold still climbs to the altitude of a take-off that has ended."""

    def enter(self, state: Vector, destination: Place | None, /) -> None:
        """Begin; a take-off that ended near its altitude is climbed to its end."""
        self._settling, self._braking = destination is not None, destination is None
        self._place = here(state) if destination is None else destination

    def demand(self, state: Vector, time_us: int, /) -> Demand:
        """Brake first, then hold the place where the vehicle came to rest."""
        if self._settling:
            return self._settle(time_us)
        if self._braking:
            self._place = self._place._replace(position=triple(state, P))
            if math.hypot(*triple(state, V)) > STANDING_M_S:
                return Demand(FREE, (0.0, 0.0, 0.0), self._place.yaw, NAN)
            self._braking = False
        return Demand(self._place.position, FREE, self._place.yaw, NAN)

    def _settle(self, time_us: int, /) -> Demand:
        """Return the demand between the end of a take-off and its altitude."""
        context, climb = self._context, self._context.climb
        climb_on(context, time_us, near_ground=False)
        north, east, _ = self._place.position
        self._settling = abs(context.takeoff_altitude_m - climb.height_m) > SETTLED_M
        return Demand(
            (north, east, context.home[2] - climb.height_m),
            (NAN, NAN, -climb.speed_m_s),
            self._place.yaw,
            NAN,
        )
