"""States, propagation and measurement models of the estimator's filters.

The nominal state is a row of `ROW_SIZE` floats, directly usable by compiled code. The estimated
error has 16 states, in this order: position (3) [m], velocity (3) [m/s], attitude (3, rotation
vector in body axes) [rad], gyro bias (3) [rad/s], accelerometer bias (3) [m/s²], barometer offset
(1) [m]. Between measurements the error is zero by construction. A measurement's correction is
injected into the nominal state at once (Solà, Quaternion kinematics for the error-state Kalman
filter, arXiv 1711.02508, sections 5-6).
"""

from __future__ import annotations

import math

import numpy as np

from airl_mav.core.constants import GRAVITY_M_S2
from airl_mav.core.frames import Vector
from airl_mav.core.kernels import kernel
from airl_mav.vehicle.rotation import Quat, Vec, conjugate, exponential, multiply, normalize, rotate

N_STATES = 16
POS, VEL, ATT, GYRO, ACC, BARO = 0, 3, 6, 9, 12, 15
"""Index of each error's first state: three states each, one for the barometer."""

# Layout of the nominal state's row. Values for control come first (`Controller.fly`).
P, V, Q, RATES, GYRO_BIAS, ACCEL_BIAS, BARO_OFFSET = 0, 3, 6, 10, 13, 16, 19
ACCELERATION = 20
"""NED, gravity removed [m/s²]."""
SIGMA = 23
"""Standard deviations of the 16 errors."""
RATIO = SIGMA + N_STATES
"""Newest test ratio of GPS (horizontal), barometer, heading and GPS (vertical)."""
ROW_SIZE = RATIO + 4

INITIAL_SIGMA = np.repeat([1.0, 0.5, 0.05, 0.01, 0.1, 0.3], [3, 3, 3, 3, 3, 1])
"""Standard deviations of the 16 errors right after alignment."""

GATE = 5.0
"""Innovations beyond this many standard deviations are not fused (EKF2_*_GATE)."""

_READY_SIGMA = (1.5,) * 3 + (0.3,) * 3 + (math.radians(2.0),) * 2 + (math.radians(5.0),)
"""Convergence thresholds of position, velocity, tilt and heading."""

_STEEPEST = math.sin(math.radians(80.0))
"""Sine of the pitch beyond which the heading is not observable."""


def new_state() -> Vector:
    """Return the nominal state (ROW_SIZE,) at the origin, at rest, level, nose to the north."""
    row = np.zeros(ROW_SIZE)
    row[Q] = 1.0
    row[SIGMA:RATIO] = INITIAL_SIGMA
    return row


# --- propagation


@kernel
def propagate(row: Vector, gyro: Vector, accel: Vector, transition: Vector, dt: float) -> None:
    """Advance the nominal state by one IMU sample; write the error's transition matrix.

    Args:
        row: Nominal state (ROW_SIZE,), updated.
        gyro: Sample (3,) FRD [rad/s].
        accel: Sample (3,), specific force FRD [m/s²].
        transition: (16, 16), updated where it differs from the identity.
        dt: Time step [s].
    """
    # Subtract the estimated biases: rates and specific force in body axes.
    wx = gyro[0] - row[GYRO_BIAS]
    wy = gyro[1] - row[GYRO_BIAS + 1]
    wz = gyro[2] - row[GYRO_BIAS + 2]
    fx = accel[0] - row[ACCEL_BIAS]
    fy = accel[1] - row[ACCEL_BIAS + 1]
    fz = accel[2] - row[ACCEL_BIAS + 2]
    q = attitude(row)
    r = _matrix(q)
    # Attitude: exact for a constant rate over the tick.
    turned = multiply(q, exponential((wx * dt, wy * dt, wz * dt)))
    row[Q], row[Q + 1], row[Q + 2], row[Q + 3] = normalize(turned)
    row[RATES], row[RATES + 1], row[RATES + 2] = wx, wy, wz
    # dv/dtheta = -R [f]x, dv/dba = -R, dtheta/dtheta = I - [w]x, dtheta/dbg = -I
    # Row i of R maps the specific force to the world axis i.
    for i in range(3):
        rx, ry, rz = r[i]
        a = rx * fx + ry * fy + rz * fz
        if i == 2:
            # At rest the accelerometer measures -g; adding g gives zero acceleration.
            a += GRAVITY_M_S2
        row[P + i] += row[V + i] * dt + 0.5 * a * dt * dt
        row[V + i] += a * dt
        row[ACCELERATION + i] = a
        transition[POS + i, VEL + i] = dt
        transition[VEL + i, ATT] = -(ry * fz - rz * fy) * dt
        transition[VEL + i, ATT + 1] = -(rz * fx - rx * fz) * dt
        transition[VEL + i, ATT + 2] = -(rx * fy - ry * fx) * dt
        transition[VEL + i, ACC] = -rx * dt
        transition[VEL + i, ACC + 1] = -ry * dt
        transition[VEL + i, ACC + 2] = -rz * dt
        transition[ATT + i, GYRO + i] = -dt
    # Attitude block: I - [w dt]x, first order in dt.
    transition[ATT, ATT + 1], transition[ATT, ATT + 2] = wz * dt, -wy * dt
    transition[ATT + 1, ATT], transition[ATT + 1, ATT + 2] = -wz * dt, wx * dt
    transition[ATT + 2, ATT], transition[ATT + 2, ATT + 1] = wy * dt, -wx * dt


