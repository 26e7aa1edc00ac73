"""Electrical power of the airframe: the paper's nine-coefficient model, SI units."""

from __future__ import annotations

import math

from airl_mav.core.kernels import kernel
from airl_mav.profiles.vehicle import Power
from airl_mav.vehicle.rotation import Vec

Coefficients = tuple[float, float, float, float, float, float, float, float, float]


def coefficients(power: Power) -> Coefficients:
    """Return b1..b9 of a vehicle profile."""
    return (
        power.b1_vxy,
        power.b2_axy,
        power.b3_vxy_axy,
        power.b4_vz,
        power.b5_az,
        power.b6_vz_az,
        power.b7_payload,
        power.b8_wind,
        power.b9_hover,
    )


@kernel
def power_w(
    velocity: Vec, acceleration: Vec, wind: Vec, payload_g: float, b: Coefficients
) -> float:
    """Return the power [W] in flight, never below 0.

    P = b1 |vxy| + b2 |axy| + b3 |vxy||axy| + b4 |vz| + b5 |az| + b6 |vz||az| + b7 m
    + b8 vxy.w + b9 (Krishnan et al. 2021, eq. 1, after Tseng et al., arXiv 1703.10049).

    Args:
        velocity: NED [m/s].
        acceleration: NED, gravity removed [m/s²].
        wind: NED [m/s].
        payload_g: Payload [g].
        b: b1..b9.
    """
    vxy = math.sqrt(velocity[0] * velocity[0] + velocity[1] * velocity[1])
    axy = math.sqrt(acceleration[0] * acceleration[0] + acceleration[1] * acceleration[1])
    vz = abs(velocity[2])
    az = abs(acceleration[2])
    tail = velocity[0] * wind[0] + velocity[1] * wind[1]
    p = b[0] * vxy + b[1] * axy + b[2] * vxy * axy + b[3] * vz + b[4] * az + b[5] * vz * az
    return max(0.0, p + b[6] * payload_g + b[7] * tail + b[8])
