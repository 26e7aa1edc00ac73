"""States, measurement models and error filter of the estimator.

The nominal state is a row of `ROW_SIZE` floats, directly usable by compiled code. The estimated
error has 16 states, in this order: position (3) [m], velocity (3) [m/s], attitude (3, rotation
vector in body axes) [rad], gyro bias (3) [rad/s], accelerometer bias (3) [m/s²], barometer offset
(1) [m]. Between measurements the error is zero by construction. A measurement's correction is
injected into the nominal state at once (Solà, Quaternion kinematics for the error-state Kalman
filter, arXiv 1711.02508, sections 5-6).

The filter, in compiled code, is equivalent to `filter_filterpy` up to rounding. It uses the
structure of the matrices: most rows of the transition matrix equal the identity's. The noises of a
measurement's components are independent, so sequential fusion equals joint fusion (Bar-Shalom, Li,
Kirubarajan, Estimation with Applications to Tracking and Navigation, ch. 7.2.2). The covariance is
always exactly symmetric.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from airl_mav.core.constants import GRAVITY_M_S2, TICK_S, TICK_US, US_PER_MS
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
    """Advance the nominal state by an IMU sample, gyro [rad/s] and specific force [m/s²] FRD.

    Writes the error's transition matrix (16, 16) where it differs from the identity.
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

    `field` is a magnetometer sample (3,) FRD, `declination` the angle from true to magnetic north
    [rad], `by_turn` the change of the innovation by a turn about each world axis (3,).
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


_MOVING = 9
"""Number of propagated states: position, velocity, attitude. Biases and offset are constant."""


@kernel
def _times_transposed(f: Vector, p: Vector, columns: int, out: Vector) -> None:
    """Write (f p)' (columns, 9) for the moving rows of f (16, 16) and the first columns of p."""
    # Position, velocity and attitude rows in turn; only entries that differ from I are used.
    for j in range(columns):
        ax, ay, az = p[ATT, j], p[ATT + 1, j], p[ATT + 2, j]
        bx, by, bz = p[ACC, j], p[ACC + 1, j], p[ACC + 2, j]
        for k in range(3):
            i = POS + k
            out[j, i] = p[i, j] + f[i, VEL + k] * p[VEL + k, j]
            i = VEL + k
            by_attitude = f[i, ATT] * ax + f[i, ATT + 1] * ay + f[i, ATT + 2] * az
            by_bias = f[i, ACC] * bx + f[i, ACC + 1] * by + f[i, ACC + 2] * bz
            out[j, i] = p[i, j] + by_attitude + by_bias
            # f holds the unit diagonal of the attitude block.
            i = ATT + k
            turned = f[i, ATT] * ax + f[i, ATT + 1] * ay + f[i, ATT + 2] * az
            out[j, i] = turned + f[i, GYRO + k] * p[GYRO + k, j]


@kernel
def predict(
    state: Vector, p: Vector, noise: Vector, f: Vector, gyro: Vector, accel: Vector, dt: float
) -> None:
    """Advance the nominal state and its covariance, p = f p f' + noise, in place."""
    propagate(state, gyro, accel, f, dt)
    half = np.empty((N_STATES, _MOVING))
    whole = np.empty((_MOVING, _MOVING))
    # First f p, then (f p) f', each transposed, so that one function does both.
    _times_transposed(f, p, N_STATES, half)
    _times_transposed(f, half, _MOVING, whole)
    # Compute the upper triangle and mirror it: the covariance stays exactly symmetric.
    for i in range(_MOVING):
        for j in range(i, _MOVING):
            p[i, j] = p[j, i] = whole[i, j]
        # Biases and offset do not move: only their covariance with moving states changes.
        for j in range(_MOVING, N_STATES):
            p[i, j] = p[j, i] = half[j, i]
    for i in range(N_STATES):
        p[i, i] += noise[i]


@kernel
def fuse(state: Vector, p: Vector, innovation: Vector, h: Vector, variance: Vector) -> float:
    """Correct the nominal state and its covariance in place; return the gate ratio."""
    m = len(innovation)
    column = np.empty(N_STATES)
    total = np.empty(m)
    # The gate tests all components against the covariance before the fusion.
    for k in range(m):
        total[k] = spread(p, h[k], column) + variance[k]
    ratio = gate_ratio(innovation, total)
    # False for NaN, too.
    if not ratio <= 1.0:
        return ratio
    error = np.zeros(N_STATES)
    # Sequential scalar fusion: no matrix inverse.
    for k in range(m):
        weight = 1.0 / (spread(p, h[k], column) + variance[k])
        # The error so far already explains a part of this component.
        rest = innovation[k]
        for i in range(N_STATES):
            rest -= h[k, i] * error[i]
        for i in range(N_STATES):
            # p is symmetric: p h' is both the column and, transposed, the row.
            error[i] += column[i] * rest * weight
            for j in range(N_STATES):
                p[i, j] -= column[i] * column[j] * weight
    inject(state, error)
    return ratio


@kernel
def spread(p: Vector, row: Vector, out: Vector) -> float:
    """Write p row' (16,); return row p row'. Zeros of the row are skipped."""
    out[:] = 0.0
    for k in range(N_STATES):
        if row[k] != 0.0:
            for i in range(N_STATES):
                out[i] += row[k] * p[k, i]
    square = 0.0
    for k in range(N_STATES):
        square += row[k] * out[k]
    return square


