"""Orbit, Follow and Acro.

Orbit flies a circle around a place. Follow stays relative to a target that reports its position
(FOLLOW_TARGET), by FLW_TGT_DST, FLW_TGT_FA and FLW_TGT_HT above home; terrain is not used. In Acro
the sticks command body rates and thrust.

Source: PX4 1.16, FlightTaskOrbit, FlightTaskAutoFollowTarget, MulticopterRateControl.
"""

from __future__ import annotations

import math
from enum import IntEnum

from airl_mav.control.demand import AnyDemand, RateDemand, TrajectoryDemand
from airl_mav.core.constants import DEG, US_PER_S
from airl_mav.core.frames import Vector, quat_yaw, wrap_pi
from airl_mav.vehicle.rotation import Vec
from firmware_sim.autopilot.autopilot_state import OperatorText, OrbitStatus, Severity
from firmware_sim.autopilot.error_state import RATES, P, Q
from firmware_sim.autopilot.events import flight_events as events
from firmware_sim.autopilot.flight_modes import Mode
from firmware_sim.autopilot.inputs import ModeRequest, OrbitRequest
from firmware_sim.autopilot.modes.automatic import Hold
from firmware_sim.autopilot.modes.interface import NAN, FlightContext, FlightMode, since
from firmware_sim.autopilot.modes.sticks import IDLE_THROTTLE, RELEASED, superexpo
from firmware_sim.autopilot.smooth_trajectory import PathSegment, triple

LEAST_RADIUS_M = 1.0
FASTEST_M_S = 10.0
MOST_M_S2 = 2.0
"""Maximum centripetal acceleration, which limits the speed."""

ON_CIRCLE_M = 2.0
"""Maximum distance to the circle at which circling starts [m]."""


class Facing(IntEnum):
    """Values of ORBIT_YAW_BEHAVIOUR."""

    CENTRE = 0
    INITIAL_HEADING = 1
    UNCONTROLLED = 2
    TANGENT = 3
    PILOT = 4
    UNCHANGED = 5


