"""Smooth trajectories: jerk-limited velocity per axis, and paths through waypoints.

Source: PX4 1.16, `VelocitySmoothing`, `PositionSmoothing`, `TrajectoryConstraints` and `TrajMath`
(lib/motion_planning, lib/mathlib): the motion of Hold, Return, missions and repositioning.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

from airl_mav.control.demand import TrajectoryDemand
from airl_mav.core import constants, frames
from airl_mav.vehicle.rotation import Vec
from firmware_sim.autopilot.error_state import RATES, P, Q, V

_TINY = 1e-9

TURNING_M_S = 0.2
TURNING_COSINE = 0.98
"""Minimum speed and maximum cosine of the angle to the target's direction in a turn
(PositionSmoothing::_isTurning)."""

LEAST_L1_M = 5.0
"""Minimum look-ahead distance of a turning vehicle on its leg [m]."""


class Axis:
    """Jerk-limited motion along one axis.

    `plan` computes three phases (jerk, constant acceleration, opposite jerk) to a velocity;
    `advance` moves along them.
    """

    def __init__(self) -> None:
        self.position = 0.0
        self.velocity = 0.0
        self.acceleration = 0.0
        self._target_velocity = 0.0
        self._jerk = 0.0
        """Jerk of the first phase, signed."""
        self._limit = 0.0
        """Maximum acceleration."""
        self._phases = (0.0, 0.0, 0.0)
        """Durations of the phases [s]."""

    def restart(self, position: float, velocity: float) -> None:
        """Continue from a position and velocity, without acceleration and plan."""
        self.position, self.velocity, self.acceleration = position, velocity, 0.0
        self._jerk, self._phases = 0.0, (0.0, 0.0, 0.0)

    @property
    def duration_s(self) -> float:
        """Time to the planned velocity [s]."""
        return sum(self._phases)

    def plan(self, velocity: float, limit: float, jerk: float) -> None:
        """Plan the fastest change to a velocity [m/s] within an acceleration and a jerk > 0."""
        a0 = self.acceleration
        # Velocity after the present acceleration has ended at the maximum jerk.
        coasting = self.velocity + 0.5 * a0 * abs(a0) / jerk
        sign = _sign(velocity - coasting) or _sign(a0)
        self._target_velocity, self._jerk, self._limit = velocity, sign * jerk, limit
        if sign == 0.0:
            self._phases = (0.0, 0.0, 0.0)
            return
        # Peak acceleration of a plan without a constant phase.
        square = 0.5 * a0 * a0 + self._jerk * (velocity - self.velocity)
        self._ramp_to(sign * math.sqrt(max(0.0, square)), None)

    def stretch(self, duration_s: float) -> None:
        """Extend the plan to a duration [s], if possible without more jerk."""
        if self._jerk == 0.0:
            return
        a0, jerk = self.acceleration, self._jerk
        # The peak p solves p² - (jerk T + a0) p + a0²/2 + jerk dv = 0.
        b = jerk * duration_s + a0
        rest = b * b - 2.0 * a0 * a0 - 4.0 * jerk * (self._target_velocity - self.velocity)
        root = math.copysign(math.sqrt(max(0.0, rest)), jerk)
        self._ramp_to(0.5 * (b - root), duration_s)

    def _ramp_to(self, peak: float, duration_s: float | None) -> None:
        """Compute the phases from the acceleration of the second phase."""
        a0, jerk = self.acceleration, self._jerk
        # The limit cuts the peak; a constant phase makes up for it.
        peak = min(self._limit, max(-self._limit, peak))
        up = max(0.0, (peak - a0) / jerk)
        peak = a0 + jerk * up
        down = max(0.0, peak / jerk)
        if duration_s is not None:
            flat = max(0.0, duration_s - up - down)
        elif abs(peak) > _TINY:
            # Speed gained by both ramps; the rest comes from the constant phase.
            gained = 0.5 * (a0 + peak) * up + 0.5 * peak * down
            flat = max(0.0, (self._target_velocity - self.velocity - gained) / peak)
        else:
            flat = 0.0
        self._phases = (up, flat, down)

    def advance(self, seconds: float) -> None:
        """Advance along the plan, and beyond its end at constant velocity."""
        remaining, rests = seconds, []
        for duration, jerk in zip(self._phases, (self._jerk, 0.0, -self._jerk), strict=True):
            step = min(remaining, duration)
            self._move(step, jerk)
            rests.append(duration - step)
            remaining -= step
        up, flat, down = rests
        self._phases = (up, flat, down)
        # Beyond the plan the acceleration is exactly zero, without rounding errors.
        if remaining > 0.0:
            self.acceleration = 0.0
            self._move(remaining, 0.0)

    def _move(self, t: float, jerk: float) -> None:
        a, v = self.acceleration, self.velocity
        # Exact integration: the jerk is constant within a phase.
        self.position += v * t + a * t * t / 2.0 + jerk * t**3 / 6.0
        self.velocity += a * t + jerk * t * t / 2.0
        self.acceleration += jerk * t


def synchronise(axes: Sequence[Axis]) -> None:
    """Stretch all axes to the duration of the slowest, for a straight path."""
    longest = max(axis.duration_s for axis in axes)
    for axis in axes:
        if axis.duration_s < longest:
            axis.stretch(longest)


class PathLimits(NamedTuple):
    """Limits of a path, from PX4's parameters."""

    cruise_m_s: float
    """Horizontal speed (MPC_XY_CRUISE, MAV_CMD_DO_CHANGE_SPEED)."""
    up_m_s: float
    down_m_s: float
    acceleration_m_s2: float
    """Horizontal acceleration."""
    up_m_s2: float
    down_m_s2: float
    jerk_m_s3: float
    acceptance_m: float
    """Horizontal distance within which a waypoint is rounded."""
    vertical_acceptance_m: float
    error_m: float
    """Tracking error at which the trajectory waits for the vehicle (MPC_XY_ERR_MAX)."""
    turn_share: float
    """Share of the acceleration used for a turn at a waypoint (MPC_XY_TRAJ_P)."""


