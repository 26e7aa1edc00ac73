"""What a policy sees: a depth image, its own motion and the goal.

One encoder for all: `encode` turns a frame and the vehicle's telemetry into an Observation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from airl_mav.camera.frame import Frame
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.frames import Vector, ned_to_heading, quat_to_euler


@dataclass(frozen=True)
class Kinematics:
    """The vehicle's own state, as telemetry reports it."""

    position: Vector  # (3,) local NED [m]
    velocity: Vector  # (3,) NED [m/s]
    quaternion: Vector  # (4,) body FRD -> NED


@dataclass(frozen=True)
class Observation:
    """Input of a policy. The heading frame is level and follows the nose: forward, right, down."""

    depth_m: NDArray[np.float32]  # (h, w) along the optical axis [m]; 0 = no return
    intrinsics: Intrinsics
    goal: Vector  # (2,) goal relative to the vehicle, forward and right [m]
    velocity: Vector  # (3,) heading frame [m/s]
    roll: float
    """[rad]."""
    pitch: float
    """[rad]."""

    @property
    def goal_distance(self) -> float:
        """Horizontal distance to the goal [m]."""
        return math.hypot(self.goal[0], self.goal[1])

    @property
    def goal_bearing(self) -> float:
        """Direction of the goal relative to the nose [rad], positive to the right."""
        return math.atan2(self.goal[1], self.goal[0])


def encode(frame: Frame, state: Kinematics, goal: tuple[float, float]) -> Observation:
    """Return the observation of a frame, telemetry and a goal (north, east [m])."""
    euler = quat_to_euler(state.quaternion)
    to_goal = np.array([goal[0] - state.position[0], goal[1] - state.position[1], 0.0])
    return Observation(
        depth_m=frame.depth_m(),
        intrinsics=frame.intrinsics,
        goal=ned_to_heading(to_goal, euler.yaw)[:2],
        velocity=ned_to_heading(state.velocity, euler.yaw),
        roll=euler.roll,
        pitch=euler.pitch,
    )
