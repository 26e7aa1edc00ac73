"""Loops of the cascade: velocity -> thrust vector -> attitude -> body rates -> torque -> motors.

- Position P and velocity PID: the structure of PX4's PositionControl (mc_pos_control). Offboard
  velocity setpoints enter without any ramp: PX4 does not slew them.
- Attitude: PX4's AttitudeControl (Brescianini, Hehn, D'Andrea, Nonlinear Quadrocopter Attitude
  Control, ETH 2013). The thrust axis is turned first, the heading with a reduced weight. The body
  rate PID is PX4's RateControl.
- Mixer of the quad X: PX4's ControlAllocationSequentialDesaturation with MC_AIRMODE = 0: roll and
  pitch before yaw, thrust is lowered but never raised to make room.
"""

from __future__ import annotations

import math

from airl_mav.control.demand import Gains
from airl_mav.core.constants import DEG, GRAVITY_M_S2
from airl_mav.core.kernels import kernel
from airl_mav.vehicle.rotation import Quat, Vec, conjugate, multiply, normalize, rotate


@kernel
def clamp(value: float, low: float, high: float) -> float:
    """Return value limited to [low, high]."""
    return min(high, max(low, value))


@kernel
def velocity_setpoint(position: Vec, position_sp: Vec, velocity_ff: Vec, gains: Gains) -> Vec:
    """Return the velocity to fly NED [m/s]: position error x gain + feed-forward, limited.

    A NaN axis of `position_sp` has no position loop; a NaN axis of `velocity_ff` adds nothing. If
    neither commands a horizontal axis, the horizontal result is NaN: not controlled. The horizontal
    limit gives the position correction priority over the feed-forward.
    """
    px = 0.0 if math.isnan(position_sp[0]) else gains.pos_p_xy * (position_sp[0] - position[0])
    py = 0.0 if math.isnan(position_sp[1]) else gains.pos_p_xy * (position_sp[1] - position[1])
    pz = 0.0 if math.isnan(position_sp[2]) else gains.pos_p_z * (position_sp[2] - position[2])
    fx = 0.0 if math.isnan(velocity_ff[0]) else velocity_ff[0]
    fy = 0.0 if math.isnan(velocity_ff[1]) else velocity_ff[1]
    fz = 0.0 if math.isnan(velocity_ff[2]) else velocity_ff[2]
    # As PX4's ControlMath::constrainXY.
    limit = gains.vel_max_xy
    square_p = px * px + py * py
    vx, vy = px + fx, py + fy
    if 0.0 < square_p >= limit * limit:
        scale = limit / math.sqrt(square_p)
        vx, vy = px * scale, py * scale
    elif vx * vx + vy * vy > limit * limit:
        # Largest share s of the feed-forward with |p + s f| = limit.
        a = fx * fx + fy * fy
        b = px * fx + py * fy
        s = (-b + math.sqrt(b * b + a * (limit * limit - square_p))) / a if a > 0.0 else 0.0
        vx, vy = px + s * fx, py + s * fy
    # Without any horizontal command the axes are not controlled.
    if (
        math.isnan(position_sp[0])
        and math.isnan(position_sp[1])
        and math.isnan(velocity_ff[0])
        and math.isnan(velocity_ff[1])
    ):
        vx, vy = math.nan, math.nan
    return vx, vy, clamp(pz + fz, -gains.vel_max_up, gains.vel_max_down)


@kernel
def thrust_from_acceleration(acc: Vec, gains: Gains) -> Vec:
    """Return the thrust vector NED (normalised, hover = hover_thrust) for an acceleration [m/s²].

    Horizontal and vertical acceleration are decoupled (MPC_ACC_DECOUPLE = 1). The tilt follows
    from the horizontal part alone, limited to tilt_max.
    """
    # body_z (down) points against the horizontal acceleration: (-ax, -ay, g), normalised
    square = acc[0] * acc[0] + acc[1] * acc[1]
    lean = 1.0 / math.sqrt(square + GRAVITY_M_S2 * GRAVITY_M_S2)
    c = GRAVITY_M_S2 * lean
    # tan(tilt) > tilt: usually the limit's cosine need not be computed.
    if square > (GRAVITY_M_S2 * gains.tilt_max) ** 2 and c < math.cos(gains.tilt_max):
        lean = math.sin(gains.tilt_max) / math.sqrt(square)
        c = math.cos(gains.tilt_max)
    # NED: up is negative. Hover thrust balances gravity.
    vertical = acc[2] * gains.hover_thrust / GRAVITY_M_S2 - gains.hover_thrust
    collective = min(vertical / c, -gains.thrust_min)
    return -acc[0] * lean * collective, -acc[1] * lean * collective, c * collective


