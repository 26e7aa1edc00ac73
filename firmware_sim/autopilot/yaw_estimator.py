"""Yaw estimator: heading from IMU and GPS velocity without a compass.

A Gaussian sum of five small filters with initial headings evenly spaced around the circle. Each
filter has an attitude from the IMU (levelled by a complementary filter) and three states: velocity
north and east, and heading. GPS velocities correct the filters and weight them by their prediction
errors. The heading is unknown until the vehicle accelerates; then one hypothesis prevails.

It runs beside the estimator's filter without correcting it, and is used only when that filter
disagrees with GPS (`estimator`).

Source: PX4 1.16, src/modules/ekf2/EKF/yaw_estimator/EKFGSF_yaw.cpp, and its constants. The airspeed
correction of a fixed wing's turns (EKF2_GSF_TAS) does not apply to a multicopter. PX4 passes the
variance of the velocity where a standard deviation is expected; here it is the latter.
"""

from __future__ import annotations

import cmath
import math
from typing import Any

import numpy as np

from airl_mav.core.constants import GRAVITY_M_S2, TICK_S
from airl_mav.core.frames import Vector
from airl_mav.core.kernels import kernel, large_kernel
from airl_mav.vehicle import rotation
from firmware_sim.autopilot.error_state import GYRO_BIAS as _GYRO_BIAS

WINDOW = 20
"""Window length in fixes: 2 s at 10 Hz."""

FELT = 7
"""Index of the IMU-only velocity in the yaw estimator (`yaw_estimator.SHARED_SIZE`)."""

EXCUSED = 2.0
"""Factor on the GPS noise up to which there is no disagreement, as IMU velocity drifts."""


@kernel
def note_motion(record: Any, north: float, east: float, accuracy: float) -> None:
    """Record a GPS velocity [m/s] with its standard deviation per axis (`accuracy`)."""
    slot = record.motions % WINDOW
    record.felt_motion[slot, 0] = record.yaw_shared[FELT]
    record.felt_motion[slot, 1] = record.yaw_shared[FELT + 1]
    record.seen_motion[slot, 0], record.seen_motion[slot, 1] = north, east
    record.motions += 1
    record.motion_variance = accuracy * accuracy


N_MODELS = 5
TILT_GAIN = 0.2
"""Gain from tilt error to rate correction [1/s]."""
GYRO_BIAS_GAIN = 0.04
"""Gain from tilt correction to gyro bias [1/s]."""
ACCEL_NOISE = 2.0
"""[m/s²]"""
GYRO_NOISE = 0.1
"""[rad/s]"""
BIAS_LIMIT = 0.05
"""Maximum gyro bias [rad/s]."""
SLOW_TURN = math.radians(10.0)
"""Maximum turn rate for gyro bias learning [rad/s]."""
ACCEL_FILTER = 10.0
"""Ratio of the accelerometer filter's bandwidth to the tilt correction's."""
ALIGN_SHARE = 0.1
"""Maximum relative difference between specific force and gravity for tilt alignment."""
LEAST_ACCURACY_M_S = 0.01
LEAST_VARIANCE = 1e-6
LEAST_WEIGHT = 1e-5
NIS_LIMIT = 25.0
"""Limit of the normalised innovation squared: five standard deviations."""

# Layout of a model's row: velocity north, east, heading; upper triangle of their covariance;
# attitude body to world; gyro bias; weight.
X, YAW, P_NN, P_NE, P_NY, P_EE, P_EY, P_YY, ATTITUDE, BIAS, WEIGHT = (
    0,
    2,
    3,
    4,
    5,
    6,
    7,
    8,
    9,
    13,
    16,
)
MODEL_SIZE = 17

# Shared layout: smoothed specific force (3) [m/s²], tilt aligned, velocity fusion started, result:
# heading [rad] and its variance [rad²]; IMU-only velocity (2) [m/s], relative to the first model's
# heading minus the rotation from GPS corrections.
FORCE, ALIGNED, STARTED, RESULT, VARIANCE, TURNED = 0, 3, 4, 5, 6, 9
SHARED_SIZE = 10

LONGEST = 64
"""Maximum number of IMU samples buffered before prediction: 0.25 s."""


@kernel
def _accel_gain(force_norm: float) -> float:
    """Return the gain of the tilt correction [1/s], zero while the vehicle accelerates."""
    # Specific force far from g shows acceleration, not tilt.
    off = abs(force_norm - GRAVITY_M_S2) / GRAVITY_M_S2
    # Zero at half g of difference, squared as in PX4.
    rest = 1.0 - min(2.0 * off, 1.0)
    return TILT_GAIN * rest * rest


