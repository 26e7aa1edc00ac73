"""Offboard setpoints, the pilot's sticks, and the target of Follow Me, as in PX4.

Source: PX4 1.16, MavlinkReceiver::handle_message_set_position_target_local_ned, _global_int,
_set_attitude_target, _manual_control, _rc_channels_override and _follow_target, checked against a
running PX4. PX4 reports every rejected message. Here
the same rejection is reported once, until a setpoint is accepted again.
"""

from __future__ import annotations

import math

import numpy as np

from airl_mav.control.demand import AttitudeDemand, RateDemand
from airl_mav.core import frames
from airl_mav.vehicle.rotation import rotate, yaw_of
from firmware_sim.autopilot.autopilot_state import OperatorText, Setpoint, Severity, Vector, Wire
from firmware_sim.autopilot.events import flight_events as events
from firmware_sim.autopilot.modes.interface import FollowedTarget, Source, Sticks
from firmware_sim.mavlink.codec import WireMessage, dialect
from firmware_sim.mavlink.services import Context, Handlers, for_anyone, for_vehicle_or_all

_CRITICAL = Severity.CRITICAL
_POSITION_SHIFT, _VELOCITY_SHIFT, _ACCELERATION_SHIFT = 0, 3, 6
"""First of each vector's three ignore bits (POSITION_TARGET_TYPEMASK)."""

_NOTHING = np.full(3, math.nan)

_THRUST_BODY_SET = 32
"""Bit of ATTITUDE_TARGET_TYPEMASK: `thrust_body` replaces `thrust`."""

_LEAST_QUATERNION = 1e-6
"""Minimum norm of a valid quaternion."""


def handle_local(message: WireMessage, context: Context) -> bool:
    """Handle SET_POSITION_TARGET_LOCAL_NED."""
    mask, frame = message.type_mask, message.coordinate_frame
    velocity = _masked((message.vx, message.vy, message.vz), mask >> _VELOCITY_SHIFT)
    acceleration = _NOTHING
    # Acceleration is optional: a fully ignored vector stays NaN.
    if mask >> _ACCELERATION_SHIFT & 0b111 != 0b111:
        acceleration = _masked((message.afx, message.afy, message.afz), mask >> _ACCELERATION_SHIFT)
    if frame == dialect.MAV_FRAME_LOCAL_NED:
        position = _masked((message.x, message.y, message.z), mask >> _POSITION_SHIFT)
    elif frame == dialect.MAV_FRAME_BODY_NED:
        # PX4 ignores positions in the body frame.
        position = _NOTHING
        q = context.port.attitude
        # All or none, as in PX4; velocities are rotated by the heading only.
        velocity = _NOTHING if mask >> _VELOCITY_SHIFT & 0b111 else _turned(velocity, q)
        if mask >> _ACCELERATION_SHIFT & 0b111:
            acceleration = _NOTHING
        else:
            w, x, y, z = q.tolist()
            forward, right, down = acceleration.tolist()
            acceleration = np.array(rotate((w, x, y, z), (forward, right, down)))
    else:
        text = f"{message.get_type()} coordinate frame {frame} unsupported"
        return _reject(context, OperatorText.of(_CRITICAL, events.LOCAL_FRAME, frame, text=text))
    if not _commands_something(position, velocity, acceleration):
        text = f"{message.get_type()} invalid"
        return _reject(context, OperatorText.of(_CRITICAL, events.LOCAL_INVALID, text=text))
    return _offer(message, position, velocity, acceleration, context)


def handle_global(message: WireMessage, context: Context) -> bool:
    """Handle SET_POSITION_TARGET_GLOBAL_INT: velocity and acceleration are local NED."""
    mask = message.type_mask
    velocity = _masked((message.vx, message.vy, message.vz), mask >> _VELOCITY_SHIFT)
    acceleration = _masked((message.afx, message.afy, message.afz), mask >> _ACCELERATION_SHIFT)
    position: Vector | None = _NOTHING
    # The position is optional as well; a partly ignored one counts as ignored.
    if not mask >> _POSITION_SHIFT & 0b111:
        frame = message.coordinate_frame
        if frame not in _FRAMES_ABOVE:
            text = f"{message.get_type()} invalid coordinate frame {frame}"
            return _reject(
                context, OperatorText.of(_CRITICAL, events.GLOBAL_FRAME, frame, text=text)
            )
        position = _from_globe(message, _FRAMES_ABOVE[frame], context)
    if position is None or not _commands_something(position, velocity, acceleration):
        return False  # PX4 sends no reply
    return _offer(message, position, velocity, acceleration, context)


