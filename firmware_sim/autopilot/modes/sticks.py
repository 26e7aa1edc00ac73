"""Stick modes: Position, Altitude, Stabilized and Manual, and their setpoint trajectories.

Source: PX4 1.16, Sticks, StickYaw, StickAccelerationXY, ManualVelocitySmoothingZ,
FlightTaskManualAltitude, MulticopterAttitudeControl (generate_attitude_setpoint, throttle_curve).
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable
from typing import NamedTuple

from airl_mav.control.demand import AnyDemand, AttitudeDemand, TrajectoryDemand
from airl_mav.core.constants import DEG, GRAVITY_M_S2
from airl_mav.core.frames import Vector, quat_yaw, wrap_pi
from airl_mav.vehicle.rotation import multiply
from firmware_sim.autopilot.autopilot_state import OperatorText, Severity
from firmware_sim.autopilot.error_state import RATES, P, Q, V
from firmware_sim.autopilot.flight_modes import Mode
from firmware_sim.autopilot.modes import interface
from firmware_sim.autopilot.smooth_trajectory import Axis, triple

_TURNS_RAD_S = 1e-3
"""Yaw rate above which no heading is held [rad/s]."""

_AT_REST_M_S, _AT_REST_M_S2 = 0.1, 0.2
"""Speed and acceleration below which a height is held."""

_BOOST_TAU_S = 0.8
"""Time constant of the increased drag after release of the stick [s]."""


def deadzone(x: float, zone: float) -> float:
    """Return a deflection with a deadzone; full deflection remains 1."""
    return 0.0 if abs(x) <= zone else math.copysign((abs(x) - zone) / (1.0 - zone), x)


def expo(x: float, share: float) -> float:
    """Return a deflection with reduced gain around the centre, by a share of x³."""
    return (1.0 - share) * x + share * x**3


def superexpo(x: float, share: float, steeper: float) -> float:
    """Return the `expo` of a deflection, steeper towards full deflection."""
    return expo(x, share) * (1.0 - steeper) / (1.0 - abs(x) * steeper)


Pair = tuple[float, float]
"""North and east components."""


class AxisDemand(NamedTuple):
    """Demand of one axis; NaN = no position."""

    position: float
    velocity: float
    acceleration: float


class YawStick:
    """Yaw stick commands a yaw rate; released, the heading is held."""

    def __init__(self, value: Callable[[str], float]) -> None:
        self._value = value
        self._rate = 0.0
        self._held = interface.NAN

    def restart(self) -> None:
        """Reset rate and held heading."""
        self._rate, self._held = 0.0, interface.NAN

    def turn(self, stick: float, yaw: float, dt: float) -> tuple[float, float]:
        """Return the heading [rad], NaN while turning, and the yaw rate [rad/s]."""
        value = self._value
        shaped = expo(deadzone(stick, value("MAN_DEADZONE")), value("MPC_YAW_EXPO"))
        target = shaped * value("MPC_MAN_Y_MAX") * DEG
        # First-order filter of time constant MPC_MAN_Y_TAU: a jump of the stick must not become a
        # jump of the yaw rate.
        self._rate += (target - self._rate) * dt / (dt + value("MPC_MAN_Y_TAU"))
        if abs(self._rate) > _TURNS_RAD_S:
            self._held = interface.NAN
        elif math.isnan(self._held):
            self._held = wrap_pi(yaw)
        return self._held, self._rate


class VerticalStick:
    """Throttle stick commands climb and descent; released, the height is held."""

    def __init__(self, value: Callable[[str], float]) -> None:
        self._value = value
        self._axis = Axis()
        self._held = interface.NAN

    def restart(self, down: float, velocity: float) -> None:
        """Start with a position [m] and velocity [m/s], NED."""
        self._axis.restart(down, velocity)
        self._held = interface.NAN

    def move(self, stick: float, down: float, height: float, dt: float) -> AxisDemand:
        """Return the demand, NED, from measured `down` and `height` above home [m]."""
        value, axis = self._value, self._axis
        shaped = expo(deadzone(stick, value("MAN_DEADZONE")), value("MPC_Z_MAN_EXPO"))
        target = self._speed(shaped, height)
        # Advance the previous plan first: the stick's new target is planned from there.
        axis.advance(dt)
        # The height is held only after the trajectory has stopped, otherwise the vehicle would jump
        # back to the place where the stick was released.
        resting = abs(axis.velocity) < _AT_REST_M_S and abs(axis.acceleration) < _AT_REST_M_S2
        if resting and target == 0.0:
            if math.isnan(self._held):
                self._held = axis.position
        else:
            self._held = interface.NAN
            axis.position = down
        # NED: a negative target is a climb.
        limit = value("MPC_ACC_UP_MAX") if target < 0.0 else value("MPC_ACC_DOWN_MAX")
        axis.plan(target, limit, value("MPC_JERK_MAX"))
        return AxisDemand(self._held, axis.velocity, axis.acceleration)

    def put(self, down: float) -> float:
        """Continue from another height NED [m]; return the held height, NaN = none."""
        self._axis.position = down
        if not math.isnan(self._held):
            self._held = down
        return self._held

    def _speed(self, shaped: float, height: float) -> float:
        """Return the speed NED [m/s], reduced near the ground."""
        value = self._value
        low, high = value("MPC_LAND_ALT2"), max(value("MPC_LAND_ALT1"), value("MPC_LAND_ALT2"))
        # Between both heights the limits change linearly, as in a landing.
        share = 1.0 if height >= high else 0.0
        if low < height < high:
            share = (height - low) / (high - low)
        up, down = value("MPC_Z_VEL_MAX_UP"), value("MPC_Z_VEL_MAX_DN")
        up_limit = value("MPC_TKO_SPEED") + share * (up - value("MPC_TKO_SPEED"))
        down_limit = value("MPC_LAND_SPEED") + share * (down - value("MPC_LAND_SPEED"))
        speed = -shaped * (up if shaped > 0.0 else down)
        return min(down_limit, max(-up_limit, speed))


class HorizontalStick:
    """Roll and pitch sticks accelerate; drag limits the speed, and stops when released."""

    def __init__(self, value: Callable[[str], float]) -> None:
        self._value = value
        self._velocity = (0.0, 0.0)
        self._acceleration = (0.0, 0.0)
        self._held = (interface.NAN, interface.NAN)
        self._boost = 1.0

    def restart(self, velocity: tuple[float, float]) -> None:
        """Start with a velocity NED [m/s]."""
        self._velocity, self._acceleration = velocity, (0.0, 0.0)
        self._held, self._boost = (interface.NAN, interface.NAN), 1.0

    def move(
        self,
        sticks: tuple[float, float],
        yaw: float,
        position: tuple[float, float],
        dt: float,
        constrain: Callable[[Pair, Pair], Pair] | None = None,
    ) -> tuple[AxisDemand, AxisDemand]:
        """Return the demands north and east from sticks (forward, right) and heading [rad].

        `constrain` returns the permitted acceleration at a velocity setpoint.
        """
        value = self._value
        # Twice the acceleration at full stick: at the maximum speed drag cancels it.
        speed, force = value("MPC_VEL_MANUAL"), 2.0 * value("MPC_ACC_HOR")
        north, east = self._direction(sticks, yaw)
        released = north == 0.0 and east == 0.0
        # Released sticks brake harder than drag alone, which would fade with the speed.
        boost = max(2.0, math.sqrt(speed)) if released else 1.0
        self._boost += (boost - self._boost) * dt / (dt + _BOOST_TAU_S)
        drag = [force / speed * self._boost * v for v in self._dragged()]
        target = north * force, east * force
        if constrain is not None:
            target = constrain(target, self._velocity)
            # A fully blocked direction counts as released: the vehicle must brake, not coast.
            released = target == (0.0, 0.0)
        before = self._acceleration
        # Drag may stop the vehicle within a tick, but must not reverse its motion.
        reversing = any(w * b < 0.0 for w, b in zip(target, before, strict=True))
        if (released or reversing) and math.hypot(*self._velocity) < math.hypot(*drag) * dt:
            drag, self._velocity = [0.0, 0.0], (0.0, 0.0)
        self._acceleration = self._limited([w - d for w, d in zip(target, drag, strict=True)], dt)
        vn, ve = (v + a * dt for v, a in zip(self._velocity, self._acceleration, strict=True))
        if released and math.hypot(vn, ve) < 1e-3:
            vn, ve = 0.0, 0.0
        self._velocity = vn, ve
        if math.hypot(vn, ve) > 1e-3:
            self._held = interface.NAN, interface.NAN
        elif math.isnan(self._held[0]):
            self._held = position
        pairs = zip(self._held, self._velocity, self._acceleration, strict=True)
        first, second = (AxisDemand(p, v, a) for p, v, a in pairs)
        return first, second

    def _direction(self, sticks: tuple[float, float], yaw: float) -> tuple[float, float]:
        """Return the deflection north and east, with a norm of at most 1."""
        value = self._value
        zone, share = value("MAN_DEADZONE"), value("MPC_XY_MAN_EXPO")
        forward, right = (expo(deadzone(s, zone), share) for s in sticks)
        # Diagonal stick travel must not exceed the speed of a single axis.
        length = max(1.0, math.hypot(forward, right))
        forward, right = forward / length, right / length
        side, back = value("MPC_VEL_MAN_SIDE"), value("MPC_VEL_MAN_BACK")
        # Negative values disable the separate limits for sideways and backward flight.
        if side >= 0.0:
            right *= side / value("MPC_VEL_MANUAL")
        if back >= 0.0 and forward < 0.0:
            forward *= back / value("MPC_VEL_MANUAL")
        c, s = math.cos(yaw), math.sin(yaw)
        return c * forward - s * right, s * forward + c * right

    def _dragged(self) -> tuple[float, float]:
        """Return the velocity for the drag: increased when braking below 1 m/s, by its root."""
        vn, ve = self._velocity
        speed = math.hypot(vn, ve)
        if speed == 0.0:
            return 0.0, 0.0
        # Linear drag alone never stops: below 1 m/s its share of the speed is raised.
        braking = min(1.0, max(0.0, self._boost - 1.0))
        share = braking * max(1.0, 1.0 / math.sqrt(speed)) + 1.0 - braking
        return vn * share, ve * share

    def _limited(self, target: list[float], dt: float) -> tuple[float, float]:
        """Return an acceleration with limited jerk and tilt."""
        value, (bn, be) = self._value, self._acceleration
        dn, de = target[0] - bn, target[1] - be
        step, most = math.hypot(dn, de), value("MPC_JERK_MAX") * dt
        share = 1.0 if step <= most else most / step
        north, east = bn + dn * share, be + de * share
        length = math.hypot(north, east)
        # The thrust vector's tilt limits the horizontal acceleration at constant height.
        tilt = math.tan(value("MPC_TILTMAX_AIR") * DEG) * GRAVITY_M_S2
        share = 1.0 if length <= tilt else tilt / length
        return north * share, east * share


HOLD_TERRAIN = 2
"""Value of MPC_ALT_MODE."""

_DEFLECTED = 1e-3


class Piloting(NamedTuple):
    """Input of the terrain hold."""

    level: float
    """Shaped deflection of the pitch and roll sticks."""
    climbing: bool
    """True if the throttle stick is deflected."""
    speed_m_s: float
    """Horizontal speed."""
    climb_m_s: float
    """Vertical speed, NED."""
    down_m: float
    """Height of the vehicle, NED."""
    ground_m: float
    """Height above ground; NaN = unknown."""
    resets: int
    """Number of terrain height resets."""


class TerrainHold:
    """Hold of the height above ground at the end of a motion."""

    def __init__(self, value: Callable[[str], float]) -> None:
        self._value = value
        self.restart()

    def restart(self) -> None:
        """Reset the hold."""
        self.holds = False
        """True if the height above ground is held instead of the altitude."""
        self.locked_m = interface.NAN
        """Held height above ground; NaN = none."""
        self._resets: int | None = None

    def place(self, now: Piloting, held: float) -> float:
        """Return the target height, NED [m], NaN = none; `held` is the sticks' held height."""
        if int(self._value("MPC_ALT_MODE")) != HOLD_TERRAIN:
            self.restart()
            return held
        # A reset shifts the height above ground: the held height is no longer valid.
        if now.resets != self._resets:
            self._resets, self.locked_m = now.resets, interface.NAN
        is_known, limit = math.isfinite(now.ground_m), self._value("MPC_HOLD_MAX_XY")
        deflected = now.level > _DEFLECTED
        if self.holds:
            if deflected or now.speed_m_s > limit or not is_known:
                self.holds = False
        # Half the limit as hysteresis: noise at the limit must not toggle the hold.
        elif not deflected and now.speed_m_s < 0.5 * limit and is_known:
            self.holds = True
            if math.isfinite(held):
                # Keep the height error.
                self.locked_m = now.ground_m - (held - now.down_m)
        if not self.holds:
            # While the altitude is not held either, the next hold locks a new height.
            if not now.climbing and math.isnan(held):
                self.locked_m = interface.NAN
            return held
        return self._follow(now)

    def _follow(self, now: Piloting) -> float:
        slow = self._value("MPC_HOLD_MAX_Z")
        # A vehicle that still climbs would be pulled back to the height of the release.
        stopped = slow <= 0.0 or abs(now.climb_m_s) < slow
        if now.climbing:
            self.locked_m = interface.NAN
        elif math.isnan(self.locked_m) and stopped:
            self.locked_m = now.ground_m
        return now.down_m - (self.locked_m - now.ground_m)


