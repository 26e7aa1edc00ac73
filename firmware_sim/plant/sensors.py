"""Sensors: truth -> what the autopilot gets, each with its own noise, bias and rate."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from airl_mav.atmosphere import pressure_hpa, temperature_c
from airl_mav.constants import TICK_S, US_PER_S
from airl_mav.frames import Vector, local_to_geodetic, quat_to_matrix
from airl_mav.location import HOME, MAGNETIC_FIELD_NED
from airl_mav.profiles.vehicle import Gps, Sensors
from firmware_sim.interfaces import BatterySample, GpsFix, SensorSample

PA_PER_HPA = 100.0
GPS_SATELLITES = 12


@dataclass(frozen=True, slots=True)
class Kinematics:
    """What the sensors feel."""

    position: Vector  # (3,) NED [m]
    velocity: Vector  # (3,) NED [m/s]
    specific_force: Vector  # (3,) FRD [m/s²]
    angular_velocity: Vector  # (3,) FRD [rad/s]
    quaternion: Vector  # (4,) body -> NED


class Rate:
    """Says when a sensor slower than the tick is due, without drift."""

    def __init__(self, rate_hz: float) -> None:
        self._rate_hz = rate_hz
        self._next = 0

    def due(self, time_us: int) -> bool:
        """Return True once for every period that has passed."""
        if time_us < self._start_us(self._next):
            return False
        period = int(time_us * self._rate_hz / US_PER_S)
        # Rounding may put a time that lies on a boundary into the period before it.
        if self._start_us(period + 1) <= time_us:
            period += 1
        self._next = period + 1
        return True

    def _start_us(self, period: int) -> float:
        return period * US_PER_S / self._rate_hz


class _GpsDrift:
    """Slowly wandering position error: Gauss-Markov, one per axis."""

    def __init__(self, gps: Gps, rng: np.random.Generator) -> None:
        self._keep = math.exp(-1.0 / (gps.rate_hz * gps.drift_time_constant_s))
        sigma = gps.drift_m_sqrt_s * math.sqrt(0.5 * gps.drift_time_constant_s)
        self._drive = sigma * math.sqrt(1.0 - self._keep**2)
        self._rng = rng
        self._error = np.zeros(3)

    def step(self) -> Vector:
        """Advance one fix and return the error (3,) NED [m]."""
        self._error = self._keep * self._error + self._drive * self._rng.standard_normal(3)
        return self._error


class SensorSuite:
    """All sensors of the vehicle; one call a tick."""

    def __init__(self, profile: Sensors, rng: np.random.Generator) -> None:
        imu = profile.imu
        self._profile = profile
        self._rng = rng
        self._accel_bias = imu.accel_bias_m_s2 * rng.standard_normal(3)
        self._gyro_bias = imu.gyro_bias_rad_s * rng.standard_normal(3)
        self._baro_drift_pa = 0.0
        self._gps_drift = _GpsDrift(profile.gps, rng)
        self._mag_rate = Rate(profile.magnetometer.rate_hz)
        self._baro_rate = Rate(profile.barometer.rate_hz)
        self._gps_rate = Rate(profile.gps.rate_hz)
        walk = math.sqrt(TICK_S)
        self._sigmas = np.concatenate(
            [
                np.full(3, imu.accel_noise_m_s2),
                np.full(3, imu.gyro_noise_rad_s),
                np.full(3, imu.accel_walk_m_s2_sqrt_s * walk),
                np.full(3, imu.gyro_walk_rad_s_sqrt_s * walk),
            ]
        )

    def sample(self, time_us: int, truth: Kinematics, battery: BatterySample) -> SensorSample:
        """Return what is measured at `time_us` [µs]."""
        noise = self._sigmas * self._rng.standard_normal(12)
        self._accel_bias = self._accel_bias + noise[6:9]
        self._gyro_bias = self._gyro_bias + noise[9:12]
        altitude = HOME.altitude_m - float(truth.position[2])
        return SensorSample(
            time_us=time_us,
            accel=truth.specific_force + self._accel_bias + noise[0:3],
            gyro=truth.angular_velocity + self._gyro_bias + noise[3:6],
            temperature_c=temperature_c(altitude),
            battery=battery,
            mag=self._mag(truth) if self._mag_rate.due(time_us) else None,
            pressure_hpa=self._pressure(altitude) if self._baro_rate.due(time_us) else None,
            gps=self._gps(truth) if self._gps_rate.due(time_us) else None,
        )

    def _mag(self, truth: Kinematics) -> Vector:
        field = quat_to_matrix(truth.quaternion).T @ MAGNETIC_FIELD_NED
        noise: Vector = self._profile.magnetometer.noise_gauss * self._rng.standard_normal(3)
        return field + noise

    def _pressure(self, altitude: float) -> float:
        baro = self._profile.barometer
        step = baro.drift_pa_sqrt_s / math.sqrt(baro.rate_hz)
        self._baro_drift_pa += step * self._rng.standard_normal()
        noise = baro.noise_pa * self._rng.standard_normal()
        return pressure_hpa(altitude) + (self._baro_drift_pa + noise) / PA_PER_HPA

    def _gps(self, truth: Kinematics) -> GpsFix:
        gps = self._profile.gps
        sigma = np.array([gps.horizontal_noise_m, gps.horizontal_noise_m, gps.vertical_noise_m])
        position = truth.position + self._gps_drift.step() + sigma * self._rng.standard_normal(3)
        velocity = truth.velocity + gps.velocity_noise_m_s * self._rng.standard_normal(3)
        return GpsFix(
            position=local_to_geodetic(position, HOME),
            velocity_ned=velocity,
            eph_m=gps.horizontal_noise_m,
            epv_m=gps.vertical_noise_m,
            satellites=GPS_SATELLITES,
        )
