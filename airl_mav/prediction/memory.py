"""What a companion knows of its own decisions: the setpoint in flight, how long they take."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from airl_mav.core.constants import US_PER_S
from airl_mav.policy.observation import InFlight
from airl_mav.prediction.lateness import ExpectedLatency


class DecisionMemory:
    """The decisions of n companions."""

    def __init__(self, n: int) -> None:
        """Take the number of companions."""
        self.latency = ExpectedLatency(n)
        """What t2 to expect."""
        self.newest = np.zeros((n, 4))
        """(n, 4) newest setpoints, as `InFlight.setpoint`."""

    def begin(self, i: int) -> None:
        """Begin a flight of companion i, in a hover."""
        self.latency.begin(i)
        self.newest[i] = 0.0

    def decided(
        self, who: NDArray[np.intp], setpoint: NDArray[np.float64], t2_us: NDArray[np.int64]
    ) -> None:
        """Take the setpoints (k, 4) that the companions in `who` (k,) sent, and their t2 [µs]."""
        self.latency.measure(who, t2_us)
        self.newest[who] = setpoint

    def in_flight(self, age_us: NDArray[np.int64]) -> InFlight:
        """Return what policies may be told; `age_us` (n,) is how old the images are."""
        return InFlight(
            self.latency.expected_us() / US_PER_S,
            age_us / US_PER_S,
            self.newest,
        )

    def held(self) -> Mapping[str, Any]:
        """Return by name all arrays that change, for checkpoints."""
        return {
            "newest": self.newest,
            "measured_us": self.latency.measured_us,
            "measured": self.latency.count,
        }
