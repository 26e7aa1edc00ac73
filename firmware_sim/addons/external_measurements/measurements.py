"""Measurements from clients: poses, distances, optical flow, obstacles and landing targets.

Source: PX4 1.16, the handlers of these messages in MavlinkReceiver, and
EKF2::UpdateExtVisionSample, which drops quaternions without unit norm. The senders' time stamps are
ignored: the age of a pose is EKF2_EV_DELAY. Motion capture (ODOMETRY of this type, or
ATT_POS_MOCAP) has no effect: PX4 publishes it separately, and EKF2 does not use it.
"""

from __future__ import annotations

import math

import numpy as np

from airl_mav.core import constants, frames
from firmware_sim.autopilot.autopilot_state import OperatorText, Severity
from firmware_sim.autopilot.events import flight_events as events
from firmware_sim.autopilot.modes.interface import LandingTarget, ObstacleBins
from firmware_sim.interfaces import DistanceReading, FlowReading, Odometry, PoseFrame, VelocityFrame
from firmware_sim.mavlink.codec import WireMessage, dialect
from firmware_sim.mavlink.services import Context, Handlers, for_anyone
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
"""Frame of a pose, and True if its axes must be converted to NED or FRD."""

_VELOCITIES: dict[int, tuple[VelocityFrame, bool]] = {
    **_POSES,
    dialect.MAV_FRAME_BODY_NED: ("body", False),
    dialect.MAV_FRAME_BODY_OFFSET_NED: ("body", False),
    dialect.MAV_FRAME_BODY_FRD: ("body", False),
}

_NOT_TOLD = np.full(6, np.nan)

_UNIT_TOLERANCE = 1e-5
"""Maximum deviation of a quaternion's norm from 1."""


def handle_odometry(message: WireMessage, context: Context) -> bool:
    """Handle ODOMETRY: store its valid parts; report an unsupported estimator type once."""
    kind = message.estimator_type
    # PX4 publishes motion capture separately; EKF2 does not use it.
    if kind == dialect.MAV_ESTIMATOR_TYPE_MOCAP:
        return False
    if kind not in _FUSED:
        text = f"ODOMETRY: estimator_type {kind} unsupported"
        event = events.ODOMETRY_ESTIMATOR
        context.announce_once(OperatorText.of(Severity.CRITICAL, event, kind, text=text))
        return False
    naive = kind == dialect.MAV_ESTIMATOR_TYPE_NAIVE
    place = _finite(message.x, message.y, message.z)
    pose, twist = _POSES.get(message.frame_id), _VELOCITIES.get(message.child_frame_id)
    # NAIVE estimators send no covariance, so their variances are unknown.
    position, of_pose = _in_our_axes(pose, place, message.pose_covariance, naive=naive)
    moving = _finite(message.vx, message.vy, message.vz)
    velocity, of_twist = _in_our_axes(twist, moving, message.velocity_covariance, naive=naive)
    return _see(
        Odometry(
            position,
            velocity,
            _rotation(np.array(message.q)),
            # Without a vector the frame has no effect.
            pose[0] if pose is not None else "ned",
            twist[0] if twist is not None else "ned",
            of_pose[:3],
            of_twist[:3],
            of_pose[3:],
            message.reset_counter,
            # A negative quality means a failed estimate; 0 means unknown.
            max(0, message.quality),
        ),
        context,
    )


def handle_vision_position(message: WireMessage, context: Context) -> bool:
    """Handle VISION_POSITION_ESTIMATE: a pose in local NED."""
    variances = _diagonal(message.covariance)
    angles = _finite(message.roll, message.pitch, message.yaw)
    return _see(
        Odometry(
            _finite(message.x, message.y, message.z),
            None,
            None if angles is None else frames.quat_from_euler(*angles.tolist()),
            position_variance=variances[:3],
            orientation_variance=variances[3:],
            reset_counter=message.reset_counter,
        ),
        context,
    )


def _see(odometry: Odometry, context: Context) -> bool:
    if odometry.position is None and odometry.velocity is None and odometry.quaternion is None:
        return False
    context.port.receive("odometry", odometry)
    return True


def _finite(x: float, y: float, z: float) -> frames.Vector | None:
    vector = np.array([x, y, z])
    return vector if np.isfinite(vector).all() else None


def _in_our_axes(
    frame: tuple[str, bool] | None,
    vector: frames.Vector | None,
    covariance: tuple[float, ...],
    *,
    naive: bool,
) -> tuple[frames.Vector | None, frames.Vector]:
    """Return a vector and variances (6,) in NED or FRD; None and NaN if unknown.

    `frame` is the name, and True if the axes must be converted; None = an unknown frame. A `naive`
    sender has no covariance.
    """
    if frame is None:
        return None, _NOT_TOLD
    name, other_axes = frame
    variances = _NOT_TOLD if naive else _diagonal(covariance)
    if not other_axes:
        return vector, variances
    # ENU to NED swaps the first two axes; signs do not affect variances.
    if name == "ned":
        variances = variances[[1, 0, 2, 3, 4, 5]]
    return None if vector is None else _ours(name, vector), variances