@kernel
def velocity_control(
    velocity: Vec,
    velocity_dot: Vec,
    velocity_sp: Vec,
    integral: Vec,
    gains: Gains,
    dt: float,
) -> tuple[Vec, Vec]:
    """Return the thrust vector (3,) NED and the new integral (3,) [m/s²].

    A NaN horizontal setpoint is not controlled: the vehicle stays level.

    PID on velocity with anti-windup: vertical integration stops at the thrust limits. Saturation
    pulls back the horizontal integration (tracking anti-windup, gain 2/P).
    """
    ex = velocity_sp[0] - velocity[0]
    ey = velocity_sp[1] - velocity[1]
    ez = velocity_sp[2] - velocity[2]
    ax = gains.vel_p_xy * ex + integral[0] - gains.vel_d_xy * velocity_dot[0]
    ay = gains.vel_p_xy * ey + integral[1] - gains.vel_d_xy * velocity_dot[1]
    if math.isnan(velocity_sp[0]):
        # Not controlled: level. The integral against drag would keep accelerating it.
        ax, ay, ex, ey = 0.0, 0.0, 0.0, 0.0
        integral = (0.0, 0.0, integral[2])
    az = gains.vel_p_z * ez + integral[2] - gains.vel_d_z * velocity_dot[2]
    return _produced((ax, ay, az), (ex, ey, ez), integral, gains, dt)


@kernel
def acceleration_control(
    velocity: Vec,
    velocity_dot: Vec,
    velocity_sp: Vec,
    acceleration_ff: Vec,
    integral: Vec,
    gains: Gains,
    dt: float,
) -> tuple[Vec, Vec]:
    """Return thrust and integral as `velocity_control`, with an acceleration NED [m/s²] per axis.

    An axis without a velocity (NaN) is flown by the acceleration alone, without feedback, and its
    integral stays. Source: PX4 1.16, PositionControl::_velocityControl.
    """
    ax = 0.0 if math.isnan(acceleration_ff[0]) else acceleration_ff[0]
    ay = 0.0 if math.isnan(acceleration_ff[1]) else acceleration_ff[1]
    az = 0.0 if math.isnan(acceleration_ff[2]) else acceleration_ff[2]
    ex, ey, ez = 0.0, 0.0, 0.0
    if not math.isnan(velocity_sp[0]):
        ex = velocity_sp[0] - velocity[0]
        ax += gains.vel_p_xy * ex + integral[0] - gains.vel_d_xy * velocity_dot[0]
    if not math.isnan(velocity_sp[1]):
        ey = velocity_sp[1] - velocity[1]
        ay += gains.vel_p_xy * ey + integral[1] - gains.vel_d_xy * velocity_dot[1]
    if not math.isnan(velocity_sp[2]):
        ez = velocity_sp[2] - velocity[2]
        az += gains.vel_p_z * ez + integral[2] - gains.vel_d_z * velocity_dot[2]
    thrust, new = _produced((ax, ay, az), (ex, ey, ez), integral, gains, dt)
    return thrust, (
        integral[0] if math.isnan(velocity_sp[0]) else new[0],
        integral[1] if math.isnan(velocity_sp[1]) else new[1],
        integral[2] if math.isnan(velocity_sp[2]) else new[2],
    )


