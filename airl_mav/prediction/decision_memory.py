"""Decisions of a companion: the setpoint in flight, and the expected latency of the next."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from airl_mav.core.constants import US_PER_S
from airl_mav.policy.observation import InFlight


class DecisionMemory:
    """Decisions of n companions."""

    def __init__(self, n: int) -> None:
        """Take the number of companions."""
        self.latency = ExpectedLatency(n)
        """Expected t2."""
        self.newest = np.zeros((n, 4))
        """(n, 4) newest setpoints, as `InFlight.setpoint`."""

    def begin(self, i: int) -> None:
        """Begin a flight of companion i, in a hover."""
        self.latency.begin(i)
        self.newest[i] = 0.0

    def decided(
        self, who: NDArray[np.intp], setpoint: NDArray[np.float64], t2_us: NDArray[np.int64]
    ) -> None:
        """Store the setpoints (k, 4) that the companions in `who` (k,) sent, and their t2 [µs]."""
        self.latency.measure(who, t2_us)
        self.newest[who] = setpoint

    def in_flight(self, age_us: NDArray[np.int64]) -> InFlight:
        """Return the inputs for policies; `age_us` (n,) is the age of the images."""
        return InFlight(
            self.latency.expected_us() / US_PER_S,
            age_us / US_PER_S,
            self.newest,
        )

    def held(self) -> Mapping[str, Any]:
        """Return all mutable arrays by name, for checkpoints."""
        return {
            "newest": self.newest,
            "measured_us": self.latency.measured_us,
            "measured": self.latency.count,
        }


REMEMBERED = 32
"""Number of recent decisions that count."""


class ExpectedLatency:
    """Expected t2 of n companions: the mean of each companion's recent measurements.

    Zero before the first decision, when the vehicle hovers and latency has no effect. The mean
    flies better than a high quantile (docs/results.md), because the predicted position is then
    correct on average.
    """

    def __init__(self, n: int) -> None:
        """Take the number of companions."""
        self.measured_us = np.zeros((n, REMEMBERED), np.int64)
        """(n, 32) newest t2 [µs], in a ring."""
        self.count = np.zeros(n, np.int64)
        """(n,) decisions measured."""

    def begin(self, i: int) -> None:
        """Reset the measurements of companion i."""
        self.count[i] = 0

    def measure(self, who: NDArray[np.intp], t2_us: NDArray[np.int64]) -> None:
        """Store the decision times [µs] (k,) of the companions in `who` (k,)."""
        self.measured_us[who, self.count[who] % REMEMBERED] = t2_us
        self.count[who] += 1

    def expected_us(self) -> NDArray[np.int64]:
        """Return the expected t2 (n,) [µs] of each next decision."""
        known = np.minimum(self.count, REMEMBERED)
        # Before the ring is full, only measured entries count.
        counted = np.arange(REMEMBERED) < known[:, None]
        total = np.where(counted, self.measured_us, 0).sum(axis=1)
        mean: NDArray[np.int64] = total // np.maximum(known, 1)
        return mean
