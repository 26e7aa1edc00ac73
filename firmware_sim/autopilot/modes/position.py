"""Position: the sticks accelerate, and climb; released, the place is held."""

from __future__ import annotations

from airl_mav.core.frames import Vector
from firmware_sim.autopilot.error_state import P, V
from firmware_sim.autopilot.manual_control import Sticks
from firmware_sim.autopilot.modes.interface import FlightContext, triple
from firmware_sim.autopilot.modes.piloted import Piloted
from firmware_sim.autopilot.modes.stick_motion import AxisDemand, HorizontalStick
from firmware_sim.autopilot.requests import Request


class Position(Piloted):
    """Moves as the sticks say."""

    def __init__(self, context: FlightContext, /) -> None:
        super().__init__(context)
        self._horizontal = HorizontalStick(context.value)

    def enter(self, state: Vector, request: Request | None, /) -> None:
        """Begin with the present motion."""
        super().enter(state, request)
        north, east, _ = triple(state, V)
        self._horizontal.restart((north, east))

    def _steer(
        self, sticks: Sticks, heading: float, state: Vector, dt: float, /
    ) -> tuple[AxisDemand, AxisDemand]:
        north, east, _ = triple(state, P)
        return self._horizontal.move((sticks.pitch, sticks.roll), heading, (north, east), dt)