class PathSegment(NamedTuple):
    """Path to a target. Previous and following waypoint shape the turns."""

    target: Vec
    """Target, NED [m]."""
    previous: Vec | None = None
    """Start of the leg; None = undefined."""
    following: Vec | None = None
    """Waypoint after the target; None = the vehicle stops at the target."""
    vertical_m_s: float = math.nan
    """Fixed vertical speed NED, which overrides the target's height; NaN = fly to that height."""
    velocity: Vec = (0.0, 0.0, 0.0)
    """Velocity of a moving target, NED [m/s]."""


class SmoothTrajectory:
    """Setpoint that moves smoothly to a target."""

    def __init__(self) -> None:
        self.axes = (Axis(), Axis(), Axis())
        """Axes in NED order."""
        self._turn_speed = 0.0
        """Speed at the start of the current turn."""
        self._climbing = False

    def restart(self, position: Vec, velocity: Vec) -> None:
        """Continue from a position and velocity NED, without acceleration."""
        for axis, p, v in zip(self.axes, position, velocity, strict=True):
            axis.restart(p, v)

    @property
    def position(self) -> Vec:
        """Position NED [m]."""
        x, y, z = self.axes
        return x.position, y.position, z.position

    @property
    def velocity(self) -> Vec:
        """Velocity NED [m/s]."""
        x, y, z = self.axes
        return x.velocity, y.velocity, z.velocity

    @property
    def acceleration(self) -> Vec:
        """Acceleration NED [m/s²]."""
        x, y, z = self.axes
        return x.acceleration, y.acceleration, z.acceleration

    def advance(self, vehicle: Vec, leg: PathSegment, limits: PathLimits, seconds: float) -> None:
        """Advance by a time [s] with the vehicle at a position NED [m]."""
        target_velocity = self._target_velocity(leg, limits)
        # The trajectory slows down in time, so its shape stays.
        share = self._waiting(vehicle, limits.error_m)
        for axis in self.axes:
            axis.advance(seconds * share)
        self.follow(target_velocity, limits)

    def follow(self, velocity: Vec, limits: PathLimits) -> None:
        """Plan a change to a velocity NED [m/s]."""
        x, y, z = self.axes
        self._climbing = velocity[2] < 0.0
        vertical = limits.up_m_s2 if self._climbing else limits.down_m_s2
        x.plan(velocity[0], limits.acceleration_m_s2, limits.jerk_m_s3)
        y.plan(velocity[1], limits.acceleration_m_s2, limits.jerk_m_s3)
        z.plan(velocity[2], vertical, limits.jerk_m_s3)
        synchronise(self.axes)

    def _target_velocity(self, leg: PathSegment, limits: PathLimits) -> Vec:
        """Return the velocity NED towards the target."""
        here, target = self.position, leg.target
        turning = leg.previous is not None and self._is_turning(target, limits.acceptance_m)
        aim = target
        if turning and leg.previous is not None:
            aim = _aim_ahead(here, leg.previous, target, limits.acceptance_m)
        speed = _horizontal_speed(here, leg, limits)
        # In a turn the speed may not rise.
        if turning:
            speed = min(self._turn_speed, speed)
        else:
            self._turn_speed = speed
        # Free height: the vertical speed is given, as in a landing.
        if not math.isnan(leg.vertical_m_s):
            return (*_scaled(aim[0] - here[0], aim[1] - here[1], speed), leg.vertical_m_s)
        vertical = self._vertical_speed(leg, limits)
        way = tuple(a - h for a, h in zip(aim, here, strict=True))
        length = math.sqrt(sum(w * w for w in way))
        if length < _TINY:
            return leg.velocity
        # Scale the direction to the combined speed; `_clamped` then applies both limits.
        total = math.hypot(speed, vertical) / length
        velocity = (way[0] * total, way[1] * total, way[2] * total)
        (vx, vy, vz), (mx, my, mz) = _clamped(velocity, speed, vertical), leg.velocity
        return vx + mx, vy + my, vz + mz

    def _is_turning(self, target: Vec, acceptance_m: float) -> bool:
        (x, y, _), (vx, vy, _) = self.position, self.velocity
        north, east = target[0] - x, target[1] - y
        speed, distance = math.hypot(vx, vy), math.hypot(north, east)
        # Slow or close: the direction of motion says nothing about a turn.
        if speed <= TURNING_M_S or distance <= acceptance_m:
            return False
        return (vx * north + vy * east) / (speed * distance) < TURNING_COSINE

    def _vertical_speed(self, leg: PathSegment, limits: PathLimits) -> float:
        """Return the maximum vertical speed now [m/s]."""
        here, target, after = self.position, leg.target, leg.following
        climbing = target[2] < here[2]
        most = limits.up_m_s if climbing else limits.down_m_s
        acceleration = limits.up_m_s2 if climbing else limits.down_m_s2
        # Arrival speed at a waypoint with a change of height: limited by the turn.
        arrival = 0.0
        if after is not None and abs(target[2] - after[2]) > 1e-3:
            back = math.hypot(target[0] - here[0], target[1] - here[1])
            on = math.hypot(target[0] - after[0], target[1] - after[1])
            # The turn in the vertical plane, with horizontal distance as the first axis.
            angle = _angle((-back, here[2]), (0.0, target[2]), (on, after[2]))
            arrival = min(most, _turn_speed(angle, acceleration, limits.vertical_acceptance_m))
        distance = abs(target[2] - here[2])
        return min(most, braking_speed(distance, acceleration, limits.jerk_m_s3, arrival))

    def _waiting(self, vehicle: Vec, error_m: float) -> float:
        """Return the time scale of the trajectory, reduced while the vehicle lags behind."""
        (x, y, _), (vx, vy, _) = self.position, self.velocity
        north, east = x - vehicle[0], y - vehicle[1]
        # A vehicle ahead of the trajectory does not slow it down.
        if error_m <= 0.0 or north * vx + east * vy < 0.0:
            return 1.0
        return 1.0 - min(1.0, math.hypot(north, east) / error_m)


