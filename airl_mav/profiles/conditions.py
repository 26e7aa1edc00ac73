"""What an aircraft flies with and in: its load, its spread, its sensors' noise, the wind.

Tables of scenarios; those of training environments are the same.
"""

from __future__ import annotations

from airl_mav.core.fields import ProfileModel, quantity


class WindSettings(ProfileModel):
    """Steady wind and gusts; calm by default."""

    north_m_s: float = quantity("steady wind towards north", "m/s", ge=-50, le=50, default=0.0)
    east_m_s: float = quantity("steady wind towards east", "m/s", ge=-50, le=50, default=0.0)
    random_m_s: float = quantity(
        "steady wind on top, of any direction and of a speed from 0 to this, drawn with every"
        " episode",
        "m/s",
        ge=0,
        le=50,
        default=0.0,
    )
    gust_m_s: float = quantity(
        "standard deviation of the gusts on each horizontal axis; half of it on the vertical",
        "m/s",
        ge=0,
        le=50,
        default=0.0,
    )
    gust_time_s: float = quantity(
        "correlation time of the gusts", "s", ge=0.01, le=1000, default=2.0
    )


class Payload(ProfileModel):
    """A point of mass, placed from the middle of the rotors; none by default."""

    mass_g: float = quantity("mass of the payload", "g", ge=0, le=100_000, default=0.0)
    forward_m: float = quantity("ahead of the middle", "m", ge=-2, le=2, default=0.0)
    right_m: float = quantity("to the right of the middle", "m", ge=-2, le=2, default=0.0)
    down_m: float = quantity("below the middle", "m", ge=-2, le=2, default=0.0)


class Spread(ProfileModel):
    """How far an aircraft may be from its profile, drawn with every episode; 0 is not at all.

    The flight controller goes on counting on the profile.
    """

    mass: float = quantity("mass and inertia, +- this share", "1", ge=0, le=0.9, default=0.0)
    thrust: float = quantity("greatest thrust, +- this share", "1", ge=0, le=0.9, default=0.0)
    drag: float = quantity("drag, +- this share", "1", ge=0, le=0.9, default=0.0)
    rotor_lag: float = quantity(
        "rotor time constant, +- this share", "1", ge=0, le=0.9, default=0.0
    )


class SensorNoise(ProfileModel):
    """Sensors that are worse than the profile's, or better."""

    navigation_noise: float = quantity(
        "noise, bias and drift of IMU, GPS, barometer and magnetometer, times this; where the"
        " estimator is a model of its error, that error. The estimator is not told",
        "1",
        ge=0,
        le=10,
        default=1.0,
    )
    depth_noise: float = quantity(
        "sd of the depth noise at 10 m, as a share; grows with the square of the depth as of a"
        " stereo camera",
        "1",
        ge=0,
        le=0.9,
        default=0.0,
    )
    stereo_noise: float = quantity(
        "disparity noise of a stereo camera (table `camera.stereo` of the vehicle's profile), times"
        " this; 0: an ideal camera, without its holes and steps, too",
        "1",
        ge=0,
        le=10,
        default=1.0,
    )
    depth_dropout: float = quantity(
        "share of pixels without a return, drawn anew each frame", "1", ge=0, le=0.9, default=0.0
    )
