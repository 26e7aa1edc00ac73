"""Common base of Altitude and Position: throttle stick climbs, yaw stick turns."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable
from typing import NamedTuple

from airl_mav.control.demand import AnyDemand, TrajectoryDemand
from airl_mav.core.frames import Vector, quat_yaw
from firmware_sim.autopilot.error_state import RATES, P, Q, V
from firmware_sim.autopilot.manual_control import Sticks
from firmware_sim.autopilot.modes.interface import (
    FlightContext,
    FlightMode,
    descend,
    since,
    triple,
)
from firmware_sim.autopilot.modes.stick_motion import (
    AxisDemand,
    VerticalStick,
    YawStick,
    deadzone,
    expo,
)
from firmware_sim.autopilot.requests import ModeRequest

NAN = math.nan
HOLD = 2
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
        self.locked_m = NAN
        """Held height above ground; NaN = none."""
        self._resets: int | None = None

    def place(self, now: Piloting, held: float) -> float:
        """Return the target height, NED [m], NaN = none; `held` is the sticks' held height."""
        if int(self._value("MPC_ALT_MODE")) != HOLD:
            self.restart()
            return held
        if now.resets != self._resets:
            self._resets, self.locked_m = now.resets, NAN
        known, limit = math.isfinite(now.ground_m), self._value("MPC_HOLD_MAX_XY")
        deflected = now.level > _DEFLECTED
        if self.holds:
            if deflected or now.speed_m_s > limit or not known:
                self.holds = False
        elif not deflected and now.speed_m_s < 0.5 * limit and known:
            self.holds = True
            if math.isfinite(held):
                # Keep the height error.
                self.locked_m = now.ground_m - (held - now.down_m)
        if not self.holds:
            if not now.climbing and math.isnan(held):
                self.locked_m = NAN
            return held
        return self._follow(now)

    def _follow(self, now: Piloting) -> float:
        slow = self._value("MPC_HOLD_MAX_Z")
        stopped = slow <= 0.0 or abs(now.climb_m_s) < slow
        if now.climbing:
            self.locked_m = NAN
        elif math.isnan(self.locked_m) and stopped:
            self.locked_m = now.ground_m
        return now.down_m - (self.locked_m - now.ground_m)


LIFTING_THROTTLE = 0.3
"""Minimum deflection for a take-off: PX4's 65 % of the stick's travel."""


class Piloted(FlightMode):
    """Stick mode; without pilot input it descends level."""

    def __init__(self, context: FlightContext, /) -> None:
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

    def enter(self, state: Vector, _request: ModeRequest | None, /) -> None:
        """Start with the current motion."""
        self._vertical.restart(state.item(P + 2), state.item(V + 2))
        self._turning.restart()
        self._terrain.restart()
        self._yaw, self._time_us = quat_yaw(state[Q:RATES]), None

    def demand(self, state: Vector, time_us: int, /) -> AnyDemand:
        """Return the demand of the sticks."""
        sticks = self._context.sticks
        dt, self._time_us = since(self._time_us, time_us), time_us
        if sticks is None:
            yaw = self._yaw
            self.enter(state, None)
            self._yaw = yaw
            return descend(yaw)
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

    def _over_ground(self, sticks: Sticks, state: Vector, z: AxisDemand) -> AxisDemand:
        """Return the vertical demand, which holds the height above ground if enabled."""
        value, hold, (vn, ve, vd) = self._context.value, self._terrain, triple(state, V)
        zone = value("MPC_HOLD_DZ")
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
        if before and not hold.holds:
            place = self._vertical.put(down)
        return z._replace(position=place)

    @abstractmethod
    def _steer(
        self, sticks: Sticks, heading: float, state: Vector, dt: float, /
    ) -> tuple[AxisDemand, AxisDemand]:
        """Return the motion north and east commanded by pitch and roll."""
