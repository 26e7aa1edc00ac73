"""ODOMETRY and VISION_POSITION_ESTIMATE: poses that somebody else estimates, for the estimator.

Source: PX4 1.16, MavlinkReceiver::handle_message_odometry and handle_message_vision_position_
estimate, and EKF2::UpdateExtVisionSample, which drops what is not a rotation. Motion capture, as
ODOMETRY of that type or ATT_POS_MOCAP, has no effect: PX4 publishes it apart, and EKF2 does not
take it. When a sample was measured is told by EKF2_EV_DELAY alone: clocks are not compared.
"""

from __future__ import annotations

import numpy as np

from airl_mav.core.frames import Vector, quat_from_euler
from firmware_sim.autopilot.autopilot_state import Message, Severity
from firmware_sim.autopilot.events import command_events as events
from firmware_sim.interfaces import Odometry, PoseFrame, VelocityFrame
from firmware_sim.mavlink.codec import WireMessage, dialect
from firmware_sim.mavlink.services.context import Context
from firmware_sim.mavlink.streams.units import DIAGONAL

_FUSED = (
    dialect.MAV_ESTIMATOR_TYPE_UNKNOWN,
    dialect.MAV_ESTIMATOR_TYPE_NAIVE,
    dialect.MAV_ESTIMATOR_TYPE_VISION,
    dialect.MAV_ESTIMATOR_TYPE_VIO,
)

_POSES: dict[int, tuple[PoseFrame, bool]] = {
    dialect.MAV_FRAME_LOCAL_NED: ("ned", False),
    dialect.MAV_FRAME_LOCAL_ENU: ("ned", True),
    dialect.MAV_FRAME_LOCAL_FRD: ("frd", False),
    dialect.MAV_FRAME_LOCAL_FLU: ("frd", True),
}
"""The frame of a pose, and whether its axes are others than ours."""

_VELOCITIES: dict[int, tuple[VelocityFrame, bool]] = {
    **_POSES,
    dialect.MAV_FRAME_BODY_NED: ("body", False),
    dialect.MAV_FRAME_BODY_OFFSET_NED: ("body", False),
    dialect.MAV_FRAME_BODY_FRD: ("body", False),
}

_NOT_TOLD = np.full(6, np.nan)

_UNIT_TOLERANCE = 1e-5
"""A quaternion's length may differ from 1 by so much."""


def handle_odometry(message: WireMessage, context: Context) -> bool:
    """Hand over what is valid of it; an estimator's type that PX4 does not take is told, once."""
    kind = message.estimator_type
    if kind == dialect.MAV_ESTIMATOR_TYPE_MOCAP:
        return False
    if kind not in _FUSED:
        text = f"ODOMETRY: estimator_type {kind} unsupported"
        if text not in context.refusals:
            context.refusals.add(text)
            event = events.ODOMETRY_ESTIMATOR
            context.announce(Message.of(Severity.CRITICAL, event, kind, text=text))
        return False
    naive = kind == dialect.MAV_ESTIMATOR_TYPE_NAIVE
    place = _finite(message.x, message.y, message.z)
    pose, twist = _POSES.get(message.frame_id), _VELOCITIES.get(message.child_frame_id)
    position, of_pose = _in_our_axes(pose, place, message.pose_covariance, naive=naive)
    moving = _finite(message.vx, message.vy, message.vz)
    velocity, of_twist = _in_our_axes(twist, moving, message.velocity_covariance, naive=naive)
    return _see(
        Odometry(
            position,
            velocity,
            _rotation(np.array(message.q)),
            pose[0] if pose is not None else "ned",
            twist[0] if twist is not None else "ned",
            of_pose[:3],
            of_twist[:3],
            of_pose[3:],
            message.reset_counter,
            max(0, message.quality),
        ),
        context,
    )


def handle_vision_position(message: WireMessage, context: Context) -> bool:
    """Hand over a pose in local NED."""
    told = _diagonal(message.covariance)
    angles = _finite(message.roll, message.pitch, message.yaw)
    return _see(
        Odometry(
            _finite(message.x, message.y, message.z),
            None,
            None if angles is None else quat_from_euler(*angles.tolist()),
            position_variance=told[:3],
            orientation_variance=told[3:],
            reset_counter=message.reset_counter,
        ),
        context,
    )


def _see(odometry: Odometry, context: Context) -> bool:
    if odometry.position is None and odometry.velocity is None and odometry.quaternion is None:
        return False
    context.port.see(odometry)
    return True


def _finite(x: float, y: float, z: float) -> Vector | None:
    vector = np.array([x, y, z])
    return vector if np.isfinite(vector).all() else None


def _in_our_axes(
    frame: tuple[str, bool] | None,
    vector: Vector | None,
    covariance: tuple[float, ...],
    *,
    naive: bool,
) -> tuple[Vector | None, Vector]:
    """Return a vector and variances (6,); None and NaN where they are not known.

    Args:
        frame: Its frame, and whether that has other axes than ours; None = not one of ours.
        vector: As it was told (3,).
        covariance: As it was told.
        naive: Whether its sender cannot tell one.
    """
    if frame is None:
        return None, _NOT_TOLD
    name, other_axes = frame
    variances = _NOT_TOLD if naive else _diagonal(covariance)
    if not other_axes:
        return vector, variances
    if name == "ned":
        variances = variances[[1, 0, 2, 3, 4, 5]]
    return None if vector is None else _ours(name, vector), variances


def _ours(frame: str, vector: Vector) -> Vector:
    """Return a vector of east, north, up, or of forward, left, up, in our axes."""
    a, b, up = vector.tolist()
    return np.array([b, a, -up]) if frame == "ned" else np.array([a, -b, -up])


def _diagonal(triangle: tuple[float, ...]) -> Vector:
    """Return the diagonal (6,) of a covariance; NaN where it is not known."""
    return np.array([triangle[i] for i in DIAGONAL])


def _rotation(quaternion: Vector) -> Vector | None:
    length = float(np.linalg.norm(quaternion))
    # Written so that NaN fails.
    if not abs(length - 1.0) <= _UNIT_TOLERANCE:
        return None
    rotation: Vector = quaternion / length
    return rotation
