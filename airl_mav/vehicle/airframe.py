"""Airframe: constants as one typed row for kernels, rotors, rigid-body motion, randomization."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from airl_mav.core.constants import GRAVITY_M_S2
from airl_mav.core.frames import Vector
from airl_mav.core.kernels import kernel
from airl_mav.profiles.vehicle import Spread, VehicleProfile
from airl_mav.vehicle.rotation import Quat, Vec, exponential, multiply, normalize, rotate


class Airframe(NamedTuple):
    """Constants of body, rotors and drag; SI. Fields as in `profiles.vehicle`."""

    mass: float
    inertia_xx: float
    inertia_yy: float
    inertia_zz: float
    arm_forward: float
    arm_right: float
    thrust_max: float
    torque_per_thrust: float
    rotor_time_constant: float
    thrust_curve: float
    drag_linear: float
    drag_quadratic: float
    drag_angular: float
    com_forward: float
    com_right: float

    @classmethod
    def from_profile(cls, profile: VehicleProfile) -> Airframe:
        """Collect the constants of a vehicle profile."""
        body, rotor, drag = profile.body, profile.rotor, profile.drag
        return cls(
            body.mass_kg,
            body.inertia_xx_kg_m2,
            body.inertia_yy_kg_m2,
            body.inertia_zz_kg_m2,
            rotor.arm_forward_m,
            rotor.arm_right_m,
            rotor.thrust_max_n,
            rotor.torque_per_thrust_m,
            rotor.time_constant_s,
            rotor.thrust_curve,
            drag.linear_n_s_m,
            drag.quadratic_n_s2_m2,
            drag.angular_n_m_s,
            body.com_forward_m,
            body.com_right_m,
        )


@kernel
def airframe_of(row: Vector) -> Airframe:
    """Return the airframe of a row (15,): kernels accept an array far faster than a tuple."""
    r = row
    return Airframe(
        r[0], r[1], r[2], r[3], r[4], r[5], r[6], r[7],
        r[8], r[9], r[10], r[11], r[12], r[13], r[14],
    )  # fmt: skip


def spreads(shares: Spread) -> bool:
    """Return True if any airframe differs from the nominal one."""
    return any((shares.mass, shares.thrust, shares.drag, shares.rotor_lag))


def draw_airframe(nominal: Airframe, shares: Spread, rng: np.random.Generator) -> Airframe:
    """Return an airframe of one episode; every quantity uniform within its share."""
    mass, thrust, drag, lag = (
        1.0 + share * rng.uniform(-1.0, 1.0)
        for share in (shares.mass, shares.thrust, shares.drag, shares.rotor_lag)
    )
    return nominal._replace(
        mass=nominal.mass * mass,
        # The shape is unchanged, so the inertia scales with the mass.
        inertia_xx=nominal.inertia_xx * mass,
        inertia_yy=nominal.inertia_yy * mass,
        inertia_zz=nominal.inertia_zz * mass,
        thrust_max=nominal.thrust_max * thrust,
        drag_linear=nominal.drag_linear * drag,
        drag_quadratic=nominal.drag_quadratic * drag,
        drag_angular=nominal.drag_angular * drag,
        rotor_time_constant=nominal.rotor_time_constant * lag,
    )


N_ROTORS = 4
# Position of each rotor relative to their centre, as signs of the arms (forward, right).
FORWARD_SIGN = (1.0, -1.0, 1.0, -1.0)
RIGHT_SIGN = (1.0, -1.0, -1.0, 1.0)
# Reaction torque on the body about the down axis: a rotor turning counter-clockwise pushes the
# body clockwise, which is positive yaw.
YAW_SIGN = (1.0, 1.0, -1.0, -1.0)


@kernel
def steady_speed(command: float, thrust_curve: float) -> float:
    """Return the steady speed fraction 0..1 of a command 0..1 (thrust ~ speed²)."""
    u = min(1.0, max(0.0, command))
    return math.sqrt(thrust_curve * u * u + (1.0 - thrust_curve) * u)


@kernel
def lag(airframe: Airframe, dt: float) -> float:
    """Return the share of a speed error that remains after dt [s]: exact for a first-order lag."""
    return math.exp(-dt / airframe.rotor_time_constant)


@kernel
def settle(speed: float, command: float, airframe: Airframe, left: float) -> float:
    """Return the speed fraction after a step that leaves the share `left` of the error."""
    target = steady_speed(command, airframe.thrust_curve)
    return target + (speed - target) * left


@kernel
def command_for(thrust: float, thrust_curve: float) -> float:
    """Return the command 0..1 for a share 0..1 of maximum thrust in steady state."""
    c = thrust_curve
    if c == 0.0:
        return thrust
    b = 1.0 - c
    # Positive root of c u² + (1 - c) u = thrust.
    return (math.sqrt(b * b + 4.0 * c * thrust) - b) / (2.0 * c)


@kernel
def wrench(s0: float, s1: float, s2: float, s3: float, airframe: Airframe) -> tuple[float, Vec]:
    """Return collective thrust [N] along body up, and the body torque FRD [N m]."""
    speeds = (s0, s1, s2, s3)
    thrust = 0.0
    roll = 0.0
    pitch = 0.0
    yaw = 0.0
    for i in range(N_ROTORS):
        t = airframe.thrust_max * speeds[i] * speeds[i]
        thrust += t
        # torque = r x F with F = (0, 0, -t) at r = (forward, right, .) from the centre of mass
        roll -= (RIGHT_SIGN[i] * airframe.arm_right - airframe.com_right) * t
        pitch += (FORWARD_SIGN[i] * airframe.arm_forward - airframe.com_forward) * t
        yaw += YAW_SIGN[i] * airframe.torque_per_thrust * t
    return thrust, (roll, pitch, yaw)


def hover_speeds(airframe: Airframe) -> tuple[float, float, float, float]:
    """Return the rotors' speed fractions in a hover, which carry the weight without torque.

    Rotors closer to the centre of mass carry more.
    """
    share = airframe.mass * GRAVITY_M_S2 / (N_ROTORS * airframe.thrust_max)
    right, forward = (
        airframe.com_right / airframe.arm_right,
        airframe.com_forward / airframe.arm_forward,
    )
    s0, s1, s2, s3 = (
        # A centre of mass outside the rotors would need negative thrust.
        math.sqrt(max(0.0, share * (1.0 + RIGHT_SIGN[i] * right + FORWARD_SIGN[i] * forward)))
        for i in range(N_ROTORS)
    )
    return s0, s1, s2, s3


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
