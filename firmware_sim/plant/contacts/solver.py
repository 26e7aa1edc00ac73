"""Contact impulses on one body: Bullet's sequential impulses.

Rows, their order, the two friction directions in one cone and the constants match
btMultiBodyConstraintSolver in pybullet's configuration. A vehicle on the floor moves the same.
"""

from __future__ import annotations

import math

import numpy as np

from airl_mav.core.frames import Vector
from airl_mav.core.kernels import kernel, large_kernel
from airl_mav.vehicle.airframe import Airframe
from airl_mav.vehicle.rotation import Quat, Vec, conjugate, rotate

FRICTION = 0.4
"""Friction coefficient: the vehicle's 0.8 times pybullet's default of 0.5 for other bodies."""

ITERATIONS = 50
ENOUGH = 1e-7
"""Tolerance: iterations end when all velocity changes are below its square root [m²/s²]."""

ERP = 0.08
"""Fraction of a penetration removed per tick (m_erp2)."""

SLOP_M = 1e-5
"""Linear slop (m_linearSlop) [m]."""

_WIDTH = 16
"""Number of values in a row: direction, arm x direction, velocities per unit impulse (linear,
angular), 1 / (direction . response), right-hand side, impulse so far."""


@kernel
def _sides(n: Vec) -> tuple[Vec, Vec]:
    """Return two unit vectors normal to n and to each other; on the floor south, then east."""
    # Same choice as Bullet's btPlaneSpace1, to match its friction directions.
    if abs(n[2]) > math.sqrt(0.5):
        k = 1.0 / math.sqrt(n[0] * n[0] + n[2] * n[2])
        a = (n[2] * k, 0.0, -n[0] * k)
    else:
        k = 1.0 / math.sqrt(n[0] * n[0] + n[1] * n[1])
        a = (-n[1] * k, n[0] * k, 0.0)
    x, y, z = a
    return a, (n[1] * z - n[2] * y, n[2] * x - n[0] * z, n[0] * y - n[1] * x)


@kernel
def _describe(
    row: Vector, d: Vec, arm: Vec, v: Vec, spin: Vec, q: Quat, airframe: Airframe
) -> float:
    """Fill a row for direction d at an arm; return the velocity along it [m/s]."""
    t = (
        arm[1] * d[2] - arm[2] * d[1],
        arm[2] * d[0] - arm[0] * d[2],
        arm[0] * d[1] - arm[1] * d[0],
    )
    # The inertia is diagonal in body axes: rotate, divide, rotate back.
    b = rotate(conjugate(q), t)
    turned = (b[0] / airframe.inertia_xx, b[1] / airframe.inertia_yy, b[2] / airframe.inertia_zz)
    w = rotate(q, turned)
    m = airframe.mass
    row[0], row[1], row[2] = d
    row[3], row[4], row[5] = t
    row[6], row[7], row[8] = d[0] / m, d[1] / m, d[2] / m
    row[9], row[10], row[11] = w
    # Velocity along d per unit impulse at this arm.
    response = 1.0 / m + t[0] * w[0] + t[1] * w[1] + t[2] * w[2]
    row[12] = 1.0 / response
    row[14] = 0.0
    return (
        d[0] * v[0] + d[1] * v[1] + d[2] * v[2] + t[0] * spin[0] + t[1] * spin[1] + t[2] * spin[2]
    )


@kernel
def _wanted(row: Vector, change: Vector) -> float:
    """Return the remaining impulse [N s] of a row after a velocity change (6,)."""
    along = 0.0
    for i in range(6):
        along += row[i] * change[i]
    left: float = row[13] - along * row[12]
    return left


@kernel
def _push(row: Vector, change: Vector, impulse: float) -> None:
    """Add the effect of an impulse [N s] along a row to the velocity change (6,)."""
    for i in range(6):
        change[i] += row[6 + i] * impulse


@kernel
def _rub(a: Vector, b: Vector, change: Vector, limit: float) -> float:
    """Solve both friction directions of a contact in a cone; return the velocity's change."""
    more_a, more_b = _wanted(a, change), _wanted(b, change)
    sum_a, sum_b = a[14] + more_a, b[14] + more_b
    # Both directions share one friction cone.
    if sum_a * sum_a + sum_b * sum_b >= limit * limit:
        # Bullet limits each direction by the angle of the impulse.
        angle = math.atan2(sum_a, sum_b)
        most_a, most_b = abs(limit * math.sin(angle)), abs(limit * math.cos(angle))
        sum_a = min(max(sum_a, -most_a), most_a)
        sum_b = min(max(sum_b, -most_b), most_b)
        more_a, more_b = sum_a - a[14], sum_b - b[14]
    a[14], b[14] = sum_a, sum_b
    _push(a, change, more_a)
    _push(b, change, more_b)
    changed: float = more_a / a[12] + more_b / b[12]
    return changed


@large_kernel
def resolve(
    v: Vec,
    spin: Vec,
    q: Quat,
    contacts: Vector,
    count: int,
    airframe: Airframe,
    tick_s: float,
    impulses: Vector,
) -> tuple[Vec, Vec]:
    """Return the velocities of a body without motion into its contacts.

    Args:
        v: Velocity after the tick's forces, NED [m/s].
        spin: Angular velocity after the tick's forces, NED [rad/s].
        q: Attitude body -> NED.
        contacts: (MOST, ROW) contacts in the format of `box.ROW`.
        count: Number of contacts.
        airframe: Mass and inertia.
        tick_s: Length of the tick [s].
        impulses: (MOST,) output: normal impulses [N s].

    Returns:
        Velocity [m/s] and angular velocity [rad/s], both NED.
    """
    rows = np.zeros((3 * count, _WIDTH))
    change = np.zeros(6)
    for j in range(count):
        c = contacts[j]
        arm, n = (c[0], c[1], c[2]), (c[3], c[4], c[5])
        # Three rows per contact: normal, then two friction directions.
        one, two = _sides(n)
        closing = _describe(rows[3 * j], n, arm, v, spin, q, airframe)
        distance = c[6] + SLOP_M
        # An open gap may close within the tick; a penetration is removed slowly.
        share = 1.0 if distance > 0.0 else ERP
        aim = -closing - distance * share / tick_s
        rows[3 * j, 13] = aim * rows[3 * j, 12]
        for k in range(2):
            row = rows[3 * j + 1 + k]
            side = _describe(row, one if k == 0 else two, arm, v, spin, q, airframe)
            # Friction aims at no sliding.
            row[13] = -side * row[12]
    for _ in range(ITERATIONS):
        most = 0.0
        for j in range(count):
            row = rows[3 * j]
            before = row[14]
            # The right-hand side is the row's total impulse; `change` is the effect so far.
            row[14] = max(0.0, before + _wanted(row, change))
            _push(row, change, row[14] - before)
            most = max(most, ((row[14] - before) / row[12]) ** 2)
        # Friction after all normals: its limit depends on the normal impulse.
        for j in range(count):
            limit = FRICTION * rows[3 * j, 14]
            rubbed = _rub(rows[3 * j + 1], rows[3 * j + 2], change, limit)
            most = max(most, rubbed * rubbed)
        # Converged: the largest change of any row is small enough.
        if most <= ENOUGH:
            break
    for j in range(count):
        impulses[j] = rows[3 * j, 14]
    return (
        (v[0] + change[0], v[1] + change[1], v[2] + change[2]),
        (spin[0] + change[3], spin[1] + change[4], spin[2] + change[5]),
    )
