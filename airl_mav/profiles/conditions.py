"""Flight conditions: wind, payload, domain randomization and sensor noise.

The tables are used by scenarios and training environments.
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
    """A point mass relative to the middle of the rotors; none by default."""

    mass_g: float = quantity("mass of the payload", "g", ge=0, le=100_000, default=0.0)
    forward_m: float = quantity("ahead of the middle", "m", ge=-2, le=2, default=0.0)
    right_m: float = quantity("to the right of the middle", "m", ge=-2, le=2, default=0.0)
    down_m: float = quantity("below the middle", "m", ge=-2, le=2, default=0.0)


class Spread(ProfileModel):
    """Domain randomization of the aircraft, drawn for every episode; 0 = as in the profile.

    The flight controller still assumes the profile's values.
    """

    mass: float = quantity("mass and inertia, +- this share", "1", ge=0, le=0.9, default=0.0)
    thrust: float = quantity("greatest thrust, +- this share", "1", ge=0, le=0.9, default=0.0)
    drag: float = quantity("drag, +- this share", "1", ge=0, le=0.9, default=0.0)
    rotor_lag: float = quantity(
        "rotor time constant, +- this share", "1", ge=0, le=0.9, default=0.0
    )


class SensorNoise(ProfileModel):
    """Scale of sensor noise relative to the profile."""

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
