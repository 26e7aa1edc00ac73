"""Wind: a steady part and gusts, off by default."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from airl_mav.constants import TICK_S
from airl_mav.frames import Vector


@dataclass(frozen=True)
class WindSettings:
    """What blows."""

    north_m_s: float = 0.0
    """Steady wind towards the north [m/s]."""
    east_m_s: float = 0.0
    """Steady wind towards the east [m/s]."""
    gust_m_s: float = 0.0
    """Standard deviation of the gusts on each horizontal axis; half of it on the vertical [m/s]."""
    gust_time_s: float = 2.0
    """Correlation time of the gusts [s]."""


class Wind:
    """Steady wind plus first-order Gauss-Markov gusts (the first-order form of Dryden's model)."""

    def __init__(self, settings: WindSettings, rng: np.random.Generator) -> None:
        self._steady = np.array([settings.north_m_s, settings.east_m_s, 0.0])
        self._sigma = settings.gust_m_s * np.array([1.0, 1.0, 0.5])
        self._keep = math.exp(-TICK_S / settings.gust_time_s)
        self._calm = settings.gust_m_s == 0.0
        self._rng = rng
        self._gust = np.zeros(3) if self._calm else self._sigma * rng.standard_normal(3)

    def step(self) -> Vector:
        """Advance one tick and return the wind (3,) NED [m/s]."""
        if self._calm:
            return self._steady
        drive = math.sqrt(1.0 - self._keep**2) * self._sigma
        self._gust = self._keep * self._gust + drive * self._rng.standard_normal(3)
        return self._steady + self._gust
