"""How long the next decision will take: what those before it took."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

REMEMBERED = 32
"""So many of the newest decisions count."""


class ExpectedLatency:
    """The expected t2 of n companions: the mean of the newest that each has measured.

    Before the first decision nothing is expected. The vehicle hovers then, and a still vehicle is
    where it was, however late. The mean flies better than a high quantile (docs/results.md): the
    vehicle is on average where it was thought to be.
    """

    def __init__(self, n: int) -> None:
        """Take the number of companions."""
        self.measured_us = np.zeros((n, REMEMBERED), np.int64)
        """(n, 32) newest t2 [µs], in a ring."""
        self.count = np.zeros(n, np.int64)
        """(n,) decisions measured."""

    def begin(self, i: int) -> None:
        """Forget what companion i has measured."""
        self.count[i] = 0

    def measure(self, who: NDArray[np.intp], t2_us: NDArray[np.int64]) -> None:
        """Take what a decision of each companion in `who` (k,) took [µs] (k,)."""
        self.measured_us[who, self.count[who] % REMEMBERED] = t2_us
        self.count[who] += 1

    def expected_us(self) -> NDArray[np.int64]:
        """Return t2 (n,) [µs] that is expected of the next decision of each."""
        known = np.minimum(self.count, REMEMBERED)
        counted = np.arange(REMEMBERED) < known[:, None]
        total = np.where(counted, self.measured_us, 0).sum(axis=1)
        mean: NDArray[np.int64] = total // np.maximum(known, 1)
        return mean
