"""Orbit, Follow, Acro and Precision Landing.

Orbit flies a circle around a place. Follow stays relative to a target that reports its position
(FOLLOW_TARGET), by FLW_TGT_DST, FLW_TGT_FA and FLW_TGT_HT above home; terrain is not used. In Acro
the sticks command body rates and thrust. Precision Landing flies above a reported landing target
(LANDING_TARGET) and lands on it.

Source: PX4 1.16, FlightTaskOrbit, FlightTaskAutoFollowTarget, MulticopterRateControl, and
navigator/precland.cpp: its states, their conditions and PLD_*.
"""

from __future__ import annotations

import math
from enum import Enum, IntEnum, auto

from airl_mav.control.demand import AnyDemand, RateDemand, TrajectoryDemand
from airl_mav.core.constants import DEG, US_PER_S
from airl_mav.core.frames import Vector, quat_yaw, wrap_pi
from airl_mav.vehicle.rotation import Vec
from firmware_sim.autopilot.autopilot_state import OperatorText, OrbitStatus, Severity
from firmware_sim.autopilot.error_state import RATES, P, Q
from firmware_sim.autopilot.events import flight_events as events
from firmware_sim.autopilot.flight_modes import Mode
from firmware_sim.autopilot.modes import automatic, interface
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


class Orbit(interface.FlightMode, modes=(Mode.ORBIT,)):
    """Orbit mode: flies to the circle, then along it."""

    def __init__(self, context: interface.FlightContext, /) -> None:
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

    def enter(self, state: Vector, request: interface.ModeRequest | None, /) -> None:
        """Start, or change the active orbit."""
        if self._context.orbit is None:  # otherwise the active orbit is changed
            self._centre, self._radius, self._speed = triple(state, P), LEAST_RADIUS_M, 1.0
        self._time_us = None
        self._initial_yaw = self._yaw = quat_yaw(state[Q:RATES])
        self._going_round, self._present = False, 0.0
        self._facing = Facing(int(self._context.value("MC_ORBIT_YAW_MOD")))
        if isinstance(request, interface.OrbitRequest):
            self._apply(request)

    def demand(self, state: Vector, time_us: int, /) -> AnyDemand:
        """Fly straight to the circle first, then along it."""
        dt, self._time_us = interface.since(self._time_us, time_us), time_us
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
            interface.NAN,
        )
        inward = self._present * self._present / self._radius
        acceleration = (-outward[0] * inward, -outward[1] * inward, interface.NAN)
        yaw, rate = self._heading(outward, now, dt)
        return TrajectoryDemand(
            (interface.NAN, interface.NAN, self._centre[2]), velocity, acceleration, yaw, rate
        )

    def _heading(self, outward: tuple[float, float], now: float, dt: float) -> tuple[float, float]:
        """Return heading [rad] and yaw rate [rad/s]; MPC_YAWRAUTO_MAX limits the rate."""
        rate = self._speed / self._radius
        side = math.copysign(1.0, self._speed)
        if self._facing is Facing.UNCONTROLLED:
            self._yaw = now
            return interface.NAN, interface.NAN
        if self._facing is Facing.INITIAL_HEADING:
            target, rate = self._initial_yaw, interface.NAN
        elif self._facing is Facing.TANGENT:
            target = math.atan2(side * outward[0], -side * outward[1])
        elif self._facing is Facing.PILOT:
            target, rate = self._yaw, interface.NAN
        else:
            target = math.atan2(-outward[1], -outward[0])
        most = self._context.value("MPC_YAWRAUTO_MAX") * DEG * dt
        self._yaw = wrap_pi(self._yaw + min(most, max(-most, wrap_pi(target - self._yaw))))
        return self._yaw, rate

    def _apply(self, request: interface.OrbitRequest) -> None:
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


class Follow(interface.FlightMode, modes=(Mode.FOLLOW,)):
    """Follow mode: keeps a position relative to the target's course, nose towards the target."""

    def __init__(self, context: interface.FlightContext, /) -> None:
        self._context = context
        self._waiting = automatic.Hold(context)
        self._course = 0.0
        """Course of the target [rad]."""
        self._following = False

    def enter(self, state: Vector, _request: interface.ModeRequest | None, /) -> None:
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