@kernel
def _produced(
    acceleration: Vec, error: Vec, integral: Vec, gains: Gains, dt: float
) -> tuple[Vec, Vec]:
    """Return the thrust vector for an acceleration, and the integral of the velocity error."""
    ax, ay, _ = acceleration
    ex, ey, ez = error
    tx, ty, tz = thrust_from_acceleration(acceleration, gains)
    # Vertical anti-windup: no integration further into saturation.
    if (tz >= -gains.thrust_min and ez >= 0.0) or (tz <= -gains.thrust_max and ez <= 0.0):
        ez = 0.0
    # Vertical thrust first, but a horizontal margin always stays.
    norm = math.sqrt(tx * tx + ty * ty)
    reserved = min(norm, gains.thrust_xy_margin)
    tz = max(tz, -math.sqrt(max(0.0, gains.thrust_max**2 - reserved**2)))
    room = math.sqrt(max(0.0, gains.thrust_max**2 - tz * tz))
    if norm > room:
        tx, ty = tx / norm * room, ty / norm * room
    per_thrust = GRAVITY_M_S2 / gains.hover_thrust
    # The acceleration that the limited thrust produces.
    produced_x, produced_y = tx * per_thrust, ty * per_thrust
    # Tracking anti-windup, as in PX4's PositionControl (Rundqwist, 1990).
    if ax * ax + ay * ay > produced_x * produced_x + produced_y * produced_y:
        arw = 2.0 / gains.vel_p_xy
        ex -= arw * (ax - produced_x)
        ey -= arw * (ay - produced_y)
    g = GRAVITY_M_S2
    new_integral = (
        integral[0] + gains.vel_i_xy * ex * dt,
        integral[1] + gains.vel_i_xy * ey * dt,
        # The vertical integral is limited to 1 g, as in PX4.
        clamp(integral[2] + gains.vel_i_z * ez * dt, -g, g),
    )
    return (tx, ty, tz), new_integral


@kernel
def heading_of(q: Quat) -> tuple[float, float]:
    """Return cosine and sine of the heading of q."""
    north = 1.0 - 2.0 * (q[2] * q[2] + q[3] * q[3])
    east = 2.0 * (q[0] * q[3] + q[1] * q[2])
    square = north * north + east * east
    if square < 1e-18:
        return 1.0, 0.0  # nose straight up or down
    n = 1.0 / math.sqrt(square)
    return north * n, east * n


@kernel
def attitude_setpoint(thrust: Vec, cy: float, sy: float) -> Quat:
    """Return the attitude whose body -z lies along the thrust vector NED.

    PX4's ControlMath::bodyzToAttitude; the heading is given by its cosine and sine.
    """
    norm = math.sqrt(thrust[0] ** 2 + thrust[1] ** 2 + thrust[2] ** 2)
    if norm < 1e-9:
        # Half the heading, without a call that prevents SIMD compilation across vehicles.
        half_sin = math.sqrt(max(0.0, 0.5 - 0.5 * cy))
        return (
            math.sqrt(max(0.0, 0.5 + 0.5 * cy)),
            0.0,
            0.0,
            half_sin if sy >= 0.0 else -half_sin,
        )
    zx, zy, zz = -thrust[0] / norm, -thrust[1] / norm, -thrust[2] / norm
    # x = y_c x z with y_c = (-sin, cos, 0)
    xx, xy, xz = cy * zz, sy * zz, -sy * zy - cy * zx
    # Thrust points down: the nose stays in front, as in bodyzToAttitude.
    if zz < 0.0:
        xx, xy, xz = -xx, -xy, -xz
    n = math.sqrt(xx * xx + xy * xy + xz * xz)
    # Thrust is level: x points down, as in bodyzToAttitude.
    if n < 1e-6:
        xx, xy, xz, n = 0.0, 0.0, 1.0, 1.0
    xx, xy, xz = xx / n, xy / n, xz / n
    yx, yy, yz = zy * xz - zz * xy, zz * xx - zx * xz, zx * xy - zy * xx
    return _from_axes((xx, xy, xz), (yx, yy, yz), (zx, zy, zz))


@kernel
def _from_axes(x: Vec, y: Vec, z: Vec) -> Quat:
    """Return the quaternion of the rotation with columns x, y, z (Shepperd's method)."""
    trace = x[0] + y[1] + z[2]
    if trace > 0.0:
        s = 2.0 * math.sqrt(1.0 + trace)
        return normalize((0.25 * s, (y[2] - z[1]) / s, (z[0] - x[2]) / s, (x[1] - y[0]) / s))
    if x[0] > y[1] and x[0] > z[2]:
        s = 2.0 * math.sqrt(1.0 + x[0] - y[1] - z[2])
        return normalize(((y[2] - z[1]) / s, 0.25 * s, (y[0] + x[1]) / s, (z[0] + x[2]) / s))
    if y[1] > z[2]:
        s = 2.0 * math.sqrt(1.0 + y[1] - x[0] - z[2])
        return normalize(((z[0] - x[2]) / s, (y[0] + x[1]) / s, 0.25 * s, (z[1] + y[2]) / s))
    s = 2.0 * math.sqrt(1.0 + z[2] - x[0] - y[1])
    return normalize(((x[1] - y[0]) / s, (z[0] + x[2]) / s, (z[1] + y[2]) / s, 0.25 * s))


