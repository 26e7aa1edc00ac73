"""The rangefinder: one ray straight down in body axes, with noise and limits."""

from __future__ import annotations

import numpy as np

from airl_mav.arena.geometry import Arena
from airl_mav.core.frames import Vector
from airl_mav.profiles.sensors import Rangefinder
from firmware_sim.engine.kinematics import POSITION, QUATERNION
from firmware_sim.interfaces import DistanceReading
from firmware_sim.plant.downward_ray import DownwardRay
from firmware_sim.plant.sensors import Rate, White

VALID, INVALID = 100, 0
"""Quality of a range within the limits, and of any other [%]."""


class PlantRangefinder:
    """Measures the distance to what lies below."""

    def __init__(
        self, profile: Rangefinder, arena: Arena | None, rng: np.random.Generator, times: float
    ) -> None:
        """Switch it on.

        Args:
            profile: What it is.
            arena: Where; None = an endless floor.
            rng: Of its noise, and of nothing else.
            times: Factor of its noise; the variance that it reports stays.
        """
        self.rate = Rate(profile.rate_hz)
        self._profile = profile
        self._sigma = times * profile.noise_m
        self._white = White(rng, 1)
        place = (profile.forward_m, profile.right_m, profile.down_m)
        self.ray = DownwardRay(place, profile.greatest_m, arena)
        """What it measures along."""

    def read(self, row: Vector, elapsed_us: int) -> DistanceReading:
        """Return what is measured in a motion (16,), so long after obstacles set out [µs]."""
        profile = self._profile
        true = self.ray.length_m(row[POSITION], row[QUATERNION], elapsed_us)
        white = self._white.draw().item()
        least, greatest = profile.least_m, profile.greatest_m
        # Nothing comes back: such sensors tell their end of the scale, as invalid.
        told = greatest if true is None else max(0.0, true + self._sigma * white)
        good = true is not None and least <= told <= greatest
        return DistanceReading(
            told, least, greatest, profile.noise_m**2, VALID if good else INVALID
        )
