"""The estimator: an error-state extended Kalman filter on filterpy.

Nominal state: position and velocity NED, attitude body -> NED, gyro and accelerometer bias,
barometer offset. The filter's 16 error states are, in order: position (3) [m], velocity (3) [m/s],
attitude (3, rotation vector in body axes) [rad], gyro bias (3) [rad/s], accelerometer bias (3)
[m/s²], barometer offset (1) [m]. Between measurements the error is zero by construction; a
measurement's correction is moved into the nominal state at once (Solà, Quaternion kinematics for
the error-state Kalman filter, arXiv 1711.02508, sections 5-6).
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter

from airl_mav.atmosphere import altitude_m
from airl_mav.constants import GRAVITY_M_S2, TICK_S, US_PER_S
from airl_mav.frames import (
    Geodetic,
    Vector,
    geodetic_to_local,
    quat_from_euler,
    quat_from_rotation_vector,
    quat_multiply,
    quat_normalize,
    quat_to_euler,
    quat_to_matrix,
    wrap_pi,
)
from airl_mav.kernels import kernel
from airl_mav.location import MAGNETIC_DECLINATION, MAGNETIC_FIELD_NED
from airl_mav.vehicle.rotation import exponential, multiply, normalize
from firmware_sim.autopilot.state import Estimate
from firmware_sim.interfaces import GpsFix, SensorSample

N_STATES = 16
POS, VEL, ATT, GYRO, ACC, BARO = (
    slice(0, 3),
    slice(3, 6),
    slice(6, 9),
    slice(9, 12),
    slice(12, 15),
    15,
)

ALIGN_S = 0.5
"""Time at rest over which attitude and barometer are averaged at start [s]."""

GATE = 5.0
"""Innovations beyond this many standard deviations are not fused (EKF2_*_GATE)."""

_north, _east, _down = MAGNETIC_FIELD_NED
_HEADING_BY_TURN_NED = np.array([-_down * _north, -_down * _east, _north**2 + _east**2]) / (
    _north**2 + _east**2
)

BIAS_STEP_S = 0.01
"""PX4's filter runs at 100 Hz; its bias process noises (EKF2_*_B_NOISE) are per such a step [s]."""

BARO_WALK_M_SQRT_S = 0.01
"""Process noise of the barometer's offset [m/sqrt(s)]."""

# Converged when the standard deviations are below these: may be armed.
_READY_TILT_RAD = math.radians(2.0)
_READY_YAW_RAD = math.radians(5.0)
_READY_VELOCITY_M_S = 0.3
_READY_POSITION_M = 1.5