@kernel
def inject(row: Vector, error: Vector) -> None:
    """Inject an error (16,) into the nominal state (ROW_SIZE,)."""
    turn = exponential((error[ATT], error[ATT + 1], error[ATT + 2]))
    q = normalize(multiply(attitude(row), turn))
    # q and -q are the same attitude: keep w >= 0.
    sign = 1.0 if q[0] >= 0.0 else -1.0
    for i in range(4):
        row[Q + i] = sign * q[i]
    for i in range(3):
        row[P + i] += error[POS + i]
        row[V + i] += error[VEL + i]
        row[GYRO_BIAS + i] += error[GYRO + i]
        row[ACCEL_BIAS + i] += error[ACC + i]
    row[BARO_OFFSET] += error[BARO]


# --- measurements


@kernel
def true_heading(field: Vector, q: Quat, declination: float) -> float:
    """Return the heading [rad] of a field measurement (3,) FRD minus the heading of q.

    The field is rotated into the world by q. With heading 0 in q the result is the true heading;
    with the vehicle's attitude it is the heading error.
    """
    north, east, _ = rotate(q, (field[0], field[1], field[2]))
    angle = declination - math.atan2(east, north)
    # Wrap to -pi..pi.
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


@kernel
def observe_heading(
    row: Vector, field: Vector, declination: float, by_turn: Vector, innovation: Vector, h: Vector
) -> bool:
    """Write the heading's innovation (1,) and its Jacobian (1, 16); False = not observable.

    Args:
        row: Nominal state.
        field: Magnetometer sample (3,) FRD.
        declination: Angle from true to magnetic north [rad].
        by_turn: Change of the innovation by a turn about each world axis (3,).
        innovation: Written.
        h: Written.
    """
    w, x, y, z = q = attitude(row)
    # 2 (w y - z x) is the sine of the pitch.
    if abs(2.0 * (w * y - z * x)) > _STEEPEST:
        return False
    innovation[0] = true_heading(field, q, declination)
    # The Jacobian in world axes, rotated into body axes, where the attitude error is defined.
    turn = rotate(conjugate(q), (by_turn[0], by_turn[1], by_turn[2]))
    h[0, ATT], h[0, ATT + 1], h[0, ATT + 2] = turn
    return True


@kernel
def gate_ratio(innovation: Vector, variance: Vector) -> float:
    """Return the test ratio of an innovation (m,) with a variance (m,).

    1 = at the gate, NaN = an innovation is not finite.
    """
    worst = 0.0
    for i in range(len(innovation)):
        ratio = abs(innovation[i]) / math.sqrt(variance[i])
        # A NaN is kept, so that the gate rejects the measurement.
        if ratio > worst or math.isnan(ratio):
            worst = ratio
    return worst / GATE


# --- convergence


@kernel
def converged(row: Vector, covariance: Vector) -> bool:
    """Write the standard deviations; return whether they are small enough to fly."""
    good = True
    for i in range(N_STATES):
        sigma = math.sqrt(covariance[i, i])
        row[SIGMA + i] = sigma
        # States without a threshold must be finite too.
        good = good and math.isfinite(sigma)
    for i in range(len(_READY_SIGMA)):
        good = good and row[SIGMA + i] < _READY_SIGMA[i]
    return good


@kernel
def attitude(row: Vector) -> Quat:
    """Return the attitude of a nominal state."""
    return row[Q], row[Q + 1], row[Q + 2], row[Q + 3]


@kernel
def _matrix(q: Quat) -> tuple[Vec, Vec, Vec]:
    """Return the rows of the rotation matrix of q: v_world = R v_body."""
    w, x, y, z = q
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