LIFTING_THROTTLE = 0.3
"""Minimum deflection for a take-off: PX4's 65 % of the stick's travel."""


class Piloted(interface.FlightMode):
    """Stick mode; without pilot input it descends level."""

    def __init__(self, context: interface.FlightContext, /) -> None:
        self._context = context
        self._vertical = VerticalStick(context.value)
        self._turning = YawStick(context.value)
        self._terrain = TerrainHold(context.value)
        self._time_us: int | None = None
        self._yaw = 0.0

    @property
    def lifts(self) -> bool:
        """True if the throttle stick is well above its centre."""
        sticks = self._context.sticks
        return sticks is not None and sticks.throttle > LIFTING_THROTTLE

    def enter(self, state: Vector, _request: interface.ModeRequest | None, /) -> None:
        """Start with the current motion."""
        self._restart(state)

    def _restart(self, state: Vector) -> None:
        self._vertical.restart(state.item(P + 2), state.item(V + 2))
        self._turning.restart()
        self._terrain.restart()
        self._yaw, self._time_us = quat_yaw(state[Q:RATES]), None

    def demand(self, state: Vector, time_us: int, /) -> AnyDemand:
        """Return the demand of the sticks."""
        sticks = self._context.sticks
        dt, self._time_us = interface.since(self._time_us, time_us), time_us
        if sticks is None:
            # Keep the heading of the last stick input: `_restart` replaces it.
            yaw = self._yaw
            self._restart(state)
            self._yaw = yaw
            return interface.descend(yaw)
        now = quat_yaw(state[Q:RATES])
        yaw, rate = self._turning.turn(sticks.yaw, now, dt)
        height = self._context.over_ground(state)
        z = self._vertical.move(sticks.throttle, state.item(P + 2), height, dt)
        if self._context.ground is not None:
            z = self._over_ground(sticks, state, z)
        x, y = self._steer(sticks, now if math.isnan(yaw) else yaw, state, dt)
        return TrajectoryDemand(
            (x.position, y.position, z.position),
            (x.velocity, y.velocity, z.velocity),
            (x.acceleration, y.acceleration, z.acceleration),
            yaw,
            rate,
        )

    def _over_ground(self, sticks: interface.Sticks, state: Vector, z: AxisDemand) -> AxisDemand:
        """Return the vertical demand, which holds the height above ground if enabled."""
        value, hold, (vn, ve, vd) = self._context.value, self._terrain, triple(state, V)
        zone = value("MAN_DEADZONE")
        share = value("MPC_XY_MAN_EXPO")
        level = (expo(deadzone(s, zone), share) for s in (sticks.pitch, sticks.roll))
        ground = self._context.ground
        before, down = hold.holds, state.item(P + 2)
        now = Piloting(
            level=math.hypot(*level),
            climbing=deadzone(sticks.throttle, zone) != 0.0,
            speed_m_s=math.hypot(vn, ve),
            climb_m_s=vd,
            down_m=down,
            ground_m=self._context.ground_m,
            resets=0 if ground is None else ground.resets,
        )
        place = hold.place(now, z.position)
        # The altitude hold continues at the current height, without the terrain's error.
        if before and not hold.holds:
            place = self._vertical.put(down)
        return z._replace(position=place)

    @abstractmethod
    def _steer(
        self, sticks: interface.Sticks, heading: float, state: Vector, dt: float, /
    ) -> tuple[AxisDemand, AxisDemand]:
        """Return the motion north and east commanded by pitch and roll."""