class Acro(interface.FlightMode, modes=(Mode.ACRO,)):
    """Body rates proportional to the sticks, and thrust linear in the throttle stick."""

    def __init__(self, context: interface.FlightContext, /) -> None:
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


PERIOD_US = 50_000
"""Period of target checks [µs]: PX4's navigator runs at 20 Hz."""

_SETTLE_US = 2 * US_PER_S
"""Waiting time for the target at the start, and above the target before the descent [µs]."""

_SEEN_US = US_PER_S
"""Waiting time between finding a target in the search and its approach [µs]."""

_LOST_NEAR_GROUND_US = US_PER_S // 2
"""Target timeout near the ground [µs]."""

_STOP_CLIMBING_M = 1.0
"""Additional climb of the search after the target was found [m]."""


class _State(Enum):
    START = auto()
    """Wait at a place for the target."""
    APPROACH = auto()
    """Fly to the target at the current height."""
    DESCEND = auto()
    """Descend above the target."""
    FINAL = auto()
    """Descend to the ground without target updates."""
    SEARCH = auto()
    """Climb to PLD_SRCH_ALT, waiting for the target."""
    FALLBACK = auto()
    """Ordinary landing at the current position."""


_DOWNWARDS = (_State.DESCEND, _State.FINAL, _State.FALLBACK)


