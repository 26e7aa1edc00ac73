"""Sensors of a vehicle profile except the camera: inertial, magnetic, pressure, GPS, and more."""

from __future__ import annotations

from pydantic import Field, model_validator
from typing_extensions import Self

from airl_mav.core.fields import ProfileModel, later_field, optional, quantity


class Imu(ProfileModel):
    """Accelerometer and gyroscope: white noise, bias at start, bias random walk."""

    accel_noise_m_s2: float = quantity("white noise, sd of a sample", "m/s²", ge=0, le=10)
    accel_bias_m_s2: float = quantity("start bias, sd", "m/s²", ge=0, le=2)
    accel_walk_m_s2_sqrt_s: float = quantity("bias random walk", "m/s²/sqrt(s)", ge=0, le=0.1)
    gyro_noise_rad_s: float = quantity("white noise, sd of a sample", "rad/s", ge=0, le=1)
    gyro_bias_rad_s: float = quantity("start bias, sd", "rad/s", ge=0, le=0.2)
    gyro_walk_rad_s_sqrt_s: float = quantity("bias random walk", "rad/s/sqrt(s)", ge=0, le=0.01)


class Magnetometer(ProfileModel):
    """Three-axis magnetometer, calibrated."""

    rate_hz: float = quantity("sample rate", "Hz", ge=1, le=250)
    noise_gauss: float = quantity("white noise, sd of a sample", "gauss", ge=0, le=0.1)


class Barometer(ProfileModel):
    """Static pressure sensor."""

    rate_hz: float = quantity("sample rate", "Hz", ge=1, le=250)
    noise_pa: float = quantity("white noise, sd of a sample", "Pa", ge=0, le=100)
    drift_pa_sqrt_s: float = quantity("drift random walk", "Pa/sqrt(s)", ge=0, le=10)


class Gps(ProfileModel):
    """GPS receiver."""

    fitted: bool = Field(default=True, description="whether the vehicle has one")
    rate_hz: float = quantity("fixes a second", "Hz", ge=1, le=25)
    horizontal_noise_m: float = quantity("white noise, sd", "m", ge=0, le=10)
    vertical_noise_m: float = quantity("white noise, sd", "m", ge=0, le=20)
    velocity_noise_m_s: float = quantity("white noise, sd per axis", "m/s", ge=0, le=2)
    drift_m_sqrt_s: float = quantity("position drift random walk", "m/sqrt(s)", ge=0, le=1)
    drift_time_constant_s: float = quantity("the drift decays with", "s", gt=1, le=10_000)


class Vision(ProfileModel):
    """Visual-inertial odometry, or a motion capture system: the pose in a local frame.

    The frame is the vehicle's at the start. Drift accumulates with distance and with time. There is
    no loop closure.
    """

    rate_hz: float = quantity("poses a second", "Hz", ge=5, le=250)
    delay_s: float = quantity("from a pose until it is told", "s", ge=0, le=0.3)
    position_noise_m: float = quantity("white noise, sd per axis", "m", ge=0, le=1)
    velocity_noise_m_s: float = quantity("white noise, sd per axis", "m/s", ge=0, le=2)
    angle_noise_rad: float = quantity("white noise, sd per axis", "rad", ge=0, le=0.5)
    position_drift_m_sqrt_m: float = quantity(
        "position drift random walk, by the way flown, sd per axis", "m/sqrt(m)", ge=0, le=1
    )
    yaw_drift_rad_sqrt_s: float = quantity("heading drift random walk", "rad/sqrt(s)", ge=0, le=0.1)


class Rangefinder(ProfileModel):
    """A distance sensor that looks straight down in body axes: one ray.

    Ranges outside the limits, and missing returns, are reported as invalid (a quality of 0).
    """

    rate_hz: float = quantity("ranges a second", "Hz", ge=1, le=100)
    least_m: float = quantity("least range that it measures", "m", ge=0, le=5)
    greatest_m: float = quantity("greatest range that it measures", "m", gt=0.1, le=300)
    noise_m: float = quantity("white noise, sd", "m", ge=0, le=1)
    forward_m: float = quantity("its place ahead of the centre", "m", default=0.0, ge=-2, le=2)
    right_m: float = quantity("its place to the right of the centre", "m", default=0.0, ge=-2, le=2)
    down_m: float = quantity("its place below the centre", "m", default=0.0, ge=-2, le=2)

    @model_validator(mode="after")
    def _measures(self) -> Self:
        if self.greatest_m <= self.least_m:
            raise ValueError(
                f"greatest_m = {self.greatest_m:g}: accepted: more than least_m = {self.least_m:g}"
            )
        return self


class OpticalFlow(ProfileModel):
    """A camera that looks straight down in body axes and reports the optical flow of the ground.

    Outside its limits, and without ground below, it reports a quality of 0. It has no gyro: the
    flight controller uses its own gyro.
    """

    rate_hz: float = quantity("measurements a second", "Hz", ge=5, le=125)
    least_m: float = quantity("least distance of the ground that it sees sharply", "m", ge=0, le=5)
    greatest_m: float = quantity("greatest distance at which it sees texture", "m", gt=0.1, le=300)
    greatest_rad_s: float = quantity("fastest flow that it measures", "rad/s", ge=0.1, le=100)
    noise_rad_s: float = quantity("white noise of each axis, sd", "rad/s", ge=0, le=10)
    forward_m: float = quantity("its place ahead of the centre", "m", default=0.0, ge=-2, le=2)
    right_m: float = quantity("its place to the right of the centre", "m", default=0.0, ge=-2, le=2)
    down_m: float = quantity("its place below the centre", "m", default=0.0, ge=-2, le=2)

    @model_validator(mode="after")
    def _sees(self) -> Self:
        if self.greatest_m <= self.least_m:
            raise ValueError(
                f"greatest_m = {self.greatest_m:g}: accepted: more than least_m = {self.least_m:g}"
            )
        return self


class Sensors(ProfileModel):
    """The sensor suite."""

    imu: Imu
    magnetometer: Magnetometer
    barometer: Barometer
    gps: Gps
    vision: Vision | None = optional(
        "what tells the flight controller its pose; absent = nothing does"
    )
    rangefinder: Rangefinder | None = optional(
        "what measures how far the ground is; absent = nothing does"
    )
    optical_flow: OpticalFlow | None = later_field(
        None, "what measures how the ground moves below; absent = nothing does"
    )
