"""Hold: brake, then stay there; or go to a place first."""

from __future__ import annotations

import math

from airl_mav.control.demand import AnyDemand, Demand
from airl_mav.core.frames import Vector
from airl_mav.vehicle.rotation import Vec
from firmware_sim.autopilot.climb import SETTLED_M
from firmware_sim.autopilot.error_state import P, V
from firmware_sim.autopilot.modes.interface import (
    FREE,
    NAN,
    FlightContext,
    FlightMode,
    here,
    triple,
)
from firmware_sim.autopilot.modes.takeoff import aim
from firmware_sim.autopilot.requests import ClimbOn, Place, Reposition, Request
from firmware_sim.autopilot.trajectory import Leg
from firmware_sim.autopilot.travel import stopping_place
from firmware_sim.engine.record import SETTLING

STANDING_M_S = 0.3
"""From this speed on the vehicle counts as at rest: hold keeps the place where it is [m/s]."""


class Hold(FlightMode):
    """Brakes, then holds the place where the vehicle came to rest."""

    def __init__(self, context: FlightContext, /) -> None:
        self._context = context
        self._place = Place((0.0, 0.0, 0.0), 0.0)
        self._braking = False
        self._travelling = False
        self._settling = False
        """Whether hold still climbs to the altitude of a take-off that has ended."""

    @property
    def is_steady(self) -> bool:
        """Whether it holds its place, or compiled ticks fly it there."""
        settling = self._settling and not self._context.climb.flies
        return not (self._travelling or settling or self._braking)

    @property
    def destination(self) -> Vec | None:
        """The place, once it is known."""
        return None if self._braking else self._place.position

    def enter(self, state: Vector, request: Request | None, /) -> None:
        """Begin: climb the rest of a take-off, go to a place, or brake here."""
        self._settling = isinstance(request, ClimbOn)
        self._travelling = isinstance(request, Reposition)
        self._braking = not (self._settling or self._travelling)
        if isinstance(request, ClimbOn):
            self._place = request.place
        elif isinstance(request, Reposition):
            self._go(request, state)
        else:
            self._place = here(state)

    def demand(self, state: Vector, time_us: int, /) -> AnyDemand:
        """Brake first, then hold the place where the vehicle came to rest."""
        if self._travelling:
            place = self._place
            leg = Leg(place.position)
            return self._context.travel.fly(state, time_us, leg, yaw=place.yaw)
        if self._settling and not self._context.climb.has_ended:
            return self._settle(time_us)
        if self._settling:
            self._settling = False
            self._context.climb.stop()
        if self._braking:
            self._place = self._place._replace(position=triple(state, P))
            if math.hypot(*triple(state, V)) > STANDING_M_S:
                return Demand(FREE, (0.0, 0.0, 0.0), self._place.yaw, NAN)
            self._braking = False
        return Demand(self._place.position, FREE, self._place.yaw, NAN)

    def _go(self, request: Reposition, state: Vector) -> None:
        """Begin the way to a place; what it leaves open stays as it is.

        Source: PX4 1.16, Navigator: with a new height alone the vehicle stays above its place;
        without anything it stops.
        """
        place, before = request.place, self._place
        held = before.position if not self._braking else stopping_place(state, self._context.value)
        now = triple(state, P)
        north, east, down = place.position
        if math.isnan(north) or math.isnan(east):
            north, east = held[0], held[1]
        if math.isnan(down):
            down = now[2]
        self._place = Place((north, east, down), place.yaw)
        if not math.isnan(request.speed_m_s):
            self._context.travel.speed_m_s = request.speed_m_s

    def _settle(self, time_us: int) -> Demand:
        """Return the demand between the end of a take-off and its altitude."""
        context, climb = self._context, self._context.climb
        aim(context)
        climb.fly(SETTLING, time_us)
        north, east, _ = self._place.position
        if abs(context.takeoff_altitude_m - climb.height_m) <= SETTLED_M:
            climb.stop(ended=True)
        return Demand(
            (north, east, context.home[2] - climb.height_m),
            (NAN, NAN, -climb.speed_m_s),
            self._place.yaw,
            NAN,
        )