@kernel
def _quat(m: Vector) -> rotation.Quat:
    return m[ATTITUDE], m[ATTITUDE + 1], m[ATTITUDE + 2], m[ATTITUDE + 3]


@kernel
def _put(m: Vector, q: rotation.Quat) -> None:
    m[ATTITUDE], m[ATTITUDE + 1], m[ATTITUDE + 2], m[ATTITUDE + 3] = rotation.normalize(q)


@kernel
def _turn(m: Vector, angle: float) -> None:
    """Rotate a model's attitude about the world's down axis."""
    _put(m, rotation.multiply((math.cos(0.5 * angle), 0.0, 0.0, math.sin(0.5 * angle)), _quat(m)))


@kernel
def _level(m: Vector, gyro: rotation.Vec, force: rotation.Vec, dt: float) -> None:
    """Advance a model's attitude by the gyro; correct its tilt to the smoothed specific force."""
    norm = math.sqrt(force[0] * force[0] + force[1] * force[1] + force[2] * force[2])
    gain = _accel_gain(norm)
    # Cross product of the expected down axis and the measured force: it levels the model.
    down = rotation.rotate(rotation.conjugate(_quat(m)), (0.0, 0.0, 1.0))
    share = gain / norm if gain > 0.0 else 0.0
    tilt = (
        share * (down[1] * force[2] - down[2] * force[1]),
        share * (down[2] * force[0] - down[0] * force[2]),
        share * (down[0] * force[1] - down[1] * force[0]),
    )
    # As in PX4, only slow turns correct the gyro bias.
    spin2 = 0.0
    for i in range(3):
        spin2 += (gyro[i] - m[BIAS + i]) ** 2
    if spin2 < SLOW_TURN * SLOW_TURN:
        for i in range(3):
            bias = m[BIAS + i] - tilt[i] * GYRO_BIAS_GAIN * dt
            m[BIAS + i] = min(max(bias, -BIAS_LIMIT), BIAS_LIMIT)
    turn = rotation.exponential(
        (
            (gyro[0] + tilt[0] - m[BIAS]) * dt,
            (gyro[1] + tilt[1] - m[BIAS + 1]) * dt,
            (gyro[2] + tilt[2] - m[BIAS + 2]) * dt,
        )
    )
    _put(m, rotation.multiply(_quat(m), turn))


@kernel
def _predict(m: Vector, accel: rotation.Vec, dt: float) -> tuple[float, float]:
    """Advance a model's velocity, and its covariance with the heading, P = F P F' + Q.

    Only the heading column of F differs from the identity: a heading error rotates the velocity
    change, which is returned (north, east).
    """
    north, east, _ = rotation.rotate(_quat(m), (accel[0] * dt, accel[1] * dt, accel[2] * dt))
    # A heading error of 1 rad turns the change (n, e) to (-e, n).
    by_n, by_e = -east, north
    # First covariance with the heading, since the velocity block uses old and new values.
    ny = m[P_NY] + by_n * m[P_YY]
    ey = m[P_EY] + by_e * m[P_YY]
    moved = (ACCEL_NOISE * dt) ** 2
    m[P_NN] = max(m[P_NN] + by_n * (m[P_NY] + ny) + moved, LEAST_VARIANCE)
    m[P_NE] += by_e * m[P_NY] + by_n * ey
    m[P_EE] = max(m[P_EE] + by_e * (m[P_EY] + ey) + moved, LEAST_VARIANCE)
    m[P_NY], m[P_EY] = ny, ey
    m[P_YY] = max(m[P_YY] + (GYRO_NOISE * dt) ** 2, LEAST_VARIANCE)
    m[X] += north
    m[X + 1] += east
    return north, east


@kernel
def _add_change(shared: Vector, north: float, east: float) -> None:
    """Add a velocity change of the first model, without the rotation from GPS corrections."""
    # Undo the turns by GPS: the IMU-only velocity stays independent of GPS.
    c, s = math.cos(shared[TURNED]), math.sin(shared[TURNED])
    shared[FELT] += c * north + s * east
    shared[FELT + 1] += c * east - s * north


