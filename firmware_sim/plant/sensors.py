"""Sensor models: samples from the true state, each with separate noise, bias and rate."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from airl_mav.arena.geometry import Arena
from airl_mav.core import constants, frames
from airl_mav.profiles.vehicle import Sensors
from firmware_sim.engine.record import GPS, MAG, PRESSURE, Record, new_aircraft, new_sample
from firmware_sim.engine.ticks import is_due, sense_record
from firmware_sim.interfaces import BatterySample, GpsFix, SensorSample

GPS_SATELLITES = 12

BLOCK = 128
"""Number of samples per block of noise. Does not affect the values."""

_WIDTHS = (12, 3, 2, 9)
"""White noise values per sample of accelerometer and gyro, compass, barometer, GPS."""


class Site(NamedTuple):
    """Surroundings of a simulated sensor."""

    arena: Arena | None
    """Arena; None = an endless floor."""
    rng: np.random.Generator
    """Random generator of this sensor only."""
    times: float
    """Factor of the noise; does not affect reported variances."""
    tick_s: float
    """Length of a tick [s]."""


class SimulatedSensor:
    """Simulation of a sensor in Python (`sensor_table.Sensor`): a rate and white noise."""

    noises = 1
    """Number of white noise values per reading."""

    def __init__(self, profile: Any, site: Site) -> None:
        """Store the sensor's model in a vehicle profile, with its `rate_hz`, and the site."""
        self.profile, self.site = profile, site
        self._schedule = np.array([profile.rate_hz, 0.0, 0.0])
        self._rows = np.zeros((0, self.noises))
        self._next = 0

    def white(self) -> frames.Vector:
        """Return new white noise (noises,), standard deviation 1."""
        if self._next == len(self._rows):
            self._rows, self._next = self.site.rng.standard_normal((BLOCK, self.noises)), 0
        row: frames.Vector = self._rows[self._next]
        self._next += 1
        return row

    def due(self, time_us: int) -> bool:
        """Return True once per period of the sensor."""
        return is_due(self._schedule, time_us)

    def sense(self, time_us: int, row: frames.Vector, elapsed_us: int) -> Any:
        """Return the reading that is delivered after a tick at `time_us`; None = none.

        `row` (16,) is the motion of the vehicle (`engine.dynamics`), `elapsed_us` the time since
        the moving obstacles started [µs].
        """
        return self.read(row, elapsed_us) if self.due(time_us) else None

    def read(self, row: frames.Vector, elapsed_us: int) -> Any:
        """Return a reading in motion (16,), `elapsed_us` [µs] after the obstacles started."""
        raise NotImplementedError


class SensorSuite:
    """IMU, compass, barometer and GPS, with one call per tick.

    Every sensor has a separate random stream, so its measurements do not depend on the rates of the
    others.
    """

    def __init__(
        self,
        profile: Sensors,
        rng: np.random.Generator,
        tick_s: float = constants.TICK_S,
        times: float = 1.0,
        record: Record | None = None,
    ) -> None:
        """Initialize the sensors in an aircraft's record; None = a new one.

        `times` is a factor of noise, biases and drifts; it does not affect the accuracy that the
        GPS receiver reports.
        """
        self._record = record = new_aircraft() if record is None else record
        self.record = new_sample()
        """Newest sample of the compiled sensors."""
        imu, gps, barometer = profile.imu, profile.gps, profile.barometer
        self._gps = gps
        self.spare: np.random.Generator
        """Random generator of the auxiliary sensor that draws always (`sensor_table`)."""
        # One stream per sensor, so that rates of one do not shift the noise of others.
        *self._streams, self.spare = rng.spawn(5)
        inertial = self._streams[0]
        # Random walk: steps grow with the square root of the tick.
        walk = math.sqrt(tick_s)
        # The profile gives the noise at the base tick; the noise density is constant.
        white = math.sqrt(constants.TICK_S / tick_s)
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
        self.noise = [np.zeros((0, width)) for width in _WIDTHS]
        """White noise of accelerometer and gyro, compass, barometer, GPS: blocks of rows."""

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

    def sample(self, time_us: int, row: frames.Vector, battery: BatterySample) -> SensorSample:
        """Return the sample at `time_us` [µs] in motion `row` (16,), see `engine.dynamics`."""
        record = self._record
        record["time_us"], record["motion"] = time_us, row
        self.measure()
        return self.newest(battery)

    def newest(self, battery: BatterySample) -> SensorSample:
        """Return the newest sample of the record."""
        fields = self.record[0]
        measured, gps = fields["measured"], self._gps
        fix = None
        if measured & GPS:
            fix = GpsFix(
                frames.local_to_geodetic(fields["gps_position"], frames.HOME),
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
