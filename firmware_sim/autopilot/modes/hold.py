"""Hold: brake and hold position, or fly to a place first."""

from __future__ import annotations

import math

from airl_mav.control.demand import AnyDemand, Demand
from airl_mav.core.frames import Vector
from airl_mav.vehicle.rotation import Vec
from firmware_sim.autopilot.climb import SETTLED_M
from firmware_sim.autopilot.error_state import P, V
from firmware_sim.autopilot.flight_modes import Mode
from firmware_sim.autopilot.modes.interface import (
    FREE,
    NAN,
    FlightContext,
    FlightMode,
    here,
    triple,
)
from firmware_sim.autopilot.modes.takeoff import aim
from firmware_sim.autopilot.requests import ClimbOn, ModeRequest, PositionYaw, Reposition
from firmware_sim.autopilot.smooth_trajectory import PathSegment, stopping_place
from firmware_sim.engine.record import SETTLING

STANDING_M_S = 0.3
"""Speed below which the vehicle counts as stopped, and Hold keeps the position [m/s]."""


class Hold(FlightMode, modes=(Mode.HOLD,)):
    """Hold mode: brakes, then holds the position of the stop."""

    def __init__(self, context: FlightContext, /) -> None:
        self._context = context
        self._place = PositionYaw((0.0, 0.0, 0.0), 0.0)
        self._braking = False
        self._travelling = False
        self._settling = False
        """True if Hold still climbs to the altitude of an ended take-off."""

    @property
    def is_steady(self) -> bool:
        """True if Hold keeps its position, or compiled ticks fly to it."""
        settling = self._settling and not self._context.climb.flies
        return not (self._travelling or settling or self._braking)

    @property
    def destination(self) -> Vec | None:
        """Hold position, once known."""
        return None if self._braking else self._place.position

    def enter(self, state: Vector, request: ModeRequest | None, /) -> None:
        """Start: finish a take-off climb, fly to a place, or brake."""
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
        """Brake first, then hold the position of the stop."""
        if self._travelling:
            place = self._place
            leg = PathSegment(place.position)
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
        """Start the flight to a place; NaN coordinates keep their current value.

        Source: PX4 1.16, Navigator: a new height alone keeps the horizontal position; an empty
        request stops the vehicle.
        """
        place, before = request.place, self._place
        held = before.position if not self._braking else stopping_place(state, self._context.value)
        now = triple(state, P)
        north, east, down = place.position
        if math.isnan(north) or math.isnan(east):
            north, east = held[0], held[1]
        if math.isnan(down):
            down = now[2]
        self._place = PositionYaw((north, east, down), place.yaw)
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