@large_kernel
def advance(models: Vector, shared: Vector, gyro: Vector, accel: Vector, dt: float) -> None:
    """Advance all models by n IMU samples (3 n,): gyro [rad/s] and specific force [m/s²], FRD.

    Updates `models` (N_MODELS, MODEL_SIZE) and `shared` (SHARED_SIZE,); `dt` is the time step [s].
    """
    # Low-pass for the specific force, ten times faster than the tilt correction.
    share = min(ACCEL_FILTER * dt * TILT_GAIN, 1.0)
    low, high = (1.0 - ALIGN_SHARE) * GRAVITY_M_S2, (1.0 + ALIGN_SHARE) * GRAVITY_M_S2
    for k in range(0, len(gyro), 3):
        a = (accel[k], accel[k + 1], accel[k + 2])
        for i in range(3):
            shared[FORCE + i] += share * (a[i] - shared[FORCE + i])
        force = (shared[FORCE], shared[FORCE + 1], shared[FORCE + 2])
        if shared[ALIGNED] == 0.0:
            # Tilt is aligned once, when both the sample and its mean are near 1 g.
            now2 = a[0] * a[0] + a[1] * a[1] + a[2] * a[2]
            mean2 = force[0] * force[0] + force[1] * force[1] + force[2] * force[2]
            if not (low * low < now2 < high * high and low * low < mean2 < high * high):
                continue
            roll = math.atan2(-a[1], -a[2])
            pitch = math.atan2(a[0], math.sqrt(a[1] * a[1] + a[2] * a[2]))
            level = rotation.multiply(
                rotation.exponential((0.0, pitch, 0.0)), rotation.exponential((roll, 0.0, 0.0))
            )
            for j in range(N_MODELS):
                _put(models[j], level)
            shared[ALIGNED] = 1.0
        w = (gyro[k], gyro[k + 1], gyro[k + 2])
        for j in range(N_MODELS):
            _level(models[j], w, force, dt)
            # Velocity is unknown until the first fix; until then only attitude is predicted.
            if shared[STARTED] != 0.0:
                north, east = _predict(models[j], a, dt)
                if j == 0:
                    _add_change(shared, north, east)
    # YAW follows the attitude, once per block: no sample in between reads it.
    if len(gyro) > 0 and shared[STARTED] != 0.0:
        for j in range(N_MODELS):
            models[j, YAW] = rotation.yaw_of(_quat(models[j]))


@kernel
def _start(models: Vector, shared: Vector, north: float, east: float, variance: float) -> None:
    """Initialize evenly spaced headings with equal weights."""
    step = 2.0 * math.pi / N_MODELS
    for j in range(N_MODELS):
        m = models[j]
        # The middle of each of the equal sectors.
        yaw = -math.pi + (j + 0.5) * step
        _turn(m, yaw - rotation.yaw_of(_quat(m)))
        m[:ATTITUDE] = 0.0
        m[X], m[X + 1], m[YAW] = north, east, yaw
        m[P_NN] = m[P_EE] = variance
        # Half a sector is the standard deviation of a hypothesis.
        m[P_YY] = (0.5 * step) ** 2
        m[WEIGHT] = 1.0 / N_MODELS
    # No heading is preferred yet: 90° of standard deviation.
    shared[STARTED], shared[RESULT], shared[VARIANCE] = 1.0, 0.0, (0.5 * math.pi) ** 2
    shared[FELT:] = 0.0