class Altitude(Piloted, modes=(Mode.ALTITUDE,)):
    """Tilt proportional to the sticks."""

    def _steer(
        self, sticks: interface.Sticks, heading: float, _state: Vector, _dt: float, /
    ) -> tuple[AxisDemand, AxisDemand]:
        # The tangent grows without bound at 90 degrees.
        tilt = min(89.0, self._context.value("MPC_MAN_TILT_MAX")) * DEG
        most = min(3.0, max(0.02, math.tan(tilt))) * GRAVITY_M_S2
        length = max(1.0, math.hypot(sticks.pitch, sticks.roll))
        forward, right = sticks.pitch / length * most, sticks.roll / length * most
        c, s = math.cos(heading), math.sin(heading)
        north, east = c * forward - s * right, s * forward + c * right
        return AxisDemand(interface.NAN, interface.NAN, north), AxisDemand(
            interface.NAN, interface.NAN, east
        )


class Position(Piloted, modes=(Mode.POSITION,)):
    """Motion commanded by the sticks."""

    prevents_collisions = False
    """True if CP_DIST is observed, by an add-on."""

    def __init__(self, context: interface.FlightContext, /) -> None:
        super().__init__(context)
        self._horizontal = HorizontalStick(context.value)

    def enter(self, state: Vector, request: interface.ModeRequest | None, /) -> None:
        """Start with the current motion."""
        super().enter(state, request)
        # A pilot who relies on CP_DIST must know that it is not active.
        if not self.prevents_collisions and self._context.value("CP_DIST") > 0.0:
            text = "CP_DIST has no effect without the add-on extra_modes"
            self._context.say(OperatorText(Severity.CRITICAL, text))

    def _restart(self, state: Vector) -> None:
        super()._restart(state)
        north, east, _ = triple(state, V)
        self._horizontal.restart((north, east))

    def _steer(
        self, sticks: interface.Sticks, heading: float, state: Vector, dt: float, /
    ) -> tuple[AxisDemand, AxisDemand]:
        north, east, _ = triple(state, P)
        deflected = sticks.pitch, sticks.roll
        limiter = self._limiter(state)
        return self._horizontal.move(deflected, heading, (north, east), dt, limiter)

    def _limiter(self, _state: Vector, /) -> Callable[[Pair, Pair], Pair] | None:
        """Return the limiter of `HorizontalStick.move`; None = unlimited."""
        return None