class Orbit(FlightMode, modes=(Mode.ORBIT,)):
    """Orbit mode: flies to the circle, then along it."""

    def __init__(self, context: FlightContext, /) -> None:
        self._context = context
        self._centre: Vec = (0.0, 0.0, 0.0)
        self._radius = LEAST_RADIUS_M
        self._speed = 1.0
        """Speed along the circle, positive clockwise [m/s]."""
        self._facing = Facing.CENTRE
        self._initial_yaw = 0.0
        self._yaw = 0.0
        self._going_round = False
        self._present = 0.0
        """Current speed, which rises with MPC_ACC_HOR [m/s]."""
        self._time_us: int | None = None

    def enter(self, state: Vector, request: ModeRequest | None, /) -> None:
        """Start, or change the active orbit."""
        if self._context.orbit is None:  # otherwise the active orbit is changed
            self._centre, self._radius, self._speed = triple(state, P), LEAST_RADIUS_M, 1.0
        self._time_us = None
        self._initial_yaw = self._yaw = quat_yaw(state[Q:RATES])
        self._going_round, self._present = False, 0.0
        self._facing = Facing(int(self._context.value("MC_ORBIT_YAW_MOD")))
        if isinstance(request, OrbitRequest):
            self._apply(request)

    def demand(self, state: Vector, time_us: int, /) -> AnyDemand:
        """Fly straight to the circle first, then along it."""
        dt, self._time_us = since(self._time_us, time_us), time_us
        position = triple(state, P)
        north, east = position[0] - self._centre[0], position[1] - self._centre[1]
        distance = math.hypot(north, east)
        near = abs(position[2] - self._centre[2]) < self._context.value("NAV_MC_ALT_RAD")
        if not self._going_round and near and abs(distance - self._radius) < ON_CIRCLE_M:
            self._going_round = True
        self._report()
        outward = (north / distance, east / distance) if distance > 1e-6 else (1.0, 0.0)
        if not self._going_round:
            on_circle = (
                self._centre[0] + outward[0] * self._radius,
                self._centre[1] + outward[1] * self._radius,
                self._centre[2],
            )
            inward = math.atan2(-outward[1], -outward[0])
            return self._context.travel.fly(state, time_us, PathSegment(on_circle), yaw=inward)
        return self._round(outward, distance, quat_yaw(state[Q:RATES]), dt)

    def _round(
        self, outward: tuple[float, float], distance: float, now: float, dt: float
    ) -> TrajectoryDemand:
        step = self._context.value("MPC_ACC_HOR") * dt
        self._present += min(step, max(-step, self._speed - self._present))
        correction = self._radius - distance
        velocity = (
            -outward[1] * self._present + outward[0] * correction,
            outward[0] * self._present + outward[1] * correction,
            NAN,
        )
        inward = self._present * self._present / self._radius
        acceleration = (-outward[0] * inward, -outward[1] * inward, NAN)
        yaw, rate = self._heading(outward, now, dt)
        return TrajectoryDemand((NAN, NAN, self._centre[2]), velocity, acceleration, yaw, rate)

    def _heading(self, outward: tuple[float, float], now: float, dt: float) -> tuple[float, float]:
        """Return heading [rad] and yaw rate [rad/s]; MPC_YAWRAUTO_MAX limits the rate."""
        rate = self._speed / self._radius
        side = math.copysign(1.0, self._speed)
        if self._facing is Facing.UNCONTROLLED:
            self._yaw = now
            return NAN, NAN
        if self._facing is Facing.INITIAL_HEADING:
            target, rate = self._initial_yaw, NAN
        elif self._facing is Facing.TANGENT:
            target = math.atan2(side * outward[0], -side * outward[1])
        elif self._facing is Facing.PILOT:
            target, rate = self._yaw, NAN
        else:
            target = math.atan2(-outward[1], -outward[0])
        most = self._context.value("MPC_YAWRAUTO_MAX") * DEG * dt
        self._yaw = wrap_pi(self._yaw + min(most, max(-most, wrap_pi(target - self._yaw))))
        return self._yaw, rate

    def _apply(self, request: OrbitRequest) -> None:
        """Apply a request; NaN keeps the current value."""
        radius, clockwise = self._radius, self._speed > 0.0
        if not math.isnan(request.radius_m):
            radius, clockwise = abs(request.radius_m), request.radius_m > 0.0
        speed = abs(self._speed) if math.isnan(request.speed_m_s) else request.speed_m_s
        if not LEAST_RADIUS_M <= radius <= self._context.value("MC_ORBIT_RAD_MAX"):
            self._context.say(OperatorText.of(Severity.CRITICAL, events.ORBIT_TOO_WIDE))
            return
        fastest = min(FASTEST_M_S, math.sqrt(MOST_M_S2 * radius))
        speed = min(fastest, max(-fastest, speed))
        self._radius, self._speed = radius, speed if clockwise else -speed
        if request.facing in list(Facing) and request.facing != Facing.UNCHANGED:
            self._facing = Facing(request.facing)
        north, east, down = request.centre
        if not (math.isnan(north) or math.isnan(east)):
            self._centre = north, east, self._centre[2]
        if not math.isnan(down):
            self._centre = self._centre[0], self._centre[1], down

    def _report(self) -> None:
        radius = math.copysign(self._radius, self._speed)
        self._context.orbit = OrbitStatus(radius, self._centre)


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


class Acro(FlightMode, modes=(Mode.ACRO,)):
    """Body rates proportional to the sticks, and thrust linear in the throttle stick."""

    def __init__(self, context: FlightContext, /) -> None:
        self._context = context

    @property
    def lifts(self) -> bool:
        """True if the throttle stick commands thrust."""
        sticks = self._context.sticks
        return sticks is not None and sticks.throttle > IDLE_THROTTLE

    def demand(self, _state: Vector, _time_us: int, /) -> RateDemand:
        """Return the demand of the sticks."""
        value, sticks = self._context.value, self._context.sticks or RELEASED
        gentle, steep = value("MC_ACRO_EXPO"), value("MC_ACRO_SUPEXPO")
        roll = superexpo(sticks.roll, gentle, steep) * value("MC_ACRO_R_MAX") * DEG
        pitch = -superexpo(sticks.pitch, gentle, steep) * value("MC_ACRO_P_MAX") * DEG
        yaw = superexpo(sticks.yaw, value("MC_ACRO_EXPO_Y"), value("MC_ACRO_SUPEXPOY"))
        rates = (roll, pitch, yaw * value("MC_ACRO_Y_MAX") * DEG)
        return RateDemand(rates, 0.5 * (sticks.throttle + 1.0))
