"""Altitude: the sticks command tilt and climb. Released: height held, position drifts."""

from __future__ import annotations

import math

from airl_mav.core.constants import DEG, GRAVITY_M_S2
from airl_mav.core.frames import Vector
from firmware_sim.autopilot.flight_modes import Mode
from firmware_sim.autopilot.manual_control import Sticks
from firmware_sim.autopilot.modes.interface import NAN
from firmware_sim.autopilot.modes.piloted import Piloted
from firmware_sim.autopilot.modes.stick_motion import AxisDemand


class Altitude(Piloted, modes=(Mode.ALTITUDE,)):
    """Tilt proportional to the sticks."""

    def _steer(
        self, sticks: Sticks, heading: float, _state: Vector, _dt: float, /
    ) -> tuple[AxisDemand, AxisDemand]:
        tilt = min(89.0, self._context.value("MPC_MAN_TILT_MAX")) * DEG
        most = min(3.0, max(0.02, math.tan(tilt))) * GRAVITY_M_S2
        length = max(1.0, math.hypot(sticks.pitch, sticks.roll))
        forward, right = sticks.pitch / length * most, sticks.roll / length * most
        c, s = math.cos(heading), math.sin(heading)
        north, east = c * forward - s * right, s * forward + c * right
        return AxisDemand(NAN, NAN, north), AxisDemand(NAN, NAN, east)
