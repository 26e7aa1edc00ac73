"""Thrust vector and heading -> attitude setpoint -> body rate setpoint -> normalized torque.

The structure follows PX4's AttitudeControl (Brescianini, Hehn, D'Andrea, Nonlinear Quadrocopter
Attitude Control, ETH 2013). The thrust axis is turned first, the heading with a reduced weight. The
body rate PID is PX4's RateControl.
"""

from __future__ import annotations

import math

from airl_mav.control.gains import Gains
from airl_mav.control.velocity import clamp
from airl_mav.core.constants import DEG
from airl_mav.core.kernels import kernel
from airl_mav.vehicle.rotation import Quat, Vec, conjugate, multiply, normalize, rotate


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
