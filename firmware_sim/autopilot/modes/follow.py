"""Follow: behind a target that reports where it is (FOLLOW_TARGET).

Source: PX4 1.16, FlightTaskAutoFollowTarget: distance, angle and height by FLW_TGT_DST, FLW_TGT_FA
and FLW_TGT_HT. The height is above home; there is no terrain.
"""

from __future__ import annotations

import math

from airl_mav.control.demand import AnyDemand
from airl_mav.core.constants import DEG, US_PER_S
from airl_mav.core.frames import Vector, quat_yaw
from firmware_sim.autopilot.error_state import RATES, P, Q
from firmware_sim.autopilot.modes.hold import Hold
from firmware_sim.autopilot.modes.interface import FlightContext, FlightMode, triple
from firmware_sim.autopilot.requests import Request
from firmware_sim.autopilot.trajectory import Leg

LOST_US = 3 * US_PER_S
"""A target that was silent for so long is waited for where the vehicle is [µs]."""

WALKS_M_S = 1.0
"""From this speed on a target has a course; slower, the last one counts [m/s]."""


class Follow(FlightMode):
    """Keeps its place relative to the target's course, and looks at the target."""

    def __init__(self, context: FlightContext, /) -> None:
        self._context = context
        self._waiting = Hold(context)
        self._course = 0.0
        """Of the target [rad]."""
        self._following = False

    def enter(self, state: Vector, _request: Request | None, /) -> None:
        """Begin; until a target walks, the vehicle's heading is its course."""
        self._course, self._following = quat_yaw(state[Q:RATES]), False
        self._waiting.enter(state, None)

    def demand(self, state: Vector, time_us: int, /) -> AnyDemand:
        """Go where the target's place and course ask."""
        target = self._context.target
        if target is None or time_us - target.time_us > LOST_US:
            if self._following:
                self._following = False
                self._waiting.enter(state, None)
            return self._waiting.demand(state, time_us)
        self._following = True
        value, travel = self._context.value, self._context.travel
        age_s = max(0, time_us - target.time_us) / US_PER_S
        (north, east, _), (vn, ve, _) = target.position, target.velocity
        north, east = north + vn * age_s, east + ve * age_s
        if math.hypot(vn, ve) > WALKS_M_S:
            self._course = math.atan2(ve, vn)
        angle = self._course + value("FLW_TGT_FA") * DEG
        distance = value("FLW_TGT_DST")
        place = (
            north + distance * math.cos(angle),
            east + distance * math.sin(angle),
            self._context.home[2] - value("FLW_TGT_HT"),
        )
        here = triple(state, P)
        yaw = math.atan2(east - here[1], north - here[0])
        travel.speed_m_s = value("FLW_TGT_MAX_VEL")
        return travel.fly(state, time_us, Leg(place, velocity=(vn, ve, 0.0)), yaw=yaw)