class PrecisionLand(interface.FlightMode, modes=(Mode.PRECISION_LAND,)):
    """Precision landing mode: finds the target and lands on it; without one, lands in place."""

    def __init__(self, context: interface.FlightContext, /) -> None:
        self._context = context
        self._state = _State.START
        self._goal: Vec = (0.0, 0.0, 0.0)
        """Destination, local NED [m]; the height is ignored during the descent."""
        self._required = True
        self._searches = 0
        self._next_us = 0
        self._entered_us = 0
        """Start time of the current state [µs]."""
        self._reached_us: int | None = None
        self._found_us: int | None = None
        self._report_us = 0
        """Time of the newest processed report [µs]."""
        self._is_new = False

    @property
    def destination(self) -> Vec | None:
        """Destination; during the descent, the ground."""
        north, east, down = self._goal
        return north, east, self._context.home[2] if self._state in _DOWNWARDS else down

    def enter(self, state: Vector, request: interface.ModeRequest | None, /) -> None:
        """Start above the request's place, by default here, and search for the target."""
        if not isinstance(request, interface.PrecisionRequest):
            request = interface.PrecisionRequest(triple(state, P), required=True)
        self._goal, self._required = request.place, request.required
        self._searches, self._next_us = 1, 0
        self._report_us, self._is_new = -1, False
        self._reached_us = self._found_us = None
        self._state = _State.START

    def demand(self, state: Vector, time_us: int, /) -> AnyDemand:
        """Check for the target periodically; return the demand."""
        if time_us >= self._next_us:
            self._next_us = time_us + PERIOD_US
            self._update(triple(state, P), time_us)
        north, east, _ = self._goal
        travel = self._context.travel
        if self._state in _DOWNWARDS:
            context = self._context
            speed = automatic.landing_speed(context.value, context.height(state), context.ground_m)
            return travel.fly(
                state, time_us, PathSegment((north, east, math.nan), vertical_m_s=speed)
            )
        return travel.fly(state, time_us, PathSegment(self._goal))

    # --- states

    def _update(self, position: Vec, now_us: int) -> None:
        target = self._context.landing_target
        self._is_new = target is not None and target.time_us != self._report_us
        if target is not None:
            self._report_us = target.time_us
        step = {
            _State.START: self._start,
            _State.APPROACH: self._approach,
            _State.DESCEND: self._descend,
            _State.SEARCH: self._search,
        }.get(self._state)
        if step is not None:
            step(position, now_us)

    def _start(self, position: Vec, now_us: int) -> None:
        if self._begin_approach(position, now_us):
            return
        if not self._required:
            self._fall_back(position)
            return
        if math.dist(position[:2], self._goal[:2]) >= self._context.value("NAV_ACC_RAD"):
            return
        if self._reached_us is None:
            self._reached_us = now_us
        if self._context.value("PLD_SRCH_TOUT") <= 0.0:
            self._fall_back(position)
        elif now_us - self._reached_us > _SETTLE_US:
            north, east, _ = self._goal
            # Above the origin of local NED, PX4's reference altitude.
            self._goal = north, east, -self._context.value("PLD_SRCH_ALT")
            self._become(_State.SEARCH, now_us)

    def _approach(self, position: Vec, now_us: int) -> None:
        target = self._target
        if target is None or (self._is_over(target, position) and not self._is_visible(now_us)):
            self._lose(position, now_us)
            return
        if self._is_new and self._is_over(target, position):
            if self._reached_us is None:
                self._reached_us = now_us
            if now_us - self._reached_us > _SETTLE_US:
                self._become(_State.DESCEND, now_us)
        self._goal = *target.position[:2], self._goal[2]

    def _descend(self, position: Vec, now_us: int) -> None:
        target = self._target
        if target is None:
            self._lose(position, now_us)
            return
        near = self._is_near_ground(target, position, now_us)
        visible = self._is_visible(now_us)
        if near:
            visible = now_us - target.time_us < _LOST_NEAR_GROUND_US
        if visible:
            self._goal = *target.position[:2], self._goal[2]
        elif near:
            self._become(_State.FINAL, now_us)
        else:
            self._lose(position, now_us)

    def _search(self, position: Vec, now_us: int) -> None:
        if self._is_new and self._is_visible(now_us) and self._found_us is None:
            self._found_us = now_us
            north, east, down = self._goal
            self._goal = north, east, max(down, position[2] - _STOP_CLIMBING_M)
        settled = self._found_us is not None and now_us - self._found_us > _SEEN_US
        if settled and self._begin_approach(position, now_us):
            return
        if now_us - self._entered_us > self._context.value("PLD_SRCH_TOUT") * US_PER_S:
            self._fall_back(position)

    # --- from state to state

    def _become(self, state: _State, now_us: int) -> None:
        self._state, self._entered_us = state, now_us
        self._reached_us = self._found_us = None

    def _begin_approach(self, position: Vec, now_us: int) -> bool:
        """Approach a currently visible target; return whether there is one."""
        if not (self._is_new and self._is_visible(now_us)):
            return False
        north, east, _ = self._goal
        self._goal = north, east, position[2]
        self._become(_State.APPROACH, now_us)
        return True

    def _lose(self, position: Vec, now_us: int) -> None:
        """Search for the target at the current position, up to PLD_MAX_SRCH times."""
        self._goal = position
        if self._searches <= self._context.value("PLD_MAX_SRCH"):
            self._searches += 1
            self._become(_State.START, now_us)
        else:
            self._fall_back(position)

    def _fall_back(self, position: Vec) -> None:
        self._goal, self._state = position, _State.FALLBACK

    # --- the target

    @property
    def _target(self) -> interface.LandingTarget | None:
        return self._context.landing_target

    def _is_visible(self, now_us: int) -> bool:
        """Return whether the target was reported within PLD_BTOUT."""
        target = self._target
        if target is None:
            return False
        return now_us - target.time_us <= self._context.value("PLD_BTOUT") * US_PER_S

    def _is_over(self, target: interface.LandingTarget, position: Vec) -> bool:
        """Return whether the vehicle is above the target, within PLD_HACC_RAD on each axis."""
        radius = self._context.value("PLD_HACC_RAD")
        offsets = (a - b for a, b in zip(target.position[:2], position[:2], strict=True))
        return all(abs(offset) < radius for offset in offsets)

    def _is_near_ground(self, target: interface.LandingTarget, position: Vec, now_us: int) -> bool:
        """Return whether the vehicle is within PLD_FAPPR_ALT above a visible target."""
        above = target.position[2] - position[2]
        return self._is_visible(now_us) and above < self._context.value("PLD_FAPPR_ALT")
