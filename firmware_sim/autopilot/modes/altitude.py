"""Altitude: the sticks tilt, and climb; released, the height is held and the vehicle drifts."""

from __future__ import annotations

import math

from airl_mav.control.demand import AnyDemand, TrajectoryDemand
from airl_mav.core.constants import DEG, GRAVITY_M_S2
from airl_mav.core.frames import Vector, quat_yaw
from firmware_sim.autopilot.error_state import RATES, P, Q, V
from firmware_sim.autopilot.modes.interface import (
    FREE,
    NAN,
    FlightContext,
    FlightMode,
    descend,
    since,
    triple,
)
from firmware_sim.autopilot.modes.stick_motion import VerticalStick, YawStick
from firmware_sim.autopilot.requests import Request

LIFTING_THROTTLE = 0.3
"""From this deflection on a standing vehicle takes off: PX4's 65 % of the stick's way."""


class Altitude(FlightMode):
    """Tilts as the sticks say. Without a pilot's input it descends, level."""

    def __init__(self, context: FlightContext, /) -> None:
        self._context = context
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
        self._vertical.restart(state.item(P + 2), state.item(V + 2))
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
        down = triple(state, P)[2]
        height = self._context.height(state)
        vertical = self._vertical.move(sticks.throttle, down, height, dt)
        tilt = min(89.0, self._context.value("MPC_MAN_TILT_MAX")) * DEG
        most = min(3.0, max(0.02, math.tan(tilt))) * GRAVITY_M_S2
        length = max(1.0, math.hypot(sticks.pitch, sticks.roll))
        forward, right = sticks.pitch / length * most, sticks.roll / length * most
        heading = now if math.isnan(yaw) else yaw
        c, s = math.cos(heading), math.sin(heading)
        acceleration = (c * forward - s * right, s * forward + c * right, vertical.acceleration)
        return TrajectoryDemand(
            (NAN, NAN, vertical.position),
            (*FREE[:2], vertical.velocity),
            acceleration,
            yaw,
            rate,
        )
