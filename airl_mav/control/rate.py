"""Body rate PID -> normalised torque. The structure of PX4's RateControl."""

from __future__ import annotations

from airl_mav.control.gains import Gains
from airl_mav.control.velocity import clamp
from airl_mav.core.constants import DEG
from airl_mav.core.kernels import kernel
from airl_mav.vehicle.rotation import Vec

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
    axis that the mixer could not deliver last time (its sign matters).
    """
    er, ep, ey = rates_sp[0] - rates[0], rates_sp[1] - rates[1], rates_sp[2] - rates[2]
    torque = (
        gains.rate_p_roll * er + integral[0] - gains.rate_d_roll * angular_acceleration[0],
        gains.rate_p_pitch * ep + integral[1] - gains.rate_d_pitch * angular_acceleration[1],
        gains.rate_p_yaw * ey + integral[2] - gains.rate_d_yaw * angular_acceleration[2],
    )
    er = 0.0 if er * saturation[0] > 0.0 else er
    ep = 0.0 if ep * saturation[1] > 0.0 else ep
    ey = 0.0 if ey * saturation[2] > 0.0 else ey
    return torque, (
        _integrate(integral[0], er, gains.rate_i_roll, gains.rate_int_max_roll, dt),
        _integrate(integral[1], ep, gains.rate_i_pitch, gains.rate_int_max_pitch, dt),
        _integrate(integral[2], ey, gains.rate_i_yaw, gains.rate_int_max_yaw, dt),
    )
