"""Follow: stay relative to a target that reports its position (FOLLOW_TARGET).

Source: PX4 1.16, FlightTaskAutoFollowTarget: distance, angle and height by FLW_TGT_DST, FLW_TGT_FA
and FLW_TGT_HT. The height is above home; terrain is not used.
"""

from __future__ import annotations

import math

from airl_mav.control.demand import AnyDemand
from airl_mav.core.constants import DEG, US_PER_S
from airl_mav.core.frames import Vector, quat_yaw
from firmware_sim.autopilot.error_state import RATES, P, Q
from firmware_sim.autopilot.flight_modes import Mode
from firmware_sim.autopilot.modes.hold import Hold
from firmware_sim.autopilot.modes.interface import FlightContext, FlightMode, triple
from firmware_sim.autopilot.requests import ModeRequest
from firmware_sim.autopilot.smooth_trajectory import PathSegment

LOST_US = 3 * US_PER_S
"""Target timeout [µs], after which the vehicle waits at its position."""

WALKS_M_S = 1.0
"""Minimum speed at which a target has a course; below it, the last course applies [m/s]."""


class Follow(FlightMode, modes=(Mode.FOLLOW,)):
    """Follow mode: keeps a position relative to the target's course, nose towards the target."""

    def __init__(self, context: FlightContext, /) -> None:
        self._context = context
        self._waiting = Hold(context)
        self._course = 0.0
        """Course of the target [rad]."""
        self._following = False

    def enter(self, state: Vector, _request: ModeRequest | None, /) -> None:
        """Start; until the target moves, its course is the vehicle's heading."""
        self._course, self._following = quat_yaw(state[Q:RATES]), False
        self._waiting.enter(state, None)

    def demand(self, state: Vector, time_us: int, /) -> AnyDemand:
        """Return the demand to the place given by the target's position and course."""
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
        return travel.fly(state, time_us, PathSegment(place, velocity=(vn, ve, 0.0)), yaw=yaw)
