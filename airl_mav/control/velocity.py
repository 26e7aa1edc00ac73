"""Position P and velocity PID -> acceleration -> thrust vector.

The structure of PX4's PositionControl (mc_pos_control). Offboard velocity setpoints enter without
any ramp: PX4 does not slew them.
"""

from __future__ import annotations

import math

from airl_mav.control.gains import Gains
from airl_mav.core.constants import GRAVITY_M_S2
from airl_mav.core.kernels import kernel
from airl_mav.vehicle.rotation import Vec


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
