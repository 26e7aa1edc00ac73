"""What each mode flies: mode and nominal state -> demand for the cascade."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from airl_mav.control.cascade import Demand
from airl_mav.core.constants import GRAVITY_M_S2, US_PER_S
from airl_mav.core.frames import Vector, quat_yaw
from airl_mav.vehicle.rotation import Vec
from firmware_sim.autopilot.autopilot_state import Mode, Setpoint
from firmware_sim.autopilot.climb import Climb, ClimbLimits
from firmware_sim.autopilot.commander import Phase
from firmware_sim.autopilot.error_state import RATES, P, Q, V

NAN = math.nan
_FREE = (NAN, NAN, NAN)

FALLBACK_DESCENT_M_S = 0.75
"""Descent in Position mode without a pilot's input (measured on PX4 1.16). The vehicle stays
level: drag alone slows it, from 1.0 to 0.3 m/s in 7 s (FlightTaskDescend)."""

RETURN_HEIGHT_REACHED_M = 0.2
"""The climb of a return ends this close to its height [m]."""

SETTLED_M = 0.01
"""From this close to it, the take-off altitude is held like any other [m]."""

# Bound once: looking up a member of an enumeration at every tick is slow.
_TAKEOFF, _OFFBOARD, _LAND = Mode.TAKEOFF, Mode.OFFBOARD, Mode.LAND
_HOLD = Mode.HOLD
_RETURN, _POSITION = Mode.RETURN, Mode.POSITION
_GROUND, _AIR = Phase.GROUND, Phase.AIR


def _triple(state: Vector, start: int) -> Vec:
    north, east, down = state[start : start + 3].tolist()
    return north, east, down


def _or_zero(value: float) -> float:
    return 0.0 if math.isnan(value) else value


@dataclass
class Anchor:
    """Where a mode began: the reference of hold, take-off, landing and return."""

    position: Vec
    """NED [m]."""
    yaw: float


class Guidance:
    """Turns the mode into a demand; `enter` notifies it of mode changes.

    Every `state` is the estimator's newest nominal state (`error_state`).
    """

    def __init__(self, value: Callable[[str], float]) -> None:
        """Take a lookup of PX4 parameter names."""
        self._value = value
        self._mode = Mode.HOLD
        self._anchor = Anchor((0.0, 0.0, 0.0), 0.0)
        self._braking = False
        self._return_leg = 0
        self._climb = Climb()
        self._settling = False
        """Whether hold still climbs to the altitude of a take-off that has ended."""
        self._spool_since_us: int | None = None
        self._now_us = 0
        self._home: Vec = (0.0, 0.0, 0.0)
        self._offboard: Demand | None = None
        self.takeoff_altitude_m = 0.0
        """Height above home that a take-off climbs to [m]."""

    def enter(self, mode: Mode, state: Vector) -> None:
        """Begin a new mode at the present state."""
        if mode is _HOLD and self.takeoff_done(state):
            # Hold goes on to the altitude, above the place where take-off began.
            north, east, _ = self._anchor.position
            self._mode, self._settling, self._braking = mode, True, False
            self._anchor.position = north, east, self._home[2] - self.takeoff_altitude_m
            return
        self._mode, self._settling = mode, False
        self._climb.restart(max(0.0, -state.item(V + 2)))
        self._anchor = Anchor(_triple(state, P), quat_yaw(state[Q:RATES]))
        self._braking = mode is Mode.HOLD
        self._return_leg = 0

    def at_home(self, state: Vector) -> None:
        """Make the present position home: the ground under the vehicle at arming."""
        self._home = _triple(state, P)
        self._spool_since_us = None

    def offer(self, setpoint: Setpoint) -> None:
        """Set what offboard flies from now on; an axis that is not commanded gets zero velocity."""
        north, east, down = _triple(setpoint.velocity, 0)
        velocity = _or_zero(north), _or_zero(east), _or_zero(down)
        self._offboard = Demand(
            _triple(setpoint.position, 0), velocity, setpoint.yaw, setpoint.yaw_rate
        )

    def takeoff_done(self, state: Vector) -> bool:
        """Return whether a take-off has come near its altitude, by PX4's acceptance radius.

        Source: PX4 1.16, MissionBlock; half of an altitude that is smaller than the radius.
        """
        if self._mode is not _TAKEOFF:
            return False
        altitude, radius = self.takeoff_altitude_m, self._value("NAV_MC_ALT_RAD")
        near = altitude / 2.0 if altitude < radius else radius
        return self._height(state) > altitude - near

    def demand(self, state: Vector, phase: Phase, time_us: int) -> Demand | None:
        """Return what to fly now; None = the motors are stopped."""
        self._now_us = time_us
        if phase is _AIR:
            self._spool_since_us = None
            return self._flown(state)
        if phase is _GROUND and self._wants_to_lift():
            return self._ramped(self._flown(state), time_us)
        self._spool_since_us = None
        return None

    def _wants_to_lift(self) -> bool:
        """Return whether the mode asks a standing vehicle to leave the floor."""
        if self._mode is _TAKEOFF:
            return True
        demand = self._offboard
        if self._mode is _OFFBOARD and demand is not None:
            return demand.velocity[2] < -0.1 or demand.position[2] < self._home[2] - 0.3
        return False

    def _ramped(self, demand: Demand, time_us: int) -> Demand:
        """Return a demand for a vehicle on the ground, its climb rate limited by the take-off ramp.

        PX4's Takeoff: after COM_SPOOLUP_TIME the vertical speed limit rises in MPC_TKO_RAMP_T
        from the value that commands zero thrust to the take-off speed. A height becomes that rate.
        """
        if self._spool_since_us is None:
            self._spool_since_us = time_us
        value = self._value
        elapsed_s = (time_us - self._spool_since_us) / US_PER_S
        ramp_s = elapsed_s - value("COM_SPOOLUP_TIME")
        limit = -GRAVITY_M_S2 / value("MPC_Z_VEL_P_ACC")
        if ramp_s > 0.0:
            share = min(1.0, ramp_s / max(value("MPC_TKO_RAMP_T"), 1e-3))
            limit += share * (value("MPC_TKO_SPEED") - limit)
        # Off the floor, the climb goes on from the ramp.
        self._climb.restart(max(0.0, limit))
        position, velocity, yaw, yaw_rate = demand
        down = -limit if math.isnan(velocity[2]) else max(velocity[2], -limit)
        return Demand(
            (position[0], position[1], NAN), (velocity[0], velocity[1], down), yaw, yaw_rate
        )

    def _flown(self, state: Vector) -> Demand:
        """Return the demand of the present mode."""
        mode = self._mode
        if mode is _OFFBOARD and self._offboard is not None:
            return self._offboard
        if mode is _TAKEOFF:
            return self._takeoff(state)
        if mode is _LAND:
            return self._land(state)
        if mode is _RETURN:
            return self._return(state)
        if mode is _POSITION:
            return Demand(_FREE, (NAN, NAN, FALLBACK_DESCENT_M_S), self._anchor.yaw, NAN)
        return self._hold(state)

    def _height(self, state: Vector) -> float:
        """Return the height above home [m]."""
        return self._home[2] - state.item(P + 2)

    def _hold(self, state: Vector) -> Demand:
        """Brake first, then hold the place where the vehicle came to rest."""
        anchor = self._anchor
        if self._settling:
            return self._settle()
        if self._braking:
            anchor.position = _triple(state, P)
            if math.hypot(*_triple(state, V)) > 0.3:
                return Demand(_FREE, (0.0, 0.0, 0.0), anchor.yaw, NAN)
            self._braking = False
        return Demand(anchor.position, _FREE, anchor.yaw, NAN)

    def _vertical(self, state: Vector, down_target: float, limit: float) -> float:
        """Return the vertical speed NED towards a height, limited [m/s]."""
        speed = self._value("MPC_Z_P") * (down_target - state.item(P + 2))
        return min(limit, max(-limit, speed))

    def _above_anchor(self, vertical: float) -> Demand:
        """Keep to the anchor's place and heading at a vertical speed NED [m/s]."""
        north, east, _ = self._anchor.position
        return Demand((north, east, NAN), (NAN, NAN, vertical), self._anchor.yaw, NAN)

    def _takeoff(self, state: Vector) -> Demand:
        # The trajectory stays where the vehicle is: it must not wait below the ground while the
        # thrust ramps up, nor be chased after it.
        self._climb.height_m = self._height(state)
        self._climb_on()
        return self._above_anchor(-self._climb.speed_m_s)

    def _settle(self) -> Demand:
        """Return the demand of hold between the end of a take-off and its altitude."""
        climb = self._climb
        self._climb_on()
        north, east, _ = self._anchor.position
        self._settling = abs(self.takeoff_altitude_m - climb.height_m) > SETTLED_M
        return Demand(
            (north, east, self._home[2] - climb.height_m),
            (NAN, NAN, -climb.speed_m_s),
            self._anchor.yaw,
            NAN,
        )

    def _climb_on(self) -> None:
        """Advance the trajectory towards the take-off altitude."""
        climb, target = self._climb, self.takeoff_altitude_m
        limits = self._limits(climb.height_m, up=target > climb.height_m)
        climb.towards(target, limits, self._now_us)

    def _limits(self, height: float, *, up: bool) -> ClimbLimits:
        """Return the limits of a climb as PX4's FlightTaskAuto has them, gentle near the ground."""
        value, jerk = self._value, self._value("MPC_JERK_AUTO")
        if not up:
            return ClimbLimits(value("MPC_Z_V_AUTO_DN"), value("MPC_ACC_DOWN_MAX"), jerk)
        speed, acceleration = value("MPC_Z_V_AUTO_UP"), value("MPC_ACC_UP_MAX")
        if self._mode is _TAKEOFF and height < value("MPC_LAND_ALT1"):
            speed = value("MPC_TKO_SPEED")
            acceleration = min(acceleration, speed / max(value("MPC_TKO_RAMP_T"), 1e-3))
        return ClimbLimits(speed, acceleration, jerk)

    def _land(self, state: Vector) -> Demand:
        speed = self._landing_speed(self._height(state))
        if not self._braking:
            north, east, _ = _triple(state, V)
            if math.hypot(north, east) > 0.3:
                # Still moving: stop first, then hold that place while descending.
                anchor = self._anchor
                anchor.position = _triple(state, P)
                return Demand(_FREE, (0.0, 0.0, speed), anchor.yaw, NAN)
            self._braking = True
        return self._above_anchor(speed)

    def _landing_speed(self, height: float) -> float:
        """Return how fast to descend [m/s]: PX4 slows down linearly between two heights."""
        value = self._value
        low, high = value("MPC_LAND_ALT2"), value("MPC_LAND_ALT1")
        slow, fast = value("MPC_LAND_SPEED"), value("MPC_Z_V_AUTO_DN")
        if height <= low:
            return slow
        if height >= high:
            return fast
        return slow + (fast - slow) / (high - low) * (height - low)

    def _return(self, state: Vector) -> Demand:
        """Climb to RTL_RETURN_ALT, fly home, land."""
        value, anchor, home = self._value, self._anchor, self._home
        position = _triple(state, P)
        north, east = position[0] - home[0], position[1] - home[1]
        away = math.hypot(north, east)
        if self._return_leg == 0:
            height = self._height(state)
            target = max(value("RTL_RETURN_ALT"), height)
            if height > target - RETURN_HEIGHT_REACHED_M or away < value("NAV_ACC_RAD"):
                self._return_leg = 1
                anchor.position = position
            climb = self._vertical(state, home[2] - target - 0.5, value("MPC_Z_VEL_MAX_UP"))
            return self._above_anchor(climb)
        if self._return_leg == 1:
            if away > 0.5:
                cruise = min(value("MPC_XY_CRUISE"), value("MPC_XY_P") * away)
                velocity = (-north / away * cruise, -east / away * cruise, NAN)
                return Demand((NAN, NAN, anchor.position[2]), velocity, anchor.yaw, NAN)
            self._return_leg = 2
            anchor.position = home
            self._braking = True  # almost at rest: descend to home itself
        return self._land(state)