def braking_speed(
    distance_m: float, acceleration: float, jerk: float, final_m_s: float = 0.0
) -> float:
    """Return the maximum initial speed [m/s] for braking to a final speed in a distance [m].

    Source: PX4 1.16, computeMaxSpeedFromDistance: constant deceleration, which starts after the
    time 2 acceleration / jerk.
    """
    b = 4.0 * acceleration * acceleration / jerk
    c = 2.0 * acceleration * distance_m + final_m_s * final_m_s
    return max(final_m_s, 0.5 * (math.sqrt(b * b + 4.0 * c) - b))


def _horizontal_speed(here: Vec, leg: PathSegment, limits: PathLimits) -> float:
    """Return the maximum horizontal speed now [m/s]."""
    target, after = leg.target, leg.following
    acceleration, jerk = limits.acceleration_m_s2, limits.jerk_m_s3
    arrival = 0.0
    # Speed at the waypoint: limited by the turn and by the next leg.
    if after is not None:
        beyond = math.hypot(target[0] - after[0], target[1] - after[1])
        if beyond >= max(limits.acceptance_m, 1e-3):
            angle = _angle(here[:2], target[:2], after[:2])
            turn = _turn_speed(angle, limits.turn_share * acceleration, limits.acceptance_m)
            leaving = min(limits.cruise_m_s, braking_speed(beyond, acceleration, jerk))
            arrival = min(turn, leaving, limits.cruise_m_s)
    distance = math.hypot(target[0] - here[0], target[1] - here[1])
    return min(limits.cruise_m_s, braking_speed(distance, acceleration, jerk, arrival))


