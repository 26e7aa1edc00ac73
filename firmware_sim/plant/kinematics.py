"""The vehicle's motion as one row of numbers, for kernels and sensors."""

from __future__ import annotations

import math

from airl_mav.core.constants import GRAVITY_M_S2
from airl_mav.core.frames import Vector
from airl_mav.core.kernels import kernel
from airl_mav.vehicle.rotation import Quat, Vec, conjugate, rotate

WIDTH = 16
"""Numbers in a row."""

POSITION = slice(0, 3)
"""NED [m]."""
VELOCITY = slice(3, 6)
"""NED [m/s]."""
QUATERNION = slice(6, 10)
"""Body -> NED."""
RATES = slice(10, 13)
"""Angular velocity FRD [rad/s]."""
FORCE = slice(13, 16)
"""Specific force FRD [m/s²]: what an accelerometer feels."""

POSE = slice(0, 10)
"""Position, velocity and attitude, as a trajectory keeps them."""


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
def from_bullet(
    at: Vec, orientation: Quat, linear: Vec, angular: Vec, accel: Vec, row: Vector
) -> None:
    """Write pybullet's state as a row: NED / FRD.

    The attitude NED <- FRD is (half a turn about (1,1,0)) q_enu_flu (half a turn about x); the
    products are written out.

    Args:
        at: Position ENU [m].
        orientation: FLU -> ENU, xyzw.
        linear: Velocity ENU [m/s].
        angular: Angular velocity ENU [rad/s].
        accel: Acceleration NED, gravity removed [m/s²].
        row: (16,) overwritten.
    """
    x, y, z, w = orientation
    h = math.sqrt(0.5)
    q = (h * (w + z), h * (x + y), h * (x - y), h * (w - z))
    if q[0] < 0.0:
        q = (-q[0], -q[1], -q[2], -q[3])
    body = conjugate(q)
    omega = rotate(body, (angular[1], angular[0], -angular[2]))
    felt = rotate(body, (accel[0], accel[1], accel[2] - GRAVITY_M_S2))
    row[0], row[1], row[2] = at[1], at[0], -at[2]
    row[3], row[4], row[5] = linear[1], linear[0], -linear[2]
    row[6], row[7], row[8], row[9] = q
    row[10], row[11], row[12] = omega
    row[13], row[14], row[15] = felt
