"""Forces on the airframe and the free rigid body, in NED / FRD.

The integrator is Bullet's multi-body integrator (semi-implicit Euler, explicit gyroscopic torque,
exponential map for the attitude), so that the vectorized simulator and the pybullet plant agree to
rounding without contact.
"""

from __future__ import annotations

import math

from airl_mav.core.constants import GRAVITY_M_S2
from airl_mav.core.kernels import kernel
from airl_mav.vehicle.airframe import Airframe
from airl_mav.vehicle.rotation import Quat, Vec, exponential, multiply, normalize, rotate


@kernel
def drag_force(velocity: Vec, wind: Vec, airframe: Airframe) -> Vec:
    """Return the drag NED [N] at a ground velocity and wind NED [m/s]."""
    x, y, z = velocity[0] - wind[0], velocity[1] - wind[1], velocity[2] - wind[2]
    k = airframe.drag_linear + airframe.drag_quadratic * math.sqrt(x * x + y * y + z * z)
    return (-k * x, -k * y, -k * z)


@kernel
def accelerate(
    velocity: Vec, q: Quat, omega: Vec, force: Vec, torque: Vec, airframe: Airframe, dt: float
) -> tuple[Vec, Vec]:
    """Return the velocities [m/s, rad/s] of a free body after dt [s], both NED.

    q is body -> NED, omega FRD; `force` is all but gravity, NED [N], `torque` FRD [N m].
    """
    m = airframe.mass
    vx = velocity[0] + force[0] / m * dt
    vy = velocity[1] + force[1] / m * dt
    # NED: gravity acts along +z.
    vz = velocity[2] + (force[2] / m + GRAVITY_M_S2) * dt
    ix, iy, iz = airframe.inertia_xx, airframe.inertia_yy, airframe.inertia_zz
    p, r_, s = omega
    # Euler's equations: I dw/dt = torque - w x (I w)
    wx = p + (torque[0] - (iz - iy) * r_ * s) / ix * dt
    wy = r_ + (torque[1] - (ix - iz) * s * p) / iy * dt
    wz = s + (torque[2] - (iy - ix) * p * r_) / iz * dt
    # Bullet keeps the new angular velocity in world axes of the old attitude while it turns.
    return (vx, vy, vz), rotate(q, (wx, wy, wz))


@kernel
def drift(position: Vec, velocity: Vec, q: Quat, spin: Vec, dt: float) -> tuple[Vec, Quat, Vec]:
    """Move a body by dt [s] at constant velocities; `spin` is the angular velocity NED.

    Returns position, attitude and angular velocity FRD [rad/s].
    """
    # `spin` is in world axes, so its rotation multiplies from the left.
    dq = exponential((spin[0] * dt, spin[1] * dt, spin[2] * dt))
    q_new = normalize(multiply(dq, q))
    body = rotate((q_new[0], -q_new[1], -q_new[2], -q_new[3]), spin)
    here = (
        position[0] + velocity[0] * dt,
        position[1] + velocity[1] * dt,
        position[2] + velocity[2] * dt,
    )
    return here, q_new, body


@kernel
def step(
    position: Vec,
    velocity: Vec,
    q: Quat,
    omega: Vec,
    force: Vec,
    torque: Vec,
    airframe: Airframe,
    dt: float,
) -> tuple[Vec, Vec, Quat, Vec]:
    """Advance a free body by dt [s]; arguments as of `accelerate`, angular velocities FRD."""
    v, spin = accelerate(velocity, q, omega, force, torque, airframe, dt)
    p, q_new, body = drift(position, v, q, spin, dt)
    return p, v, q_new, body
