"""Quaternion kernels for compiled loops; conventions as in `airl_mav.core.frames`."""

from __future__ import annotations

import math

from airl_mav.core.kernels import kernel

Quat = tuple[float, float, float, float]
Vec = tuple[float, float, float]


@kernel
def rotate(q: Quat, v: Vec) -> Vec:
    """Rotate v by q: body to world."""
    # v + w t + u x t with t = 2 u x v and u the vector part.
    w, x, y, z = q
    tx = 2.0 * (y * v[2] - z * v[1])
    ty = 2.0 * (z * v[0] - x * v[2])
    tz = 2.0 * (x * v[1] - y * v[0])
    return (
        v[0] + w * tx + y * tz - z * ty,
        v[1] + w * ty + z * tx - x * tz,
        v[2] + w * tz + x * ty - y * tx,
    )


@kernel
def conjugate(q: Quat) -> Quat:
    """Return the inverse rotation."""
    return (q[0], -q[1], -q[2], -q[3])


@kernel
def multiply(a: Quat, b: Quat) -> Quat:
    """Return the Hamilton product a ⊗ b."""
    return (
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    )


@kernel
def normalize(q: Quat) -> Quat:
    """Return q scaled to length 1."""
    n = 1.0 / math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    return (q[0] * n, q[1] * n, q[2] * n, q[3] * n)


@kernel
def exponential(r: Vec) -> Quat:
    """Return the quaternion of a rotation vector [rad]."""
    angle = math.sqrt(r[0] * r[0] + r[1] * r[1] + r[2] * r[2])
    # The limit of sin(angle / 2) / angle at 0.
    s = 0.5 if angle < 1e-8 else math.sin(0.5 * angle) / angle
    return (math.cos(0.5 * angle), s * r[0], s * r[1], s * r[2])


@kernel
def yaw_of(q: Quat) -> float:
    """Return the heading of q [rad]."""
    return math.atan2(2.0 * (q[0] * q[3] + q[1] * q[2]), 1.0 - 2.0 * (q[2] * q[2] + q[3] * q[3]))
