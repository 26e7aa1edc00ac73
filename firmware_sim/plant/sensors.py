"""Sensor models: from the true state to samples, each with its own noise, bias and rate."""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from airl_mav.core.constants import TICK_S, US_PER_S
from airl_mav.core.frames import Vector, local_to_geodetic
from airl_mav.core.kernels import kernel
from airl_mav.core.location import HOME, MAGNETIC_FIELD_NED
from airl_mav.profiles.sensors import Barometer, Gps, Magnetometer, Sensors, Vision
from airl_mav.vehicle.atmosphere import pressure_hpa, temperature_c
from airl_mav.vehicle.rotation import (
    Quat,
    conjugate,
    exponential,
    multiply,
    rotate,
    yaw_of,
)
from firmware_sim.interfaces import BatterySample, GpsFix, Odometry, SensorSample
from firmware_sim.plant.kinematics import POSITION, VELOCITY, force, quaternion, rates

PA_PER_HPA = 100.0
GPS_SATELLITES = 12

BLOCK = 128
"""Samples for which noise is drawn at once; the number does not affect the values."""


class Rate:
    """Schedules a sensor that is slower than the tick, without drift."""

    def __init__(self, rate_hz: float) -> None:
        self._rate_hz = rate_hz
        self.next_us = 0.0
        """Simulated time before which it is not due [µs]."""
        self.period = 0
        """Number of the period that the newest sample is of."""

    def due(self, time_us: int) -> bool:
        """Return True once for every period that has passed."""
        if time_us < self.next_us:
            return False
        period = int(time_us * self._rate_hz / US_PER_S)
        # Rounding may put a time that lies on a boundary into the period before it.
        if self._start_us(period + 1) <= time_us:
            period += 1
        self.period, self.next_us = period, self._start_us(period + 1)
        return True

    def _start_us(self, period: int) -> float:
        return period * US_PER_S / self._rate_hz


class White:
    """White noise of one sensor, standard deviation 1."""

    def __init__(self, rng: np.random.Generator, width: int) -> None:
        self._rng = rng
        self._rows = np.zeros((0, width))
        self._next = 0

    def draw(self) -> Vector:
        """Return new numbers (width,)."""
        if self._next == len(self._rows):
            self._rows, self._next = self._rng.standard_normal((BLOCK, self._rows.shape[1])), 0
        row: Vector = self._rows[self._next]
        self._next += 1
        return row


@kernel
def _feel(
    row: Vector,
    noise: Vector,
    sigma: Vector,
    accel_bias: Vector,
    gyro_bias: Vector,
    accel: Vector,
    gyro: Vector,
) -> None:
    """Write what accelerometer and gyro measure, and let their biases walk.

    Args:
        row: (16,) the vehicle's motion.
        noise: (12,) white: of the accelerometer, of the gyro, of their biases (3 each).
        sigma: (12,) what it is multiplied by.
        accel_bias: (3,) [m/s²], updated.
        gyro_bias: (3,) [rad/s], updated.
        accel: (3,) FRD [m/s²], overwritten.
        gyro: (3,) FRD [rad/s], overwritten.
    """
    felt, turning = force(row), rates(row)
    for axis in range(3):
        accel_bias[axis] += sigma[6 + axis] * noise[6 + axis]
        gyro_bias[axis] += sigma[9 + axis] * noise[9 + axis]
        accel[axis] = felt[axis] + accel_bias[axis] + sigma[axis] * noise[axis]
        gyro[axis] = turning[axis] + gyro_bias[axis] + sigma[3 + axis] * noise[3 + axis]


@kernel
def _point(row: Vector, field: Vector, noise: Vector, sigma: float, mag: Vector) -> None:
    """Write what a magnetometer reads, FRD (3,), in a field NED (3,); noise white (3,)."""
    x, y, z = rotate(conjugate(quaternion(row)), (field[0], field[1], field[2]))
    mag[0] = x + sigma * noise[0]
    mag[1] = y + sigma * noise[1]
    mag[2] = z + sigma * noise[2]


class _Compass:
    """Magnetometer: white noise."""

    def __init__(self, magnetometer: Magnetometer, rng: np.random.Generator, times: float) -> None:
        self.rate = Rate(magnetometer.rate_hz)
        self._sigma = times * magnetometer.noise_gauss
        self._white = White(rng, 3)

    def read(self, row: Vector) -> Vector:
        """Return the field FRD [gauss]."""
        mag = np.empty(3)
        _point(row, MAGNETIC_FIELD_NED, self._white.draw(), self._sigma, mag)
        return mag


