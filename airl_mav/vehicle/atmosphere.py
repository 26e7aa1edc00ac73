"""Air: International Standard Atmosphere below 11 km (ISO 2533), and wind, off by default."""

from __future__ import annotations

import math

import numpy as np

from airl_mav.core import constants
from airl_mav.core.frames import Vector
from airl_mav.core.kernels import kernel
from airl_mav.core.streams import Stream, stream
from airl_mav.profiles.vehicle import WindSettings

_EXPONENT = constants.GRAVITY_M_S2 / (constants.GAS_CONSTANT_AIR * constants.TEMPERATURE_LAPSE_K_M)


def pressure_hpa(altitude_m: float) -> float:
    """Return the static pressure [hPa] at an altitude above mean sea level [m]."""
    ratio = 1.0 - constants.TEMPERATURE_LAPSE_K_M * altitude_m / constants.SEA_LEVEL_TEMPERATURE_K
    return float(constants.SEA_LEVEL_PRESSURE_HPA * ratio**_EXPONENT)


def altitude_m(pressure: float) -> float:
    """Return the altitude above mean sea level [m] of a static pressure [hPa]."""
    ratio = (pressure / constants.SEA_LEVEL_PRESSURE_HPA) ** (1.0 / _EXPONENT)
    return float(
        (1.0 - ratio) * constants.SEA_LEVEL_TEMPERATURE_K / constants.TEMPERATURE_LAPSE_K_M
    )


def temperature_c(altitude: float) -> float:
    """Return the air temperature [°C] at an altitude above mean sea level [m]."""
    return (
        constants.SEA_LEVEL_TEMPERATURE_K
        - constants.TEMPERATURE_LAPSE_K_M * altitude
        - constants.ZERO_CELSIUS_K
    )


BLOCK = 256
"""Number of ticks per block of gust samples; has no effect on values."""


def wind_of_episode(settings: WindSettings, seed: int) -> WindSettings:
    """Return the wind of a seed's episode: the random part becomes steady."""
    if settings.random_m_s == 0.0:
        return settings
    # Uniform direction and speed become part of the steady wind.
    rng = stream(seed, Stream.WIND)
    towards, speed = rng.uniform(-math.pi, math.pi), rng.uniform(0.0, settings.random_m_s)
    drawn = {
        "north_m_s": settings.north_m_s + speed * math.cos(towards),
        "east_m_s": settings.east_m_s + speed * math.sin(towards),
        "random_m_s": 0.0,
    }
    return settings.model_copy(update=drawn)


@kernel
def _blow(noise: Vector, gust: Vector, keep: float, drive: Vector, steady: Vector) -> None:
    """Convert white noise (n, 3) in place into wind NED [m/s]; the gust (3,) continues."""
    for i in range(len(noise)):
        for axis in range(3):
            gust[axis] = keep * gust[axis] + drive[axis] * noise[i, axis]
            noise[i, axis] = steady[axis] + gust[axis]


class Wind:
    """Steady wind plus first-order Gauss-Markov gusts (the first-order form of Dryden's model)."""

    def __init__(
        self, settings: WindSettings, rng: np.random.Generator, tick_s: float = constants.TICK_S
    ) -> None:
        """Begin an episode with settings from `wind_of_episode`; `rng` draws the gusts."""
        self.steady = np.array([settings.north_m_s, settings.east_m_s, 0.0])
        """(3,) NED [m/s]."""
        # Vertical gusts are half as strong.
        sigma = settings.gust_m_s * np.array([1.0, 1.0, 0.5])
        self._keep = math.exp(-tick_s / settings.gust_time_s)
        # The drive keeps the variance of the gusts constant.
        self._drive = math.sqrt(1.0 - self._keep**2) * sigma
        self._calm = settings.gust_m_s == 0.0
        self._rng = rng
        # The gusts start in their stationary distribution.
        self._gust = np.zeros(3) if self._calm else sigma * rng.standard_normal(3)
        self._ahead = np.zeros((0, 3))
        self._next = 0

    def ahead(self) -> Vector:
        """Return the wind NED [m/s] of the next ticks (BLOCK, 3); without gusts one row for all."""
        if self._calm:
            return self.steady[None]
        block = self._rng.standard_normal((BLOCK, 3))
        _blow(block, self._gust, self._keep, self._drive, self.steady)
        return block

    def step(self) -> Vector:
        """Advance one tick and return the wind (3,) NED [m/s]; do not modify the result."""
        if self._calm:
            return self.steady
        if self._next == len(self._ahead):
            self._ahead, self._next = self.ahead(), 0
        wind: Vector = self._ahead[self._next]
        self._next += 1
        return wind