def handle_attitude(message: WireMessage, context: Context) -> bool:
    """Handle SET_ATTITUDE_TARGET: attitude or body rates, with thrust."""
    mask: int = message.type_mask
    thrust = _thrust(message)
    demand: AttitudeDemand | RateDemand
    wire: Wire
    if not mask & dialect.ATTITUDE_TARGET_TYPEMASK_ATTITUDE_IGNORE:
        # A quaternion without direction cannot be normalized; NaN fails the comparison, too.
        q = np.array(message.q, np.float64)
        norm = float(np.linalg.norm(q))
        if not norm > _LEAST_QUATERNION or not math.isfinite(norm):
            return False
        w, x, y, z = (q / norm).tolist()
        ignored = mask & dialect.ATTITUDE_TARGET_TYPEMASK_BODY_YAW_RATE_IGNORE
        yaw_rate = 0.0 if ignored else _or_zero(message.body_yaw_rate)
        demand = AttitudeDemand((w, x, y, z), yaw_rate, thrust)
        # The wire tuple repeats what the client sent, for records.
        wire = (*frames.quat_to_euler(q / norm), thrust)
    elif not mask & (
        dialect.ATTITUDE_TARGET_TYPEMASK_BODY_ROLL_RATE_IGNORE
        | dialect.ATTITUDE_TARGET_TYPEMASK_BODY_PITCH_RATE_IGNORE
    ):
        ignored = mask & dialect.ATTITUDE_TARGET_TYPEMASK_BODY_YAW_RATE_IGNORE
        # NaN leaves the yaw rate to the flight controller.
        yaw_rate = math.nan if ignored else _finite(message.body_yaw_rate)
        rates = _or_zero(message.body_roll_rate), _or_zero(message.body_pitch_rate), yaw_rate
        demand = RateDemand(rates, thrust)
        wire = (*rates, thrust)
    else:
        return False  # PX4 sends no reply
    context.port.offer_attitude(demand, context.now_us, wire)
    context.refusals.clear()
    return True


def _offer(
    message: WireMessage,
    position: Vector,
    velocity: Vector,
    acceleration: Vector,
    context: Context,
) -> bool:
    mask: int = message.type_mask
    forced = mask & dialect.POSITION_TARGET_TYPEMASK_FORCE_SET
    # Force setpoints are accepted only without a finite acceleration, as in PX4.
    if forced and np.isfinite(acceleration).any():
        event = events.LOCAL_FORCE if _is_local(message) else events.GLOBAL_FORCE
        text = f"{message.get_type()} force not supported"
        return _reject(context, OperatorText.of(_CRITICAL, event, text=text))
    yaw = math.nan if mask & dialect.POSITION_TARGET_TYPEMASK_YAW_IGNORE else message.yaw
    yaw_rate = (
        math.nan if mask & dialect.POSITION_TARGET_TYPEMASK_YAW_RATE_IGNORE else message.yaw_rate
    )
    # The record has one yaw value: the rate if given, otherwise the angle.
    wire_yaw = message.yaw if math.isnan(yaw_rate) else yaw_rate
    wire = (message.vx, message.vy, message.vz, wire_yaw)
    context.port.offer_setpoint(
        Setpoint(
            position,
            velocity,
            yaw if math.isfinite(yaw) else math.nan,
            yaw_rate if math.isfinite(yaw_rate) else math.nan,
            wire,
            acceleration,
        ),
        context.now_us,
    )
    context.refusals.clear()
    return True


_ABOVE_SEA, _ABOVE_HOME, _ABOVE_TERRAIN = range(3)
_FRAMES_ABOVE = {
    dialect.MAV_FRAME_GLOBAL_INT: _ABOVE_SEA,
    dialect.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT: _ABOVE_HOME,
    dialect.MAV_FRAME_GLOBAL_TERRAIN_ALT_INT: _ABOVE_TERRAIN,
}


def _from_globe(message: WireMessage, above: int, context: Context) -> Vector | None:
    """Return the local position NED (3,) [m]; None if unknown, or relative to terrain."""
    state = context.port.state()
    origin, home = state.origin, state.home
    if origin is None or home is None or above == _ABOVE_TERRAIN:
        return None
    # The altitude is above sea level, or above home in the relative frame.
    altitude = message.alt + (home.altitude_m if above == _ABOVE_HOME else 0.0)
    place = frames.Geodetic(message.lat_int / 1e7, message.lon_int / 1e7, altitude)
    return frames.geodetic_to_local(place, origin)


def _thrust(message: WireMessage) -> float:
    """Return the collective 0..1; 0 if thrust is ignored."""
    mask: int = message.type_mask
    thrust = message.thrust
    if mask & _THRUST_BODY_SET:
        # `thrust_body` is FRD: upward thrust is negative z.
        thrust = -message.thrust_body[2]
    elif mask & dialect.ATTITUDE_TARGET_TYPEMASK_THROTTLE_IGNORE:
        thrust = 0.0
    return min(1.0, max(0.0, _or_zero(thrust)))