@kernel
def _correct(m: Vector, north: float, east: float, variance: float) -> float:
    """Fuse a velocity into a model; return the density of its innovation."""
    # Inverse of the 2x2 innovation covariance.
    s_nn, s_ne, s_ee = m[P_NN] + variance, m[P_NE], m[P_EE] + variance
    determinant = s_nn * s_ee - s_ne * s_ne
    i_nn, i_ne, i_ee = s_ee / determinant, -s_ne / determinant, s_nn / determinant
    d_n, d_e = north - m[X], east - m[X + 1]
    nis = d_n * d_n * i_nn + 2.0 * d_n * d_e * i_ne + d_e * d_e * i_ee
    # As in PX4, outliers are shortened to five standard deviations instead of rejected.
    if nis > NIS_LIMIT:
        shorter = math.sqrt(NIS_LIMIT / nis)
        d_n, d_e, nis = d_n * shorter, d_e * shorter, NIS_LIMIT
    p_nn, p_ne, p_ny, p_ee, p_ey = m[P_NN], m[P_NE], m[P_NY], m[P_EE], m[P_EY]
    # Kalman gains of velocity (n, e) and heading (y) by each velocity component.
    k_nn, k_ne = p_nn * i_nn + p_ne * i_ne, p_nn * i_ne + p_ne * i_ee
    k_en, k_ee = p_ne * i_nn + p_ee * i_ne, p_ne * i_ne + p_ee * i_ee
    k_yn, k_ye = p_ny * i_nn + p_ey * i_ne, p_ny * i_ne + p_ey * i_ee
    # P = (I - K H) P for the upper triangle; the diagonal stays positive.
    m[P_NN] = max(p_nn - k_nn * p_nn - k_ne * p_ne, LEAST_VARIANCE)
    m[P_NE] = p_ne - k_nn * p_ne - k_ne * p_ee
    m[P_NY] = p_ny - k_nn * p_ny - k_ne * p_ey
    m[P_EE] = max(p_ee - k_en * p_ne - k_ee * p_ee, LEAST_VARIANCE)
    m[P_EY] = p_ey - k_en * p_ny - k_ee * p_ey
    m[P_YY] = max(m[P_YY] - k_yn * p_ny - k_ye * p_ey, LEAST_VARIANCE)
    m[X] += k_nn * d_n + k_ne * d_e
    m[X + 1] += k_en * d_n + k_ee * d_e
    turned = k_yn * d_n + k_ye * d_e
    m[YAW] = (m[YAW] + turned + math.pi) % (2.0 * math.pi) - math.pi
    # Attitude and YAW turn together.
    _turn(m, turned)
    # Density of a normal distribution in two dimensions: the model's likelihood.
    return math.exp(-0.5 * nis) / (2.0 * math.pi * math.sqrt(determinant))


@large_kernel
def fuse(models: Vector, shared: Vector, north: float, east: float, accuracy: float) -> None:
    """Fuse a GPS velocity [m/s], and write heading and variance of the sum.

    Updates `models` and `shared`; `accuracy` is the standard deviation of each component [m/s].
    """
    if shared[ALIGNED] == 0.0:
        return
    variance = max(accuracy, LEAST_ACCURACY_M_S) ** 2
    if shared[STARTED] == 0.0:
        _start(models, shared, north, east, variance)
        return
    # The first turn of model 0 is its correction, recorded in TURNED.
    total, before = 0.0, models[0, YAW]
    for j in range(N_MODELS):
        density = _correct(models[j], north, east, variance)
        # A minimum weight lets every model recover later.
        models[j, WEIGHT] = max(models[j, WEIGHT] * density, LEAST_WEIGHT)
        total += models[j, WEIGHT]
    shared[TURNED] += models[0, YAW] - before
    # Weighted mean on the circle: angles cannot be averaged directly.
    ahead = aside = 0.0
    for j in range(N_MODELS):
        m = models[j]
        m[WEIGHT] /= total
        ahead += m[WEIGHT] * math.cos(m[YAW])
        aside += m[WEIGHT] * math.sin(m[YAW])
    # Variance of the mixture: variance of each model plus its distance from the mean.
    yaw, spread = math.atan2(aside, ahead), 0.0
    for j in range(N_MODELS):
        m = models[j]
        off = (m[YAW] - yaw + math.pi) % (2.0 * math.pi) - math.pi
        spread += m[WEIGHT] * (m[P_YY] + off * off)
    shared[RESULT], shared[VARIANCE] = yaw, spread
    # Numerical failure: start over with the next fix.
    if not (math.isfinite(spread) and spread > 0.0):
        shared[STARTED], shared[VARIANCE] = 0.0, math.inf


@kernel
def feel(record: Any) -> None:
    """Buffer an IMU sample in the record of a flight controller; predict if the buffer is full."""
    at = 3 * record.yaw_count
    for i in range(3):
        record.yaw_gyro[at + i], record.yaw_accel[at + i] = record.gyro[i], record.accel[i]
    record.yaw_count += 1
    if record.yaw_count >= LONGEST:
        predict_kept(record)


@kernel
def predict_kept(record: Any) -> None:
    """Advance all models by the buffered samples."""
    n = 3 * record.yaw_count
    advance(record.yaw_models, record.yaw_shared, record.yaw_gyro[:n], record.yaw_accel[:n], TICK_S)
    record.yaw_count = 0


