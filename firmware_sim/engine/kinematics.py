"""Motion of the vehicle as one row of numbers, for kernels and sensors."""

from __future__ import annotations

import math

from numba.extending import register_jitable

from airl_mav.core.constants import GRAVITY_M_S2
from airl_mav.core.frames import Vector, geodetic_to_local, local_to_geodetic
from airl_mav.core.kernels import kernel
from airl_mav.vehicle import atmosphere
from airl_mav.vehicle.rotation import Quat, Vec, conjugate, rotate

# Kernels call these functions as Python does.
register_jitable(geodetic_to_local)
register_jitable(local_to_geodetic)
register_jitable(atmosphere.pressure_hpa)
register_jitable(atmosphere.altitude_m)
register_jitable(atmosphere.temperature_c)

WIDTH = 16
"""Number of values in a row."""

POSITION = slice(0, 3)
"""NED [m]."""
VELOCITY = slice(3, 6)
"""NED [m/s]."""
QUATERNION = slice(6, 10)
"""Body -> NED."""
RATES = slice(10, 13)
"""Angular velocity FRD [rad/s]."""
FORCE = slice(13, 16)
"""Specific force FRD [m/s²], as measured by an accelerometer."""

POSE = slice(0, 10)
"""Position, velocity and attitude, as stored in a trajectory."""


@kernel
def velocity(row: Vector) -> Vec:
    """Return the velocity NED [m/s] of a row (16,)."""
    return row[3], row[4], row[5]


@kernel
def quaternion(row: Vector) -> Quat:
    """Return the attitude body -> NED of a row (16,)."""
    return row[6], row[7], row[8], row[9]


@kernel
def rates(row: Vector) -> Vec:
    """Return the angular velocity FRD [rad/s] of a row (16,)."""
    return row[10], row[11], row[12]


@kernel
def force(row: Vector) -> Vec:
    """Return the specific force FRD [m/s²] of a row (16,)."""
    return row[13], row[14], row[15]


@kernel
def write(p: Vec, v: Vec, q: Quat, omega: Vec, before: Vector, tick_s: float, row: Vector) -> None:
    """Write a motion as a row.

    Args:
        p: Position NED [m].
        v: Velocity NED [m/s].
        q: Attitude body -> NED.
        omega: Angular velocity FRD [rad/s].
        before: (16,) previous motion, from which the acceleration is differenced.
        tick_s: Length of the tick [s].
        row: (16,) output.
    """
    accel = (
        (v[0] - before[3]) / tick_s,
        (v[1] - before[4]) / tick_s,
        (v[2] - before[5]) / tick_s,
    )
    felt = rotate(conjugate(q), (accel[0], accel[1], accel[2] - GRAVITY_M_S2))
    row[0], row[1], row[2] = p
    row[3], row[4], row[5] = v
    row[6], row[7], row[8], row[9] = q
    row[10], row[11], row[12] = omega
    row[13], row[14], row[15] = felt


@kernel
def from_bullet(
    at: Vec,
    orientation: Quat,
    linear: Vec,
    angular: Vec,
    before: Vector,
    tick_s: float,
    row: Vector,
) -> None:
    """Write pybullet's state as a row, in NED / FRD.

    The attitude NED <- FRD is (half a turn about (1,1,0)) q_enu_flu (half a turn about x); the
    products are expanded.

    Args:
        at: Position ENU [m].
        orientation: FLU -> ENU, xyzw.
        linear: Velocity ENU [m/s].
        angular: Angular velocity ENU [rad/s].
        before: (16,) previous motion.
        tick_s: Length of the tick [s].
        row: (16,) output.
    """
    x, y, z, w = orientation
    h = math.sqrt(0.5)
    q = (h * (w + z), h * (x + y), h * (x - y), h * (w - z))
    if q[0] < 0.0:
        q = (-q[0], -q[1], -q[2], -q[3])
    body = conjugate(q)
    omega = rotate(body, (angular[1], angular[0], -angular[2]))
    p, v = (at[1], at[0], -at[2]), (linear[1], linear[0], -linear[2])
    write(p, v, q, omega, before, tick_s, row)