@kernel
def _shortest(a: Vec, b: Vec) -> Quat:
    """Return the shortest rotation that turns unit vector a into b."""
    cx, cy, cz = a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
    dot = a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
    if dot < -1.0 + 1e-9:
        # Opposite: half a turn about any axis perpendicular to a.
        if abs(a[0]) < 0.9:
            return normalize((0.0, 0.0, a[2], -a[1]))
        return normalize((0.0, -a[2], 0.0, a[0]))
    return normalize((1.0 + dot, cx, cy, cz))


@kernel
def reference_model(
    q_ref: Quat, correction: Vec, q_sp: Quat, yaw_rate: float, w_n: float, dt: float
) -> tuple[Quat, Vec]:
    """Return the next reference attitude and its correction rate FRD [rad/s].

    A critically damped second-order model with natural frequency `w_n` [rad/s] follows the
    attitude setpoint; dt [s] is the time since the last one. Source: PX4 1.18,
    AttitudeControl::propagateReferenceModel.
    """
    back = conjugate(q_ref)
    down = rotate(back, (0.0, 0.0, 1.0))
    error = multiply(back, q_sp)
    double = 2.0 if error[0] >= 0.0 else -2.0
    ex, ey, ez = double * error[1], double * error[2], double * error[3]
    decay = math.exp(-w_n * dt)
    by_error, by_rate = 1.0 - (1.0 + w_n * dt) * decay, dt * decay
    cx, cy, cz = correction
    turn = yaw_rate * dt
    half_x = 0.5 * (by_error * ex + by_rate * cx + turn * down[0])
    half_y = 0.5 * (by_error * ey + by_rate * cy + turn * down[1])
    half_z = 0.5 * (by_error * ez + by_rate * cz + turn * down[2])
    angle = math.sqrt(half_x * half_x + half_y * half_y + half_z * half_z)
    s = math.sin(angle) / angle if angle > 1e-9 else 1.0
    stiff, damped = w_n * w_n * dt * decay, (1.0 - w_n * dt) * decay
    cx, cy, cz = stiff * ex + damped * cx, stiff * ey + damped * cy, stiff * ez + damped * cz
    # A commanded yaw rate is followed without a correction about the vertical.
    if yaw_rate != 0.0:
        vertical = cx * down[0] + cy * down[1] + cz * down[2]
        cx, cy, cz = cx - vertical * down[0], cy - vertical * down[1], cz - vertical * down[2]
    turned = multiply(q_ref, (math.cos(angle), s * half_x, s * half_y, s * half_z))
    return normalize(turned), (cx, cy, cz)


@kernel
def rate_setpoint(q: Quat, q_sp: Quat, yaw_rate_ff: float, gains: Gains) -> Vec:
    """Return the body rates FRD [rad/s] from attitude q to q_sp, heading rate fed forward."""
    reduced, half_turn = reduced_attitude(q, q_sp)
    return rates_towards(q, reduced, weighted_turn(half_turn, gains), yaw_rate_ff, gains)


@kernel
def reduced_attitude(q: Quat, q_sp: Quat) -> tuple[Quat, float]:
    """Return q with its thrust axis turned into the thrust axis of q_sp, by the shortest rotation.

    Returns:
        The attitude, body -> NED, and the sine of half the remaining turn about the thrust axis
        to q_sp, -1..1.
    """
    # Roll and pitch come first: the reduced attitude ignores the heading (Brescianini et al.).
    down = (0.0, 0.0, 1.0)
    reduced = multiply(_shortest(rotate(q, down), rotate(q_sp, down)), q)
    mix = multiply(conjugate(reduced), q_sp)
    sign = 1.0 if mix[0] >= 0.0 else -1.0
    return reduced, clamp(sign * mix[3], -1.0, 1.0)


@kernel
def weighted_turn(half_turn: float, gains: Gains) -> float:
    """Return the sine of half the heading's weighted turn, from the unweighted one."""
    return math.sin(gains.yaw_weight * math.asin(half_turn))