@kernel
def observe(record: Any, north: float, east: float, accuracy: float) -> None:
    """Process a GPS velocity in a flight controller's record, like `YawEstimator.observe`."""
    predict_kept(record)
    if record.flying != 0:
        fuse(record.yaw_models, record.yaw_shared, north, east, accuracy)
        note_motion(record, north, east, accuracy)
        return
    # On the ground there is no acceleration to learn from: restart, and keep the filter's bias.
    record.motions = 0
    record.yaw_shared[STARTED], record.yaw_shared[VARIANCE] = 0.0, math.inf
    for j in range(N_MODELS):
        for i in range(3):
            # After position, velocity, attitude and rates of the nominal state.
            record.yaw_models[j, BIAS + i] = record.state[_GYRO_BIAS + i]


@kernel
def _observe(records: Any, north: float, east: float, accuracy: float) -> None:
    observe(records[0], north, east, accuracy)


@kernel
def _feel(records: Any) -> None:
    feel(records[0])


class YawEstimator:
    """Heading estimator from IMU and GPS velocity.

    IMU samples are buffered until a fix needs them: joint prediction takes a tenth of the time of
    separate predictions, with the same result.
    """

    def __init__(self, record: Any) -> None:
        """Start without a tilt, in the record of a flight controller."""
        self._record = record
        self.models = record["yaw_models"][0]
        """Models (N_MODELS, MODEL_SIZE)."""
        # Identity attitude until `advance` aligns the tilt.
        self.models[:, ATTITUDE] = 1.0
        self._shared = record["yaw_shared"][0]
        self._shared[VARIANCE] = math.inf

    @property
    def yaw(self) -> float:
        """Heading [rad]; valid if the variance is small."""
        return self._shared.item(RESULT)

    @property
    def variance(self) -> float:
        """Variance of the heading [rad²]; infinite before velocities are fused."""
        return self._shared.item(VARIANCE)

    @property
    def attitude(self) -> Vector:
        """Attitude of the most likely model (4,), body to world, wxyz. All share its tilt."""
        return self.models[int(np.argmax(self.models[:, WEIGHT])), ATTITUDE:BIAS].copy()

    def feel(self, gyro: Vector, accel: Vector) -> None:
        """Process a tick's IMU sample, each (3,) FRD [rad/s], [m/s²]."""
        self._record["gyro"], self._record["accel"] = gyro, accel
        _feel(self._record)

    def observe(
        self, velocity: Vector, accuracy: float, gyro_bias: Vector, *, flying: bool
    ) -> None:
        """Process a GPS velocity; on the ground, without information on heading, restart.

        The velocity is NED (3,) [m/s], `accuracy` its standard deviation per axis; the estimated
        gyro bias (3,) [rad/s] is copied on the ground.
        """
        self._record["flying"] = flying
        self._record["state"][0, _GYRO_BIAS : _GYRO_BIAS + 3] = gyro_bias
        _observe(self._record, velocity.item(0), velocity.item(1), accuracy)

    def motion(self, name: str) -> Vector:
        """Return the newest velocities of `felt_motion` (IMU) or `seen_motion` (GPS).

        They are complex numbers: north and east [m/s].
        """
        rows = self._record[name][0, : min(self._record["motions"].item(0), WINDOW)]
        velocities: Vector = rows[:, 0] + 1j * rows[:, 1]
        return velocities

    def explained(self, yaw: float) -> float:
        """Return the share of the disagreement of GPS and a heading [rad] that another explains.

        The range is 0 to 1; 0 if there is no disagreement.
        """
        w = self.motion("seen_motion")
        if not len(w):
            return 0.0
        # From the axes of the IMU-only velocity: model 0 without the turns by GPS.
        turn = yaw - (self.models.item(0, YAW) - self._shared.item(TURNED))
        # Complex numbers: a turn is a factor, and the best turn has the phase of the product.
        u = self.motion("felt_motion") * cmath.exp(1j * turn)
        # Without the means the unknown constant velocity cancels.
        u, w = u - u.mean(), w - w.mean()
        common = complex(np.vdot(u, w))
        power = float(np.vdot(u, u).real + np.vdot(w, w).real)
        # GPS noise explains a part of the power: 2 components per fix.
        rest = power - 2.0 * EXCUSED * self._record["motion_variance"].item(0) * len(w)
        # Rest at the best angle, and rest at the tested angle.
        turned = max(rest - 2.0 * abs(common), 0.0)
        as_they_are = rest - 2.0 * common.real
        return 1.0 - turned / as_they_are if as_they_are > turned else 0.0
