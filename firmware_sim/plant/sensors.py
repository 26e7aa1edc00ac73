"""Sensor models: samples from the true state, each with separate noise, bias and rate."""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from airl_mav.core.constants import TICK_S, US_PER_S
from airl_mav.core.frames import HOME, Vector, local_to_geodetic
from airl_mav.profiles.vehicle import Sensors, Vision
from airl_mav.vehicle.rotation import (
    Quat,
    conjugate,
    exponential,
    multiply,
    rotate,
    yaw_of,
)
from firmware_sim.engine.dynamics import POSITION, VELOCITY, quaternion
from firmware_sim.engine.record import GPS, MAG, PRESSURE, Record, new_aircraft, new_sample
from firmware_sim.engine.ticks import sense_record
from firmware_sim.interfaces import BatterySample, GpsFix, Odometry, SensorSample

GPS_SATELLITES = 12

BLOCK = 128
"""Number of samples per block of noise. Does not affect the values."""

_WIDTHS = (12, 3, 2, 9)
"""White noise values per sample of accelerometer and gyro, compass, barometer, GPS."""


class Rate:
    """Schedule of a sensor slower than the tick, without drift."""

    def __init__(self, rate_hz: float) -> None:
        self._rate_hz = rate_hz
        self.period_us = US_PER_S / rate_hz
        """Time between two samples [µs]."""
        self.next_us = 0.0
        """Simulated time of the next sample [µs]."""
        self.period = 0
        """Period number of the newest sample."""

    def due(self, time_us: int) -> bool:
        """Return True once per elapsed period."""
        if time_us < self.next_us:
            return False
        period = int(time_us * self._rate_hz / US_PER_S)
        # Rounding may assign a time on a boundary to the period before.
        if (period + 1) * US_PER_S / self._rate_hz <= time_us:
            period += 1
        self.period, self.next_us = period, (period + 1) * US_PER_S / self._rate_hz
        return True


class White:
    """White noise of one sensor, standard deviation 1."""

    def __init__(self, rng: np.random.Generator, width: int) -> None:
        self._rng = rng
        self._rows = np.zeros((0, width))
        self._next = 0

    def draw(self) -> Vector:
        """Return new values (width,)."""
        if self._next == len(self._rows):
            self._rows, self._next = self._rng.standard_normal((BLOCK, self._rows.shape[1])), 0
        row: Vector = self._rows[self._next]
        self._next += 1
        return row


class _Vision:
    """Visual-inertial odometry: a pose in the start frame, with drift and latency."""

    def __init__(self, vision: Vision, rng: np.random.Generator, times: float) -> None:
        self.rate = Rate(vision.rate_hz)
        self._vision, self._times = vision, times
        self._white = White(rng, 13)
        self._start: tuple[Vector, Vector] | None = None
        """Position, and attitude of the frame, at the first pose."""
        self._last = np.zeros(3)
        self._drift = np.zeros(3)
        """Drift of the position, in the frame [m]."""
        self._turned = 0.0
        """Drift of the frame's heading [rad]."""
        self._late: deque[tuple[float, Odometry]] = deque()
        """Poses with their delivery times [µs], oldest first."""

    def observe(self, time_us: int, row: Vector) -> None:
        """Sample a pose at the current time."""
        profile, white, times = self._vision, self._white.draw(), self._times
        place, velocity, attitude = row[POSITION], row[VELOCITY], quaternion(row)
        if self._start is None:
            self._start, self._last = (place.copy(), frame_at(attitude)), place.copy()
        start, frame = self._start
        # Drift grows with the square root of the way: independent steps per metre.
        way = float(np.linalg.norm(place - self._last))
        self._last = place.copy()
        self._drift += times * profile.position_drift_m_sqrt_m * math.sqrt(way) * white[0:3]
        period_s = 1.0 / profile.rate_hz
        # Heading drift grows with the square root of time.
        walk = times * profile.yaw_drift_rad_sqrt_s * math.sqrt(period_s)
        self._turned += walk * white.item(3)
        half = 0.5 * self._turned
        # From NED into the drifted start frame.
        into = multiply((math.cos(half), 0.0, 0.0, math.sin(half)), conjugate(tuple(frame)))
        seen = rotate(into, tuple(place - start))
        moving = rotate(into, tuple(velocity))
        # Attitude noise is a small rotation.
        error = exponential(tuple(times * profile.angle_noise_rad * white[4:7]))
        odometry = Odometry(
            position=np.array(seen) + self._drift + times * profile.position_noise_m * white[7:10],
            velocity=np.array(moving) + times * profile.velocity_noise_m_s * white[10:13],
            quaternion=np.array(multiply(multiply(into, attitude), error)),
            pose_frame="frd",
            velocity_frame="frd",
            # Reported variances are the profile's, without the factor `times`.
            position_variance=np.full(3, profile.position_noise_m**2),
            velocity_variance=np.full(3, profile.velocity_noise_m_s**2),
            orientation_variance=np.full(3, profile.angle_noise_rad**2),
        )
        # Deliver later: the pose is measured now.
        self._late.append((time_us + profile.delay_s * US_PER_S, odometry))

    @property
    def told_us(self) -> float:
        """Delivery time of the next pose [µs]; inf = no pose pending."""
        return self._late[0][0] if self._late else math.inf

    def read(self) -> Odometry:
        """Return the pose that is due."""
        return self._late.popleft()[1]