@kernel
def rates_towards(
    q: Quat, reduced: Quat, half_turn: float, yaw_rate_ff: float, gains: Gains
) -> Vec:
    """Return the body rates FRD [rad/s] that turn q into an attitude.

    `reduced` is that attitude without a turn about its thrust axis, `half_turn` the sine of half
    that turn, `yaw_rate_ff` the heading rate about the world's down axis [rad/s].
    """
    # Add the weighted turn about the thrust axis.
    wanted = multiply(reduced, (math.sqrt(1.0 - half_turn * half_turn), 0.0, 0.0, half_turn))
    error = multiply(conjugate(q), wanted)
    # q and -q are the same attitude; the sign selects the shorter rotation.
    two = 2.0 if error[0] >= 0.0 else -2.0
    ff = rotate(conjugate(q), (0.0, 0.0, yaw_rate_ff))
    p = gains.att_p_roll * two * error[1] + ff[0]
    r = gains.att_p_pitch * two * error[2] + ff[1]
    # The yaw gain is divided by its weight so that the weight does not slow a pure yaw step.
    y = gains.att_p_yaw / gains.yaw_weight * two * error[3] + ff[2]
    return (
        clamp(p, -gains.rate_max_roll, gains.rate_max_roll),
        clamp(r, -gains.rate_max_pitch, gains.rate_max_pitch),
        clamp(y, -gains.rate_max_yaw, gains.rate_max_yaw),
    )


# Integration fades out towards this rate error: no wind-up in fast flips (PX4's RateControl).
I_FADE_RAD_S = 400.0 * DEG


@kernel
def _integrate(integral: float, error: float, gain: float, limit: float, dt: float) -> float:
    fade = error / I_FADE_RAD_S
    return clamp(integral + max(0.0, 1.0 - fade * fade) * gain * error * dt, -limit, limit)


@kernel
def rate_control(
    rates: Vec,
    angular_acceleration: Vec,
    rates_sp: Vec,
    integral: Vec,
    saturation: Vec,
    gains: Gains,
    dt: float,
) -> tuple[Vec, Vec]:
    """Return the torque setpoint (-1..1 per axis) and the new integral, in torque units.

    Rates [rad/s] and their derivative [rad/s²] are filtered, FRD; `saturation` is the torque per
    axis that the mixer could not deliver in the last tick (its sign matters).
    """
    er, ep, ey = rates_sp[0] - rates[0], rates_sp[1] - rates[1], rates_sp[2] - rates[2]
    # The derivative acts on the measurement, so steps of the setpoint do not kick.
    torque = (
        gains.rate_p_roll * er + integral[0] - gains.rate_d_roll * angular_acceleration[0],
        gains.rate_p_pitch * ep + integral[1] - gains.rate_d_pitch * angular_acceleration[1],
        gains.rate_p_yaw * ey + integral[2] - gains.rate_d_yaw * angular_acceleration[2],
    )
    # Integration stops in the direction in which the mixer is saturated.
    er = 0.0 if er * saturation[0] > 0.0 else er
    ep = 0.0 if ep * saturation[1] > 0.0 else ep
    ey = 0.0 if ey * saturation[2] > 0.0 else ey
    return torque, (
        _integrate(integral[0], er, gains.rate_i_roll, gains.rate_int_max_roll, dt),
        _integrate(integral[1], ep, gains.rate_i_pitch, gains.rate_int_max_pitch, dt),
        _integrate(integral[2], ey, gains.rate_i_yaw, gains.rate_int_max_yaw, dt),
    )


Motors = tuple[float, float, float, float]

# Motors FR, RL, FL, RR: command = thrust + arm_roll roll + arm_pitch pitch + yaw.
ROLL: Motors = (-1.0, 1.0, 1.0, -1.0)
PITCH: Motors = (1.0, -1.0, 1.0, -1.0)
YAW: Motors = (1.0, 1.0, -1.0, -1.0)
THRUST: Motors = (1.0, 1.0, 1.0, 1.0)
# Yaw may push motors beyond their limit by this share before thrust gives way.
YAW_MARGIN = 0.15


@kernel
def _add(m: Motors, direction: Motors, amount: float) -> Motors:
    return (
        m[0] + amount * direction[0],
        m[1] + amount * direction[1],
        m[2] + amount * direction[2],
        m[3] + amount * direction[3],
    )