def _ours(frame: str, vector: frames.Vector) -> frames.Vector:
    """Return a vector in ENU as NED, or a vector in FLU as FRD."""
    a, b, up = vector.tolist()
    return np.array([b, a, -up]) if frame == "ned" else np.array([a, -b, -up])


def _diagonal(triangle: tuple[float, ...]) -> frames.Vector:
    """Return the diagonal (6,) of a covariance; NaN = unknown."""
    return np.array([triangle[i] for i in DIAGONAL])


def _rotation(quaternion: frames.Vector) -> frames.Vector | None:
    length = float(np.linalg.norm(quaternion))
    # The negated comparison also rejects NaN.
    if not abs(length - 1.0) <= _UNIT_TOLERANCE:
        return None
    rotation: frames.Vector = quaternion / length
    return rotation


# --- distances, optical flow, obstacles, landing targets


def handle_distance(message: WireMessage, context: Context) -> bool:
    """Handle DISTANCE_SENSOR: the estimator uses downward-facing sensors only."""
    # Centimetres to metres; the variance [cm²] by the square of that.
    context.port.receive(
        "distance",
        DistanceReading(
            message.current_distance * 1e-2,
            message.min_distance * 1e-2,
            message.max_distance * 1e-2,
            message.covariance * 1e-4,
            quality_of(message.signal_quality),
            message.orientation,
            message.type,
        ),
    )
    return True


def quality_of(signal_quality: int) -> int:
    """Return the quality [%] of a field from 1 (invalid) to 100; -1 if the field is 0 (unknown).

    Values above 100 are clamped; PX4's byte would overflow.
    """
    return -1 if signal_quality == 0 else 100 * (min(signal_quality, 100) - 1) // 99


def handle_optical_flow(message: WireMessage, context: Context) -> bool:
    """Handle OPTICAL_FLOW_RAD. Ignores distance and temperature."""
    # Rotation of the sensor during the integration time, which the estimator removes.
    turned = (message.integrated_xgyro, message.integrated_ygyro, message.integrated_zgyro)
    context.port.receive(
        "flow",
        FlowReading(
            np.array([message.integrated_x, message.integrated_y]),
            message.integration_time_us / constants.US_PER_S,
            message.quality,
            np.array(turned),
        ),
    )
    return True


_IN_WORLD = (dialect.MAV_FRAME_GLOBAL, dialect.MAV_FRAME_LOCAL_NED)
_IN_BODY = dialect.MAV_FRAME_BODY_FRD


def handle_obstacle_distance(message: WireMessage, context: Context) -> bool:
    """Handle OBSTACLE_DISTANCE. Like PX4, report an unknown frame only if CP_DIST is set."""
    frame = message.frame
    # CP_DIST > 0 enables collision prevention.
    if frame not in _IN_WORLD and frame != _IN_BODY:
        if context.port.parameters.value("CP_DIST") > 0.0:
            text = f"Obstacle message received in unsupported frame {frame}"
            event = events.OBSTACLE_FRAME
            context.announce_once(OperatorText.of(Severity.CRITICAL, event, frame, text=text))
        return False
    # `increment_f` overrides the integer field if set.
    increment = message.increment_f if message.increment_f > 0.0 else float(message.increment)
    if not (0.0 < increment <= 360.0 and math.isfinite(message.angle_offset)):
        return False
    context.port.see_obstacles(
        ObstacleBins(
            tuple(message.distances),
            increment,
            message.angle_offset,
            message.min_distance,
            message.max_distance,
            in_world=frame in _IN_WORLD,
            time_us=context.now_us,
        )
    )
    return True


def handle_landing_target(message: WireMessage, context: Context) -> bool:
    """Handle LANDING_TARGET. Like PX4, accept only positions in local NED.

    Target bearings have no effect: they require a module that PX4 SITL does not start.
    """
    if not message.position_valid:
        return False
    if message.frame != dialect.MAV_FRAME_LOCAL_NED:
        text = f"Landing target: coordinate frame {message.frame} unsupported"
        event = events.LANDING_TARGET_FRAME
        context.announce_once(OperatorText.of(Severity.CRITICAL, event, message.frame, text=text))
        return False
    position = message.x, message.y, message.z
    if not all(map(math.isfinite, position)):
        return False
    context.port.landing_target(LandingTarget(position, context.now_us))
    return True


HANDLERS: Handlers = {
    "LANDING_TARGET": (for_anyone, handle_landing_target),
    "DISTANCE_SENSOR": (for_anyone, handle_distance),
    "OPTICAL_FLOW_RAD": (for_anyone, handle_optical_flow),
    "OBSTACLE_DISTANCE": (for_anyone, handle_obstacle_distance),
    "ODOMETRY": (for_anyone, handle_odometry),
    "VISION_POSITION_ESTIMATE": (for_anyone, handle_vision_position),
}