def _turn_speed(angle: float, acceleration: float, radius_m: float) -> float:
    """Return the speed [m/s] on a circle that rounds a corner of an angle [rad]; pi = straight.

    Source: PX4 1.16, computeMaxSpeedInWaypoint.
    """
    # The circle touches both legs at the acceptance radius.
    return math.sqrt(acceleration * radius_m * math.tan(min(angle, math.pi - 1e-6) / 2.0))


def _angle(a: Sequence[float], b: Sequence[float], c: Sequence[float]) -> float:
    """Return the angle [rad] at corner b between the lines to a and c; pi / 2 if undefined.

    A straight path has pi.
    """
    ax, ay, cx, cy = a[0] - b[0], a[1] - b[1], c[0] - b[0], c[1] - b[1]
    lengths = math.hypot(ax, ay) * math.hypot(cx, cy)
    if lengths < _TINY:
        return math.pi / 2.0
    return math.acos(min(1.0, max(-1.0, (ax * cx + ay * cy) / lengths)))


def _aim_ahead(here: Vec, start: Vec, target: Vec, acceptance_m: float) -> Vec:
    """Return the point of the leg at the L1 look-ahead distance of a vehicle beside it."""
    along = [t - s for t, s in zip(target, start, strict=True)]
    length = math.sqrt(sum(a * a for a in along))
    if length < _TINY:
        return target
    x, y, z = (a / length for a in along)
    # Nearest point of the leg, then on along the leg by the look-ahead.
    done = (here[0] - start[0]) * x + (here[1] - start[1]) * y + (here[2] - start[2]) * z
    closest = (start[0] + done * x, start[1] + done * y, start[2] + done * z)
    l1, aside = max(acceptance_m, LEAST_L1_M), math.dist(closest, here)
    ahead = math.sqrt(l1 * l1 - aside * aside) if l1 > aside else 0.0
    return closest[0] + ahead * x, closest[1] + ahead * y, closest[2] + ahead * z


def _scaled(north: float, east: float, length: float) -> tuple[float, float]:
    """Return a horizontal vector scaled to a length; zero if it has no direction."""
    norm = math.hypot(north, east)
    return (0.0, 0.0) if norm < _TINY else (north * length / norm, east * length / norm)


def _clamped(velocity: Vec, horizontal: float, vertical: float) -> Vec:
    """Clip a velocity to both limits; a very small velocity is clipped per axis."""
    vx, vy, vz = velocity
    norm = math.hypot(vx, vy)
    if norm > horizontal:
        share = horizontal / norm
        vx, vy = vx * share, vy * share
        # Below 0.5 m/s each axis is clipped separately.
        vz = vz if max(horizontal, norm) < 0.5 else vz * share
    if abs(vz) > vertical:
        share = vertical / abs(vz)
        if max(vertical, abs(vz)) >= 0.5:
            vx, vy = vx * share, vy * share
        vz *= share
    return vx, vy, vz


def _sign(value: float) -> float:
    return (value > 0.0) - (value < 0.0)


PAUSE_US = 100_000
"""Pause after which the trajectory restarts at the vehicle [µs]."""

YAW_RATE_TAU_S = 0.2
"""Time constant of the feed-forward yaw rate [s]."""