def frame_at(attitude: Quat) -> Vector:
    """Return a level frame with the heading of an attitude (quaternion to NED)."""
    half = 0.5 * yaw_of(attitude)
    return np.array([math.cos(half), 0.0, 0.0, math.sin(half)])


class SensorSuite:
    """All sensors of the vehicle, with one call per tick.

    Every sensor has a separate random stream, so its measurements do not depend on the rates of the
    others.
    """

    def __init__(
        self,
        profile: Sensors,
        rng: np.random.Generator,
        tick_s: float = TICK_S,
        times: float = 1.0,
        record: Record | None = None,
    ) -> None:
        """Initialize the sensors.

        Args:
            profile: Sensor profile.
            rng: Random generator of all noise.
            tick_s: Length of a tick [s].
            times: Factor of noise, biases and drifts. Does not affect the accuracy that the GPS
                receiver reports.
            record: Record of the aircraft, which stores the sensors' state; None = a new one.
        """
        self._record = record = new_aircraft() if record is None else record
        self.record = new_sample()
        """Newest sample of the compiled sensors."""
        imu, gps, barometer = profile.imu, profile.gps, profile.barometer
        self._gps = gps
        # One stream per sensor, so that rates of one do not shift the noise of others.
        streams = rng.spawn(5)
        inertial, vision = streams[0], streams[4]
        # Random walk: steps grow with the square root of the tick.
        walk = math.sqrt(tick_s)
        # The profile gives the noise at the base tick; the noise density is constant.
        white = math.sqrt(TICK_S / tick_s)
        record["imu_sigma"] = times * np.repeat(
            [
                imu.accel_noise_m_s2 * white,
                imu.gyro_noise_rad_s * white,
                imu.accel_walk_m_s2_sqrt_s * walk,
                imu.gyro_walk_rad_s_sqrt_s * walk,
            ],
            3,
        )
        record["accel_bias"] = times * imu.accel_bias_m_s2 * inertial.standard_normal(3)
        record["gyro_bias"] = times * imu.gyro_bias_rad_s * inertial.standard_normal(3)
        record["mag_sigma"] = times * profile.magnetometer.noise_gauss
        record["baro_noise_pa"] = times * barometer.noise_pa
        record["baro_step_pa"] = times * barometer.drift_pa_sqrt_s / math.sqrt(barometer.rate_hz)
        # First-order Gauss-Markov process: share kept per fix, and its stationary deviation.
        keep = math.exp(-1.0 / (gps.rate_hz * gps.drift_time_constant_s))
        sigma = gps.drift_m_sqrt_s * math.sqrt(0.5 * gps.drift_time_constant_s)
        record["gps_fitted"], record["gps_keep"] = gps.fitted, keep
        # The drive keeps the variance constant.
        record["gps_drive"] = times * sigma * math.sqrt(1.0 - keep**2)
        noise = (gps.horizontal_noise_m, gps.horizontal_noise_m, gps.vertical_noise_m)
        record["gps_noise_m"] = times * np.array(noise)
        record["gps_noise_m_s"] = times * gps.velocity_noise_m_s
        self.record["gps_epv_m"] = gps.vertical_noise_m
        for name, rate_hz in (
            ("mag_rate", profile.magnetometer.rate_hz),
            ("baro_rate", barometer.rate_hz),
            ("gps_rate", gps.rate_hz),
        ):
            record[name] = rate_hz, 0.0, 0.0
        self._streams = streams[:4]
        self.noise = [np.zeros((0, width)) for width in _WIDTHS]
        """White noise of accelerometer and gyro, compass, barometer, GPS: blocks of rows."""
        self._vision = None
        if profile.vision is not None:
            self._vision = _Vision(profile.vision, vision, times)

    def measure(self) -> None:
        """Sample the compiled sensors."""
        self.refill()
        sense_record(self._record, self.record, *self.noise)

    def refill(self) -> None:
        """Draw new blocks of noise to replace used-up blocks."""
        used = self._record["noise_at"][0]
        for i, rng in enumerate(self._streams):
            if used[i] >= len(self.noise[i]):
                self.noise[i], used[i] = rng.standard_normal((BLOCK, _WIDTHS[i])), 0

    def sample(self, time_us: int, row: Vector, battery: BatterySample) -> SensorSample:
        """Return the sample at `time_us` [µs] in motion `row` (16,), see `engine.dynamics`."""
        record = self._record
        record["time_us"], record["motion"] = time_us, row
        self.measure()
        odometry = None if self._vision is None else self._see(self._vision, time_us, row)
        return self.newest(battery)._replace(odometry=odometry)

    def newest(self, battery: BatterySample) -> SensorSample:
        """Return the newest sample of the record."""
        fields = self.record[0]
        measured, gps = fields["measured"], self._gps
        fix = None
        if measured & GPS:
            fix = GpsFix(
                local_to_geodetic(fields["gps_position"], HOME),
                fields["gps_velocity"].copy(),
                eph_m=gps.horizontal_noise_m,
                epv_m=gps.vertical_noise_m,
                satellites=GPS_SATELLITES,
            )
        return SensorSample(
            int(fields["time_us"]),
            fields["accel"].copy(),
            fields["gyro"].copy(),
            float(fields["temperature_c"]),
            battery,
            fields["mag"].copy() if measured & MAG else None,
            float(fields["pressure_hpa"]) if measured & PRESSURE else None,
            fix,
        )

    @staticmethod
    def _see(vision: _Vision, time_us: int, row: Vector) -> Odometry | None:
        if vision.rate.due(time_us):
            vision.observe(time_us, row)
        return vision.read() if vision.told_us <= time_us else None
