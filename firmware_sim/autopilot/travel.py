"""Motion of the automatic modes: smooth paths with PX4's limits and heading.

Source: PX4 1.16, FlightTaskAuto.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from airl_mav.control.demand import TrajectoryDemand
from airl_mav.core.constants import DEG, US_PER_S
from airl_mav.core.frames import Vector, quat_yaw, wrap_pi
from airl_mav.vehicle.rotation import Vec
from firmware_sim.autopilot.error_state import RATES, P, Q, V
from firmware_sim.autopilot.trajectory import PathLimits, PathSegment, SmoothTrajectory

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

    def stop(self) -> None:
        """Restart the trajectory at the vehicle with the next leg."""
        self._time_us = None

    def launch(self, state: Vector, time_us: int, climb_m_s: float) -> None:
        """Start at a vehicle about to leave the ground with a climb rate [m/s]."""
        self._trajectory.restart(_three(state, P), (0.0, 0.0, -climb_m_s))
        self._yaw, self._yaw_rate, self._wanted_yaw = quat_yaw(state[Q:RATES]), 0.0, None
        self._time_us = time_us

    def fly(
        self,
        state: Vector,
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
        position, velocity = _three(state, P), _three(state, V)
        now = quat_yaw(state[Q:RATES])
        if self._time_us is None or time_us - self._time_us > PAUSE_US:
            self._trajectory.restart(position, velocity)
            self._yaw, self._yaw_rate, self._wanted_yaw = now, 0.0, None
            elapsed_s = 0.0
        else:
            elapsed_s = (time_us - self._time_us) / US_PER_S
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
        limit = self._value("MPC_YAWRAUTO_MAX") * DEG
        most = limit * elapsed_s
        step = min(most, max(-most, wrap_pi(yaw - self._yaw)))
        self._yaw = wrap_pi(self._yaw + step)
        if elapsed_s > 0.0:
            weight = elapsed_s / (elapsed_s + YAW_RATE_TAU_S)
            self._yaw_rate += weight * (step / elapsed_s - self._yaw_rate)
            self._yaw_rate = min(limit, max(-limit, self._yaw_rate))


def stopping_place(state: Vector, value: Callable[[str], float]) -> Vec:
    """Return the stopping point NED [m] at the current height.

    Source: PX4 1.16, Navigator::preproject_stop_point.
    """
    north, east, down = _three(state, P)
    vn, ve, _ = _three(state, V)
    speed = math.hypot(vn, ve)
    # Deceleration delay of 0.6 s, as PX4 passes 0.6 of the jerk as an acceleration.
    distance_per_speed = speed / (2.0 * value("MPC_ACC_HOR")) + 0.6
    return north + vn * distance_per_speed, east + ve * distance_per_speed, down


def _three(state: Vector, start: int) -> Vec:
    north, east, down = state[start : start + 3].tolist()
    return north, east, down