def _masked(values: tuple[float, float, float], ignore: int) -> Vector:
    """Return the commanded vector (3,); NaN if ignored or not finite."""
    isfinite, nan = math.isfinite, math.nan
    return np.array(
        [
            value if isfinite(value) and not ignore >> i & 1 else nan
            for i, value in enumerate(values)
        ]
    )


def _turned(velocity: Vector, quaternion: Vector) -> Vector:
    """Rotate a velocity (3,) by the heading."""
    forward, right, down = velocity.tolist()
    yaw = yaw_of(tuple(quaternion.tolist()))
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array([c * forward - s * right, s * forward + c * right, down])


def _commands_something(*vectors: Vector) -> bool:
    return any(map(math.isfinite, np.concatenate(vectors).tolist()))


def _finite(value: float) -> float:
    return value if math.isfinite(value) else math.nan


def _or_zero(value: float) -> float:
    return value if math.isfinite(value) else 0.0


def _is_local(message: WireMessage) -> bool:
    return bool(message.get_msgId() == dialect.MAVLINK_MSG_ID_SET_POSITION_TARGET_LOCAL_NED)


def _reject(context: Context, why: OperatorText) -> bool:
    context.port.refuse_setpoint(why.text, context.now_us)
    context.announce_once(why)
    return False


_CENTRE_US, _HALF_US = 1500.0, 500.0
"""Pulse width of a channel's centre, and from there to the maximum [µs]."""

_NO_CHANNEL = (0, 65_535)
"""Pulse widths that mean no channel."""

_HAS_VELOCITY = 1 << 1
"""Velocity bit of FOLLOW_TARGET.est_capabilities."""


# --- sticks and Follow Me


def _is_for_pilot(message: WireMessage, context: Context) -> bool:
    return bool(message.target in (0, context.system_id))


def _is_for_radio(message: WireMessage, context: Context) -> bool:
    return bool(message.target_system in (0, context.system_id))


def handle_manual_control(message: WireMessage, context: Context) -> bool:
    """Handle MANUAL_CONTROL: throttle 0..1000, others -1000..1000; 0 if out of range."""
    sticks = Sticks(
        roll=_share(message.y),
        pitch=_share(message.x),
        # 0..1000 becomes -1..1: PX4's throttle stick is centred at 500.
        throttle=2.0 * message.z / 1000.0 - 1.0 if 0 <= message.z <= 1000 else 0.0,
        yaw=_share(message.r),
    )
    context.port.manual_control(sticks, Source.JOYSTICK, context.now_us)
    return True


def handle_channels(message: WireMessage, context: Context) -> bool:
    """Handle RC_CHANNELS_OVERRIDE: roll, pitch, throttle, yaw in channels 1 to 4 (usual order).

    Pulling the pitch stick increases its pulse width. All four channels are required.
    """
    context.radio.receive(message, context.now_us)
    raw = (message.chan1_raw, message.chan2_raw, message.chan3_raw, message.chan4_raw)
    if any(width in _NO_CHANNEL for width in raw):
        return False
    roll, pitch, throttle, yaw = (
        min(1.0, max(-1.0, (width - _CENTRE_US) / _HALF_US)) for width in raw
    )
    # A pulled pitch stick raises the nose, so the pulse width has the opposite sign.
    context.port.manual_control(Sticks(roll, -pitch, throttle, yaw), Source.RADIO, context.now_us)
    return True


def handle_follow_target(message: WireMessage, context: Context) -> bool:
    """Handle FOLLOW_TARGET: position, and velocity if available."""
    origin = context.port.state().origin
    # PX4 treats latitude and longitude 0 as no position.
    if origin is None or (message.lat, message.lon) == (0, 0):
        return False
    place = frames.Geodetic(message.lat / 1e7, message.lon / 1e7, message.alt)
    north, east, down = frames.geodetic_to_local(place, origin).tolist()
    vn, ve, vd = message.vel if message.est_capabilities & _HAS_VELOCITY else (0.0, 0.0, 0.0)
    if not all(map(math.isfinite, (north, east, down, vn, ve, vd))):
        return False
    target = FollowedTarget((north, east, down), (vn, ve, vd), context.now_us)
    context.port.follow(target)
    return True


def _share(raw: int) -> float:
    return raw / 1000.0 if -1000 <= raw <= 1000 else 0.0


HANDLERS: Handlers = {
    "SET_POSITION_TARGET_LOCAL_NED": (for_vehicle_or_all, handle_local),
    "SET_POSITION_TARGET_GLOBAL_INT": (for_vehicle_or_all, handle_global),
    "SET_ATTITUDE_TARGET": (for_vehicle_or_all, handle_attitude),
    "MANUAL_CONTROL": (_is_for_pilot, handle_manual_control),
    "RC_CHANNELS_OVERRIDE": (_is_for_radio, handle_channels),
    "FOLLOW_TARGET": (for_anyone, handle_follow_target),
}