class KernelFilter:
    """Implementation of `error_state.ErrorFilter` in compiled code."""

    def __init__(self, covariance: Vector, noise: Vector) -> None:
        """Start with a covariance (16, 16); variances `noise` (16,) are added in every tick."""
        self.covariance = covariance.copy()
        self._noise = noise.copy()
        self._transition = np.eye(N_STATES)

    def keep_in(self, covariance: Vector, transition: Vector, noise: Vector) -> None:
        """Use these arrays for covariance and transition (16, 16) and noise (16,) from now on."""
        # Copy the values first: the arrays of the record replace the own ones.
        covariance[:], transition[:], noise[:] = self.covariance, self._transition, self._noise
        self.covariance, self._transition, self._noise = covariance, transition, noise

    def predict(self, state: Vector, gyro: Vector, accel: Vector) -> None:
        """Advance the nominal state, updated in place, and the covariance by one tick."""
        predict(state, self.covariance, self._noise, self._transition, gyro, accel, TICK_S)

    def restart(self, covariance: Vector) -> None:
        """Continue from another covariance (16, 16)."""
        self.covariance[:] = covariance

    def fuse(self, state: Vector, innovation: Vector, h: Vector, variance: Vector) -> float:
        """Correct the nominal state by one measurement, unless it fails the gate."""
        ratio: float = fuse(state, self.covariance, innovation, h, variance)
        return ratio


class ErrorFilter(Protocol):
    """Filter for the error covariance; injects corrections into the nominal state.

    The nominal state is a row of `error_state.ROW_SIZE` floats, updated in place.
    """

    @property
    def covariance(self) -> Vector:
        """Covariance of the error, (16, 16)."""

    def predict(self, state: Vector, gyro: Vector, accel: Vector) -> None:
        """Advance nominal state and covariance by one tick's IMU sample, each (3,) FRD."""

    def restart(self, covariance: Vector) -> None:
        """Continue from another covariance (16, 16), discarding the current one."""

    def fuse(self, state: Vector, innovation: Vector, h: Vector, variance: Vector) -> float:
        """Correct the nominal state by one measurement, unless it fails the gate.

        The innovation (m,) is measured minus expected, `h` (m, 16) the Jacobian of the expected
        measurement by the error, `variance` (m,) that of the independent noises. Returns the test
        ratio: 1 = at the gate; above 1, or NaN, nothing was corrected.
        """


NewFilter = Callable[[Vector, Vector], ErrorFilter]
"""Factory: filter from the first covariance (16, 16) and each tick's increment of its diagonal."""


class Measurement:
    """Buffers for one type of measurement: innovation, its variance and Jacobian."""

    def __init__(
        self, name: str, ratio: int, h: Vector, fused: NDArray[np.int64] | None = None
    ) -> None:
        """Allocate the buffers of a measurement with Jacobian h (m, 16).

        `ratio` is its index in the estimate's test ratios, `fused` a (1,) array for the time of the
        newest fusion [µs]; None = a new array.
        """
        self.name = name
        self.slot = RATIO + ratio
        self.h = h
        self.innovation, self.variance = np.zeros(len(h)), np.zeros(len(h))
        self._fused = np.full(1, -1) if fused is None else fused

    @property
    def fused_us(self) -> int | None:
        """Time of the newest sample within the gate [µs]; None = none yet."""
        time_us = self._fused.item(0)
        return None if time_us < 0 else time_us

    @fused_us.setter
    def fused_us(self, time_us: int | None) -> None:
        self._fused[0] = -1 if time_us is None else time_us


def selecting(*errors: int) -> Vector:
    """Return the Jacobian (m, 16) of a sensor that measures these states directly."""
    return np.eye(N_STATES)[list(errors)]


SIMULATED_MS = 10.0
"""EKF2_GPS_DELAY by default: latency of a fix in PX4's simulators. Here a fix has no latency, so
only the assumed delay beyond this value counts [ms]."""


class FusionHorizon:
    """Predicted change of position and velocity since the fusion horizon (EKF2_GPS_DELAY).

    A delayed fix measures a past position. PX4 runs the whole filter at that past time and predicts
    the present from it. Here the filter runs in the present, and the fix is compared with the past
    position: the current estimate minus the motion since then. The correction is the same, as
    errors of position and velocity hardly change in such a short time (Larsen et al., Incorporation
    of time delayed measurements in a discrete-time Kalman filter, CDC 1998: the delayed state's
    cross-covariance is taken as the present one's).
    """

    def __init__(self, simulated_ms: float = SIMULATED_MS) -> None:
        """Start without a delay, of which fixes do not have a share `simulated_ms` [ms] here."""
        self._simulated_ms = simulated_ms
        self.is_past = False
        """True if the horizon is in the past; if not, `moved` need not be called."""
        self._travelled = np.zeros(Q - P)
        self._log: deque[Vector] = deque([self._travelled], maxlen=1)

    def assume(self, delay_ms: float) -> None:
        """Set the horizon back by the assumed delay of fixes [ms]."""
        # A delay shorter than the simulated latency counts as none.
        late_us = (delay_ms - self._simulated_ms) * US_PER_MS
        length = 1 + max(0, round(late_us / TICK_US))
        if length != self._log.maxlen:
            # A new length discards the log: the horizon starts at the present.
            self._log = deque([self._travelled], maxlen=length)
            self.is_past = length > 1

    def moved(self, before: Vector, after: Vector) -> None:
        """Record a tick's prediction: position and velocity (6,) NED before and after it."""
        # A new array each time: the log keeps the old ones.
        self._travelled = self._travelled + (after - before)
        self._log.append(self._travelled)

    def seen_from(self, state: Vector) -> Vector:
        """Return position and velocity (6,) NED at the horizon, based on the current state."""
        # The log's first entry is the motion up to the horizon.
        return state[P:Q] - (self._travelled - self._log[0])
