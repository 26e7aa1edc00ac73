"""Position: the sticks accelerate, and climb; released, the place is held."""

from __future__ import annotations

import math

from airl_mav.control.demand import AnyDemand, TrajectoryDemand
from airl_mav.core.frames import Vector, quat_yaw
from firmware_sim.autopilot.error_state import RATES, P, Q, V
from firmware_sim.autopilot.modes.altitude import LIFTING_THROTTLE
from firmware_sim.autopilot.modes.interface import (
    FlightContext,
    FlightMode,
    descend,
    since,
    triple,
)
from firmware_sim.autopilot.modes.stick_motion import HorizontalStick, VerticalStick, YawStick
from firmware_sim.autopilot.requests import Request


class Position(FlightMode):
    """Moves as the sticks say. Without a pilot's input it descends, level."""

    def __init__(self, context: FlightContext, /) -> None:
        self._context = context
        self._horizontal = HorizontalStick(context.value)
        self._vertical = VerticalStick(context.value)
        self._turning = YawStick(context.value)
        self._time_us: int | None = None
        self._yaw = 0.0

    @property
    def lifts(self) -> bool:
        """Whether the throttle stick is well above its centre."""
        sticks = self._context.sticks
        return sticks is not None and sticks.throttle > LIFTING_THROTTLE

    def enter(self, state: Vector, _request: Request | None, /) -> None:
        """Begin with the present motion."""
        north, east, down = triple(state, V)
        self._horizontal.restart((north, east))
        self._vertical.restart(state.item(P + 2), down)
        self._turning.restart()
        self._yaw, self._time_us = quat_yaw(state[Q:RATES]), None

    def demand(self, state: Vector, time_us: int, /) -> AnyDemand:
        """Follow the sticks."""
        sticks = self._context.sticks
        dt, self._time_us = since(self._time_us, time_us), time_us
        if sticks is None:
            yaw = self._yaw
            self.enter(state, None)
            self._yaw = yaw
            return descend(yaw)
        now = quat_yaw(state[Q:RATES])
        yaw, rate = self._turning.turn(sticks.yaw, now, dt)
        north, east, down = triple(state, P)
        heading = now if math.isnan(yaw) else yaw
        x, y = self._horizontal.move((sticks.pitch, sticks.roll), heading, (north, east), dt)
        z = self._vertical.move(sticks.throttle, down, self._context.height(state), dt)
        return TrajectoryDemand(
            (x.position, y.position, z.position),
            (x.velocity, y.velocity, z.velocity),
            (x.acceleration, y.acceleration, z.acceleration),
            yaw,
            rate,
        )