class Travel:
    """Trajectory shared by the automatic modes: each mode continues the previous one's."""

    def __init__(self, value: Callable[[str], float]) -> None:
        """Store the look-up for PX4 parameters."""
        self._value = value
        self._trajectory = SmoothTrajectory()
        self._time_us: int | None = None
        self._yaw = 0.0
        """Heading setpoint [rad]."""
        self._yaw_rate = 0.0
        self._wanted_yaw: float | None = None
        """Heading without a requested one; None = the heading at the start of the leg."""
        self.speed_m_s = math.nan
        """Horizontal speed by MAV_CMD_DO_CHANGE_SPEED or similar; NaN = MPC_XY_CRUISE."""

    def launch(self, state: frames.Vector, time_us: int, climb_m_s: float) -> None:
        """Start at a vehicle about to leave the ground with a climb rate [m/s]."""
        self._trajectory.restart(triple(state, P), (0.0, 0.0, -climb_m_s))
        self._yaw, self._yaw_rate, self._wanted_yaw = frames.quat_yaw(state[Q:RATES]), 0.0, None
        self._time_us = time_us

    def fly(
        self,
        state: frames.Vector,
        time_us: int,
        leg: PathSegment,
        *,
        yaw: float = math.nan,
        limits: PathLimits | None = None,
    ) -> TrajectoryDemand:
        """Return the demand at a time [µs] along a leg.

        `yaw`: heading [rad]; NaN = towards the target, constant near it. `limits`: None = limits of
        the parameters.
        """
        position, velocity = triple(state, P), triple(state, V)
        now = frames.quat_yaw(state[Q:RATES])
        # After a pause the old trajectory is elsewhere.
        if self._time_us is None or time_us - self._time_us > PAUSE_US:
            self._trajectory.restart(position, velocity)
            self._yaw, self._yaw_rate, self._wanted_yaw = now, 0.0, None
            elapsed_s = 0.0
        else:
            elapsed_s = (time_us - self._time_us) / constants.US_PER_S
        self._time_us = time_us
        path = self._trajectory
        path.advance(position, leg, limits or self.limits(), elapsed_s)
        self._turn(self._heading(position, now, leg.target) if math.isnan(yaw) else yaw, elapsed_s)
        return TrajectoryDemand(
            path.position, path.velocity, path.acceleration, self._yaw, self._yaw_rate
        )

    def limits(self) -> PathLimits:
        """Return the limits of the parameters."""
        value = self._value
        speed = self.speed_m_s
        cruise = value("MPC_XY_CRUISE") if math.isnan(speed) else speed
        return PathLimits(
            cruise_m_s=min(cruise, value("MPC_XY_VEL_MAX")),
            up_m_s=value("MPC_Z_V_AUTO_UP"),
            down_m_s=value("MPC_Z_V_AUTO_DN"),
            acceleration_m_s2=value("MPC_ACC_HOR"),
            up_m_s2=value("MPC_ACC_UP_MAX"),
            down_m_s2=value("MPC_ACC_DOWN_MAX"),
            jerk_m_s3=value("MPC_JERK_AUTO"),
            acceptance_m=value("NAV_ACC_RAD"),
            vertical_acceptance_m=value("NAV_MC_ALT_RAD"),
            error_m=value("MPC_XY_ERR_MAX"),
            turn_share=value("MPC_XY_TRAJ_P"),
        )

    def _heading(self, position: Vec, now: float, target: Vec) -> float:
        """Return PX4's heading towards the waypoint (MPC_YAW_MODE 0), kept near the waypoint."""
        north, east = target[0] - position[0], target[1] - position[1]
        if math.hypot(north, east) > self._value("NAV_ACC_RAD"):
            self._wanted_yaw = math.atan2(east, north)
        elif self._wanted_yaw is None:
            self._wanted_yaw = now
        return self._wanted_yaw

    def _turn(self, yaw: float, elapsed_s: float) -> None:
        """Turn the heading setpoint, limited to MPC_YAWRAUTO_MAX."""
        limit = self._value("MPC_YAWRAUTO_MAX") * constants.DEG
        most = limit * elapsed_s
        # Turn on the shorter way.
        step = min(most, max(-most, frames.wrap_pi(yaw - self._yaw)))
        self._yaw = frames.wrap_pi(self._yaw + step)
        if elapsed_s > 0.0:
            # Low-pass: a step of the heading gives no jump of the rate.
            weight = elapsed_s / (elapsed_s + YAW_RATE_TAU_S)
            self._yaw_rate += weight * (step / elapsed_s - self._yaw_rate)
            self._yaw_rate = min(limit, max(-limit, self._yaw_rate))


def stopping_place(state: frames.Vector, value: Callable[[str], float]) -> Vec:
    """Return the stopping point NED [m] at the current height.

    Source: PX4 1.16, Navigator::preproject_stop_point.
    """
    north, east, down = triple(state, P)
    vn, ve, _ = triple(state, V)
    speed = math.hypot(vn, ve)
    # Deceleration delay of 0.6 s, as PX4 passes 0.6 of the jerk as an acceleration.
    distance_per_speed = speed / (2.0 * value("MPC_ACC_HOR")) + 0.6
    return north + vn * distance_per_speed, east + ve * distance_per_speed, down


def triple(state: frames.Vector, start: int) -> Vec:
    """Return three consecutive numbers of a state."""
    north, east, down = state[start : start + 3].tolist()
    return north, east, down