@kernel
def _propagate(
    p: Vector, v: Vector, q: Vector, gyro: Vector, accel: Vector, f_matrix: Vector, dt: float
) -> Vector:
    """Move the nominal state by one IMU sample in place; write the error's transition matrix.

    Args:
        p: Position NED, updated.
        v: Velocity NED, updated.
        q: Attitude, updated.
        gyro: Rates, bias removed, FRD.
        accel: Specific force, bias removed, FRD.
        f_matrix: (16, 16), updated where it depends on the state.
        dt: Time step [s].

    Returns:
        Acceleration NED, gravity removed (3,).
    """
    w, x, y, z = q[0], q[1], q[2], q[3]
    r = np.empty((3, 3))
    r[0, 0], r[0, 1], r[0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    r[1, 0], r[1, 1], r[1, 2] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    r[2, 0], r[2, 1], r[2, 2] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
    a = np.empty(3)
    for i in range(3):
        a[i] = r[i, 0] * accel[0] + r[i, 1] * accel[1] + r[i, 2] * accel[2]
    a[2] += GRAVITY_M_S2
    for i in range(3):
        p[i] += v[i] * dt + 0.5 * a[i] * dt * dt
        v[i] += a[i] * dt
    turn = exponential((gyro[0] * dt, gyro[1] * dt, gyro[2] * dt))
    qn = normalize(multiply((w, x, y, z), turn))
    q[0], q[1], q[2], q[3] = qn
    # dv/dtheta = -R [f]x, dv/dba = -R, dtheta/dtheta = I - [w]x, dtheta/dbg = -I
    fx, fy, fz = accel[0], accel[1], accel[2]
    for i in range(3):
        f_matrix[i, 3 + i] = dt
        f_matrix[3 + i, 6] = -(r[i, 1] * fz - r[i, 2] * fy) * dt
        f_matrix[3 + i, 7] = -(r[i, 2] * fx - r[i, 0] * fz) * dt
        f_matrix[3 + i, 8] = -(r[i, 0] * fy - r[i, 1] * fx) * dt
        f_matrix[6 + i, 9 + i] = -dt
        for j in range(3):
            f_matrix[3 + i, 12 + j] = -r[i, j] * dt
    f_matrix[6, 7], f_matrix[6, 8] = gyro[2] * dt, -gyro[1] * dt
    f_matrix[7, 6], f_matrix[7, 8] = -gyro[2] * dt, gyro[0] * dt
    f_matrix[8, 6], f_matrix[8, 7] = gyro[1] * dt, -gyro[0] * dt
    return a


class Estimator:
    """Noisy sensors in, position, velocity, attitude and biases out. Never sees truth."""

    def __init__(self, value: Callable[[str], float]) -> None:
        """Start unaligned. `value` looks up EKF2_* parameters by name."""
        self._value = value
        self.origin: Geodetic | None = None
        """Where local NED is zero: the mean of the first fixes; None before."""
        self._aligned = False
        self._resting: list[SensorSample] = []
        self._origin_altitude_baro = 0.0
        self._p, self._v = np.zeros(3), np.zeros(3)
        self._q = np.array([1.0, 0.0, 0.0, 0.0])
        self._gyro_bias, self._accel_bias = np.zeros(3), np.zeros(3)
        self._baro_offset = 0.0
        self._acceleration, self._rates = np.zeros(3), np.zeros(3)
        self._ratio = np.zeros(4)
        self._time_us = 0
        self.filter = ExtendedKalmanFilter(dim_x=N_STATES, dim_z=1)
        self.filter.x = np.zeros(N_STATES)
        self.filter.P = np.diag(
            np.repeat([1.0, 0.5, 0.05, 0.01, 0.1, 0.3], [3, 3, 3, 3, 3, 1]) ** 2
        )
        self._process_noise()
        self.innovations: Callable[[str, Vector, Vector], None] | None = None
        """Called with name, innovation and its covariance for every measurement, if set."""

    def step(self, sample: SensorSample) -> Estimate:
        """Take one tick's sensors; return the newest estimate."""
        self._time_us = sample.time_us
        if not self._aligned:
            self._align(sample)
        else:
            self._predict(sample)
            if sample.gps is not None and self.origin is not None:
                self._fuse_gps(sample.gps, self.origin)
            if sample.pressure_hpa is not None:
                self._fuse_baro(sample.pressure_hpa)
            if sample.mag is not None:
                self._fuse_heading(sample.mag)
        return self._estimate()

    # --- start

    def _align(self, sample: SensorSample) -> None:
        """Average the sensors at rest; then level by gravity and point by the magnetic field."""
        self._resting.append(sample)
        fixes = [s.gps for s in self._resting if s.gps is not None]
        elapsed_s = (sample.time_us - self._resting[0].time_us) / US_PER_S
        if elapsed_s < ALIGN_S or not fixes:
            return
        ax, ay, az = np.mean([s.accel for s in self._resting], axis=0)
        roll, pitch = math.atan2(-ay, -az), math.atan2(ax, math.hypot(ay, az))
        mag = np.mean([s.mag for s in self._resting if s.mag is not None], axis=0)
        self._q = quat_from_euler(roll, pitch, self._magnetic_heading(mag, roll, pitch))
        baro = [altitude_m(s.pressure_hpa) for s in self._resting if s.pressure_hpa is not None]
        self._origin_altitude_baro = float(np.mean(baro))
        position = np.mean([f.position for f in fixes], axis=0)
        self.origin = Geodetic(*(float(c) for c in position))
        self._resting.clear()
        self._aligned = True

    # --- prediction

    def _process_noise(self) -> None:
        value = self._value
        q = np.zeros(N_STATES)
        q[VEL] = (value("EKF2_ACC_NOISE") * TICK_S) ** 2
        q[ATT] = (value("EKF2_GYR_NOISE") * TICK_S) ** 2
        q[GYRO] = value("EKF2_GYR_B_NOISE") ** 2 * BIAS_STEP_S * TICK_S
        q[ACC] = value("EKF2_ACC_B_NOISE") ** 2 * BIAS_STEP_S * TICK_S
        q[BARO] = BARO_WALK_M_SQRT_S**2 * TICK_S
        self.filter.Q = np.diag(q)

    def _predict(self, sample: SensorSample) -> None:
        self._rates = sample.gyro - self._gyro_bias
        force = sample.accel - self._accel_bias
        self._acceleration = _propagate(
            self._p, self._v, self._q, self._rates, force, self.filter.F, TICK_S
        )
        self.filter.predict()

    # --- measurements

    def _fuse(self, name: str, innovation: Vector, h: Vector, variance: Vector) -> float:
        """Fuse one measurement; return its test ratio (above 1 = rejected)."""
        ekf = self.filter
        s = h @ ekf.P @ h.T + np.diag(variance)
        if self.innovations is not None:
            self.innovations(name, innovation, s)
        ratio = float(np.max(np.abs(innovation) / np.sqrt(np.diag(s)))) / GATE
        if ratio > 1.0:
            return ratio
        ekf.dim_z = len(innovation)
        ekf.update(innovation, lambda _x: h, lambda x: h @ x, R=np.diag(variance))
        self._inject(ekf.x)
        ekf.x = np.zeros(N_STATES)
        return ratio

    def _inject(self, error: Vector) -> None:
        """Move a correction into the nominal state."""
        self._p += error[POS]
        self._v += error[VEL]
        self._q = quat_normalize(quat_multiply(self._q, quat_from_rotation_vector(error[ATT])))
        self._gyro_bias = self._gyro_bias + error[GYRO]
        self._accel_bias = self._accel_bias + error[ACC]
        self._baro_offset += float(error[BARO])

    def _fuse_gps(self, fix: GpsFix, origin: Geodetic) -> None:
        measured = geodetic_to_local(fix.position, origin)
        value = self._value
        r_p, r_v = value("EKF2_GPS_P_NOISE") ** 2, value("EKF2_GPS_V_NOISE") ** 2
        # A receiver's height is about half as good as its horizontal position.
        r_z = max(fix.epv_m, math.sqrt(r_p)) ** 2
        horizontal = np.zeros((4, N_STATES))
        horizontal[0, 0] = horizontal[1, 1] = horizontal[2, 3] = horizontal[3, 4] = 1.0
        innovation = np.concatenate(
            [measured[:2] - self._p[:2], fix.velocity_ned[:2] - self._v[:2]]
        )
        variance = np.array([r_p, r_p, r_v, r_v])
        self._ratio[0] = self._fuse("gps_horizontal", innovation, horizontal, variance)
        vertical = np.zeros((2, N_STATES))
        vertical[0, 2] = vertical[1, 5] = 1.0
        innovation = np.array([measured[2] - self._p[2], fix.velocity_ned[2] - self._v[2]])
        self._ratio[3] = self._fuse("gps_vertical", innovation, vertical, np.array([r_z, r_v]))

    def _fuse_baro(self, pressure: float) -> None:
        height = altitude_m(pressure) - self._origin_altitude_baro
        h = np.zeros((1, N_STATES))
        h[0, 2], h[0, BARO] = -1.0, 1.0
        innovation = np.array([height - (-self._p[2] + self._baro_offset)])
        variance = np.array([self._value("EKF2_BARO_NOISE") ** 2])
        self._ratio[1] = self._fuse("baro", innovation, h, variance)

    def _magnetic_heading(self, mag: Vector, roll: float, pitch: float) -> float:
        """Return the true heading [rad] that a field measurement FRD shows at a given tilt."""
        level = quat_to_matrix(quat_from_euler(roll, pitch, 0.0)) @ mag
        return wrap_pi(MAGNETIC_DECLINATION - math.atan2(float(level[1]), float(level[0])))

    def _fuse_heading(self, mag: Vector) -> None:
        roll, pitch, yaw = quat_to_euler(self._q)
        if abs(pitch) > math.radians(80.0):
            return  # heading is not defined near the vertical
        innovation = np.array([wrap_pi(self._magnetic_heading(mag, roll, pitch) - yaw)])
        # The field dips, so a tilt error turns the measured heading: seen from the world's axes,
        # d innovation / d phi = (-tan(dip) cos(declination), -tan(dip) sin(declination), 1).
        h = np.zeros((1, N_STATES))
        h[0, ATT] = _HEADING_BY_TURN_NED @ quat_to_matrix(self._q)
        variance = np.array([self._value("EKF2_HEAD_NOISE") ** 2])
        self._ratio[2] = self._fuse("heading", innovation, h, variance)

    # --- output

    def _healthy(self, sigma: Vector) -> bool:
        return bool(
            self._aligned
            and np.all(np.isfinite(sigma))
            and np.all(sigma[6:8] < _READY_TILT_RAD)
            and sigma[8] < _READY_YAW_RAD
            and np.all(sigma[VEL] < _READY_VELOCITY_M_S)
            and np.all(sigma[POS] < _READY_POSITION_M)
        )

    def _estimate(self) -> Estimate:
        sigma = np.sqrt(np.diag(self.filter.P))
        return Estimate(
            time_us=self._time_us,
            position=self._p.copy(),
            velocity=self._v.copy(),
            acceleration=self._acceleration,
            quaternion=self._q.copy(),
            angular_velocity=self._rates,
            gyro_bias=self._gyro_bias,
            accel_bias=self._accel_bias,
            sigma=sigma,
            innovation_ratio=self._ratio.copy(),
            healthy=self._healthy(sigma),
        )