IDLE_THROTTLE = -0.9
"""Deflection below which a standing vehicle stays, and its heading setpoint follows the heading."""

RELEASED = interface.Sticks(0.0, 0.0, 0.0, 0.0)
"""Centred sticks, used after stick loss until the failsafe acts."""


class Stabilized(interface.FlightMode, modes=(Mode.MANUAL, Mode.STABILIZED)):
    """Tilt proportional to the sticks, thrust from the throttle stick."""

    def __init__(self, context: interface.FlightContext, /) -> None:
        self._context = context
        self._yaw = 0.0
        self._time_us: int | None = None

    @property
    def lifts(self) -> bool:
        """True if the throttle stick commands thrust."""
        sticks = self._context.sticks
        return sticks is not None and sticks.throttle > IDLE_THROTTLE

    def enter(self, state: Vector, _request: interface.ModeRequest | None, /) -> None:
        """Start with the current heading."""
        self._yaw, self._time_us = quat_yaw(state[Q:RATES]), None

    def demand(self, state: Vector, time_us: int, /) -> AttitudeDemand:
        """Return the demand of the sticks."""
        value, sticks = self._context.value, self._context.sticks or RELEASED
        dt, self._time_us = interface.since(self._time_us, time_us), time_us
        rate = sticks.yaw * value("MPC_MAN_Y_MAX") * DEG
        # On the ground the heading follows the vehicle: a stored heading would turn it at take-off.
        if sticks.throttle < IDLE_THROTTLE:
            self._yaw = quat_yaw(state[Q:RATES])
        else:
            self._yaw = wrap_pi(self._yaw + rate * dt)
        most = value("MPC_MAN_TILT_MAX") * DEG
        roll, pitch = sticks.roll * most, -sticks.pitch * most
        tilt = math.hypot(roll, pitch)
        # Both sticks at full travel must not exceed the tilt of one.
        share = 1.0 if tilt <= most else most / tilt
        half = 0.5 * tilt * share
        scale = math.sin(half) / tilt if tilt > 0.0 else 0.0
        leaning = (math.cos(half), roll * scale, pitch * scale, 0.0)
        # Heading first, then the lean in the heading's frame: sticks are relative to the nose.
        heading = (math.cos(self._yaw / 2.0), 0.0, 0.0, math.sin(self._yaw / 2.0))
        return AttitudeDemand(multiply(heading, leaning), rate, thrust_of(sticks.throttle, value))


def thrust_of(throttle: float, value: Callable[[str], float]) -> float:
    """Return the collective 0..1 of a throttle stick -1..1; centre = hover (MPC_THR_CURVE)."""
    low, high = value("MPC_MANTHR_MIN"), value("MPC_THR_MAX")
    # 1: linear over the full range, so the centre is not the hover thrust.
    if value("MPC_THR_CURVE") == 1.0:
        return low + 0.5 * (throttle + 1.0) * (high - low)
    hover = value("MPC_THR_HOVER")
    return hover + throttle * (high - hover if throttle > 0.0 else hover - low)