@kernel
def _excess(m: Motors, direction: Motors, high: float) -> float:
    """Return the multiple of `direction` that brings the worst motors back into [0, high]."""
    k_min = 0.0
    k_max = 0.0
    # The multiple that returns each motor to its nearest limit.
    for i in range(4):
        k = 0.0
        if m[i] < 0.0:
            k = -m[i] / direction[i]
        elif m[i] > high:
            k = (high - m[i]) / direction[i]
        k_min = min(k_min, k)
        k_max = max(k_max, k)
    return k_min + k_max


@kernel
def _desaturate(m: Motors, direction: Motors, high: float, lower_only: bool) -> Motors:
    gain = _excess(m, direction, high)
    # Without airmode, thrust may be lowered but not raised.
    if lower_only and gain > 0.0:
        return m
    m = _add(m, direction, gain)
    # Half again: a compromise when motors saturate at both ends.
    return _add(m, direction, 0.5 * _excess(m, direction, high))


@kernel
def _in_range(m: Motors) -> bool:
    low = min(min(m[0], m[1]), min(m[2], m[3]))
    return low >= 0.0 and max(max(m[0], m[1]), max(m[2], m[3])) <= 1.0


@kernel
def mix(thrust: float, torque: Vec, gains: Gains) -> tuple[Motors, Vec]:
    """Return motor commands 0..1 for thrust 0..1 and torque -1..1, and the missing torque."""
    motors, fits = allocate(thrust, torque, gains)
    if fits:
        return motors, (0.0, 0.0, 0.0)  # The usual case
    return desaturate(thrust, torque, gains)


@kernel
def allocate(thrust: float, torque: Vec, gains: Gains) -> tuple[Motors, bool]:
    """Return motor commands without limits, and True if all are in range, with and without yaw."""
    m = _roll_and_pitch(thrust, torque, gains)
    turning = _add(m, YAW, torque[2])
    return turning, _in_range(m) and _in_range(turning)


@kernel
def _roll_and_pitch(thrust: float, torque: Vec, gains: Gains) -> Motors:
    level = (thrust, thrust, thrust, thrust)
    m = _add(level, _scaled(ROLL, gains.mix_roll), torque[0])
    return _add(m, _scaled(PITCH, gains.mix_pitch), torque[1])


@kernel
def _scaled(direction: Motors, share: float) -> Motors:
    return (
        share * direction[0],
        share * direction[1],
        share * direction[2],
        share * direction[3],
    )


@kernel
def desaturate(thrust: float, torque: Vec, gains: Gains) -> tuple[Motors, Vec]:
    """Return the result of `mix` for commands that are partly out of range."""
    r, p = gains.mix_roll, gains.mix_pitch
    rolling, pitching = _scaled(ROLL, r), _scaled(PITCH, p)
    m = _roll_and_pitch(thrust, torque, gains)
    # Order of PX4: lower the thrust, then give up roll, then pitch.
    m = _desaturate(m, THRUST, 1.0, True)
    m = _desaturate(m, rolling, 1.0, False)
    m = _desaturate(m, pitching, 1.0, False)
    # Yaw comes last; its margin lets it act at full thrust.
    m = _add(m, YAW, torque[2])
    m = _desaturate(m, YAW, 1.0 + YAW_MARGIN, False)
    m = _desaturate(m, THRUST, 1.0, True)
    out = (
        clamp(m[0], 0.0, 1.0),
        clamp(m[1], 0.0, 1.0),
        clamp(m[2], 0.0, 1.0),
        clamp(m[3], 0.0, 1.0),
    )
    # The torque that the clamped motors produce; the rest is missing.
    roll = (-out[0] + out[1] + out[2] - out[3]) / (4.0 * r)
    pitch = (out[0] - out[1] + out[2] - out[3]) / (4.0 * p)
    yaw = 0.25 * (out[0] + out[1] - out[2] - out[3])
    missing = (torque[0] - roll, torque[1] - pitch, torque[2] - yaw)
    return out, (_dead(missing[0]), _dead(missing[1]), _dead(missing[2]))


@kernel
def _dead(value: float) -> float:
    """Return 0 for rounding noise: the deficit of a saturated axis is larger."""
    return value if abs(value) > 1e-6 else 0.0