class _Barometer:
    """Barometer: white noise and a drift that walks."""

    def __init__(self, barometer: Barometer, rng: np.random.Generator, times: float) -> None:
        self.rate = Rate(barometer.rate_hz)
        self._noise_pa = times * barometer.noise_pa
        self._step_pa = times * barometer.drift_pa_sqrt_s / math.sqrt(barometer.rate_hz)
        self._drift_pa = 0.0
        self._white = White(rng, 2)

    def read(self, altitude: float) -> float:
        """Return the static pressure [hPa] at an altitude above mean sea level [m]."""
        white = self._white.draw()
        self._drift_pa += self._step_pa * white.item(0)
        noise_pa = self._noise_pa * white.item(1)
        return pressure_hpa(altitude) + (self._drift_pa + noise_pa) / PA_PER_HPA


class _Gps:
    """GPS: white noise, and a slowly wandering position error (Gauss-Markov on each axis)."""

    def __init__(self, gps: Gps, rng: np.random.Generator, times: float) -> None:
        self.rate = Rate(gps.rate_hz)
        self._gps = gps
        self._keep = math.exp(-1.0 / (gps.rate_hz * gps.drift_time_constant_s))
        sigma = gps.drift_m_sqrt_s * math.sqrt(0.5 * gps.drift_time_constant_s)
        self._drive = times * sigma * math.sqrt(1.0 - self._keep**2)
        self._error = np.zeros(3)
        noise = (gps.horizontal_noise_m, gps.horizontal_noise_m, gps.vertical_noise_m)
        self._position_noise = times * np.array(noise)
        self._velocity_noise = times * gps.velocity_noise_m_s
        self._white = White(rng, 9)

    def read(self, row: Vector) -> GpsFix:
        """Return a fix."""
        gps, white = self._gps, self._white.draw()
        self._error = self._keep * self._error + self._drive * white[0:3]
        position = row[POSITION] + self._error + self._position_noise * white[3:6]
        return GpsFix(
            position=local_to_geodetic(position, HOME),
            velocity_ned=row[VELOCITY] + self._velocity_noise * white[6:9],
            eph_m=gps.horizontal_noise_m,
            epv_m=gps.vertical_noise_m,
            satellites=GPS_SATELLITES,
        )


class _Vision:
    """Visual-inertial odometry: a pose in the frame of the start, which drifts, told late."""

    def __init__(self, vision: Vision, rng: np.random.Generator, times: float) -> None:
        self.rate = Rate(vision.rate_hz)
        self._vision, self._times = vision, times
        self._white = White(rng, 13)
        self._start: tuple[Vector, Vector] | None = None
        """Position, and attitude of the frame, at the first pose."""
        self._last = np.zeros(3)
        self._drift = np.zeros(3)
        """Of the position, in the frame [m]."""
        self._turned = 0.0
        """How far the frame's heading has drifted [rad]."""
        self._late: deque[tuple[float, Odometry]] = deque()
        """When each pose is told [µs], oldest first."""

    def observe(self, time_us: int, row: Vector) -> None:
        """Take a pose now."""
        profile, white, times = self._vision, self._white.draw(), self._times
        place, velocity, attitude = row[POSITION], row[VELOCITY], quaternion(row)
        if self._start is None:
            self._start, self._last = (place.copy(), frame_at(attitude)), place.copy()
        start, frame = self._start
        way = float(np.linalg.norm(place - self._last))
        self._last = place.copy()
        self._drift += times * profile.position_drift_m_sqrt_m * math.sqrt(way) * white[0:3]
        period_s = 1.0 / profile.rate_hz
        walk = times * profile.yaw_drift_rad_sqrt_s * math.sqrt(period_s)
        self._turned += walk * white.item(3)
        half = 0.5 * self._turned
        into = multiply((math.cos(half), 0.0, 0.0, math.sin(half)), conjugate(tuple(frame)))
        seen = rotate(into, tuple(place - start))
        moving = rotate(into, tuple(velocity))
        error = exponential(tuple(times * profile.angle_noise_rad * white[4:7]))
        odometry = Odometry(
            position=np.array(seen) + self._drift + times * profile.position_noise_m * white[7:10],
            velocity=np.array(moving) + times * profile.velocity_noise_m_s * white[10:13],
            quaternion=np.array(multiply(multiply(into, attitude), error)),
            pose_frame="frd",
            velocity_frame="frd",
            position_variance=np.full(3, profile.position_noise_m**2),
            velocity_variance=np.full(3, profile.velocity_noise_m_s**2),
            orientation_variance=np.full(3, profile.angle_noise_rad**2),
        )
        self._late.append((time_us + profile.delay_s * US_PER_S, odometry))

    @property
    def told_us(self) -> float:
        """When the next pose is told [µs]; inf = none is on its way."""
        return self._late[0][0] if self._late else math.inf

    def read(self) -> Odometry:
        """Return the pose that is due."""
        return self._late.popleft()[1]


