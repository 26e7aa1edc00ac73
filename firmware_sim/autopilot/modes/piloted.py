"""What Altitude and Position share: the throttle stick climbs, the yaw stick turns."""

from __future__ import annotations

import math
from abc import abstractmethod

from airl_mav.control.demand import AnyDemand, TrajectoryDemand
from airl_mav.core.frames import Vector, quat_yaw
from firmware_sim.autopilot.error_state import RATES, P, Q, V
from firmware_sim.autopilot.manual_control import Sticks
from firmware_sim.autopilot.modes.interface import FlightContext, FlightMode, descend, since
from firmware_sim.autopilot.modes.stick_motion import AxisDemand, VerticalStick, YawStick
from firmware_sim.autopilot.requests import Request

LIFTING_THROTTLE = 0.3
"""From this deflection on a standing vehicle takes off: PX4's 65 % of the stick's way."""


class Piloted(FlightMode):
    """Moves as the sticks say. Without a pilot's input it descends, level."""

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
        height = self._context.height(state)
        z = self._vertical.move(sticks.throttle, state.item(P + 2), height, dt)
        x, y = self._steer(sticks, now if math.isnan(yaw) else yaw, state, dt)
        return TrajectoryDemand(
            (x.position, y.position, z.position),
            (x.velocity, y.velocity, z.velocity),
            (x.acceleration, y.acceleration, z.acceleration),
            yaw,
            rate,
        )

    @abstractmethod
    def _steer(
        self, sticks: Sticks, heading: float, state: Vector, dt: float, /
    ) -> tuple[AxisDemand, AxisDemand]:
        """Return the motion north and east that pitch and roll command."""
