"""Position: the sticks command acceleration and climb. Released, the position is held."""

from __future__ import annotations

from functools import partial

from airl_mav.core.frames import Vector, quat_yaw
from firmware_sim.autopilot.error_state import RATES, P, Q, V
from firmware_sim.autopilot.flight_modes import Mode
from firmware_sim.autopilot.manual_control import Sticks
from firmware_sim.autopilot.modes.collision_prevention import CollisionPrevention
from firmware_sim.autopilot.modes.interface import FlightContext, triple
from firmware_sim.autopilot.modes.piloted import Piloted
from firmware_sim.autopilot.modes.stick_motion import AxisDemand, HorizontalStick
from firmware_sim.autopilot.requests import ModeRequest


class Position(Piloted, modes=(Mode.POSITION,)):
    """Motion commanded by the sticks."""

    def __init__(self, context: FlightContext, /) -> None:
        super().__init__(context)
        self._horizontal = HorizontalStick(context.value)
        self._prevention = CollisionPrevention(context.value)

    def enter(self, state: Vector, request: ModeRequest | None, /) -> None:
        """Start with the current motion."""
        super().enter(state, request)
        north, east, _ = triple(state, V)
        self._horizontal.restart((north, east))
        self._prevention.rest()

    def _steer(
        self, sticks: Sticks, heading: float, state: Vector, dt: float, /
    ) -> tuple[AxisDemand, AxisDemand]:
        north, east, _ = triple(state, P)
        prevention = self._prevention
        constrain = None
        if prevention.is_on:
            constrain = partial(
                prevention.constrain,
                obstacles=self._context.obstacles,
                yaw=quat_yaw(state[Q:RATES]),
                now_us=self._time_us or 0,
            )
        else:
            prevention.rest()
        deflected = sticks.pitch, sticks.roll
        return self._horizontal.move(deflected, heading, (north, east), dt, constrain)

    def is_done(self, _state: Vector, /) -> bool:
        """Return whether obstacle data have been missing too long to permit steering."""
        return self._prevention.gives_up