def frame_at(attitude: Quat) -> Vector:
    """Return the frame of a vehicle's start: its heading, level (quaternion to NED)."""
    half = 0.5 * yaw_of(attitude)
    return np.array([math.cos(half), 0.0, 0.0, math.sin(half)])


class SensorSuite:
    """All sensors of the vehicle; one call a tick.

    Every sensor draws from a stream of its own, so that what one measures does not depend on how
    often another does.
    """

    def __init__(
        self,
        profile: Sensors,
        rng: np.random.Generator,
        tick_s: float = TICK_S,
        times: float = 1.0,
    ) -> None:
        """Switch them on.

        Args:
            profile: What they are.
            rng: Of all their noise.
            tick_s: Length of a tick [s].
            times: What noise, biases and drifts are multiplied by. What the GPS receiver says of
                its accuracy stays: nobody is told.
        """
        imu = profile.imu
        inertial, compass, barometer, gps, vision = rng.spawn(5)
        walk = math.sqrt(tick_s)
        # The profile's noise is that of a sample at the base tick: its density stays.
        white = math.sqrt(TICK_S / tick_s)
        self._sigma = times * np.repeat(
            [
                imu.accel_noise_m_s2 * white,
                imu.gyro_noise_rad_s * white,
                imu.accel_walk_m_s2_sqrt_s * walk,
                imu.gyro_walk_rad_s_sqrt_s * walk,
            ],
            3,
        )
        self._accel_bias = times * imu.accel_bias_m_s2 * inertial.standard_normal(3)
        self._gyro_bias = times * imu.gyro_bias_rad_s * inertial.standard_normal(3)
        self._white = White(inertial, 12)
        self._compass = _Compass(profile.magnetometer, compass, times)
        self._barometer = _Barometer(profile.barometer, barometer, times)
        self._gps = _Gps(profile.gps, gps, times) if profile.gps.fitted else None
        self._rates = [self._compass.rate, self._barometer.rate]
        if self._gps is not None:
            self._rates.append(self._gps.rate)
        self._vision = None
        if profile.vision is not None:
            self._vision = _Vision(profile.vision, vision, times)
            self._rates.append(self._vision.rate)
        self._slow_us = 0.0
        """Simulated time before which none of the slower ones is due [µs]."""

    def sample(self, time_us: int, row: Vector, battery: BatterySample) -> SensorSample:
        """Return what is measured at `time_us` [µs] in motion `row` (16,), `plant.kinematics`."""
        accel, gyro, noise = np.empty(3), np.empty(3), self._white.draw()
        _feel(row, noise, self._sigma, self._accel_bias, self._gyro_bias, accel, gyro)
        altitude = HOME.altitude_m - row.item(2)
        air = temperature_c(altitude)
        if time_us < self._slow_us:
            return SensorSample(time_us, accel, gyro, air, battery)
        mag = self._compass.read(row) if self._compass.rate.due(time_us) else None
        pressure = self._barometer.read(altitude) if self._barometer.rate.due(time_us) else None
        gps = None
        if self._gps is not None and self._gps.rate.due(time_us):
            gps = self._gps.read(row)
        odometry = None if self._vision is None else self._see(self._vision, time_us, row)
        self._slow_us = min(rate.next_us for rate in self._rates)
        if self._vision is not None:
            self._slow_us = min(self._slow_us, self._vision.told_us)
        return SensorSample(
            time_us, accel, gyro, air, battery, mag, pressure, gps, odometry=odometry
        )

    @staticmethod
    def _see(vision: _Vision, time_us: int, row: Vector) -> Odometry | None:
        if vision.rate.due(time_us):
            vision.observe(time_us, row)
        return vision.read() if vision.told_us <= time_us else None
