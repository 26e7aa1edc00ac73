"""Estimate with its 95 % interval, or the reason why it is not observable."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import bootstrap, t

Array = NDArray[np.float64]

LEVEL = 0.95
RESAMPLES = 999
BLOCK_S = 1.0
"""Length of resampled blocks: residuals closer in time may be correlated [s]."""

LEAST_BLOCKS = 4
"""Minimum number of blocks for an interval."""


@dataclass(frozen=True)
class FittedQuantity:
    """Fitted quantity."""

    key: str
    meaning: str
    unit: str
    value: float | None = None
    """Fitted value; None: not observable in this flight."""
    low: float | None = None
    high: float | None = None
    """Upper end of the 95 % interval; `low` is the lower end."""
    source: str = ""
    unobservable: str = ""
    """Reason why the quantity is unknown; "" if known."""
    profile: float | None = None
    """Value of the profile, in the same unit; None: missing."""

    @property
    def observed(self) -> bool:
        """True if the flight provides the quantity."""
        return self.value is not None

    @property
    def half_width(self) -> float | None:
        """Half the width of the interval."""
        if self.low is None or self.high is None:
            return None
        return 0.5 * (self.high - self.low)

    def found(self, ends: Iterable[float], source: str) -> FittedQuantity:
        """Return the quantity with value, low and high end of the interval, and their source."""
        value, low, high = map(float, ends)
        return replace(self, value=value, low=low, high=high, source=source)

    def without(self, why: str) -> FittedQuantity:
        """Return the quantity as not observable."""
        return replace(self, value=None, low=None, high=None, source="", unobservable=why)


def block_intervals(
    jacobian: Array, residuals: Array, times_s: Array, rng: np.random.Generator
) -> Array:
    """Return the offsets of 95 % intervals from a least-squares solution, lower and upper (2, k).

    Neighbouring residuals are correlated, so blocks of seconds are resampled. Each resample moves
    the solution by one Gauss-Newton step (one-step bootstrap). Student's t accounts for the few
    blocks. Unobservable parameters have infinite intervals.
    """
    block = np.unique(np.floor((times_s - times_s.min()) / BLOCK_S), return_inverse=True)[1]
    count = int(block.max()) + 1
    parameters = jacobian.shape[1]
    if count < LEAST_BLOCKS:
        return np.array([[-math.inf] * parameters, [math.inf] * parameters])
    slopes, squares = np.zeros((count, parameters)), np.zeros((count, parameters, parameters))
    np.add.at(slopes, block, jacobian * residuals[:, None])
    np.add.at(squares, block, jacobian[:, :, None] * jacobian[:, None, :])

    def moved(chosen: NDArray[np.int64]) -> Array:
        square = squares[chosen].sum(axis=0)
        return -np.asarray(np.linalg.lstsq(square, slopes[chosen].sum(axis=0), rcond=None)[0])

    return _widened(np.arange(count), moved, rng)


def mean_interval(values: Array, times_s: Array, rng: np.random.Generator) -> tuple[float, float]:
    """Return the 95 % interval of the mean of correlated samples (n,)."""
    ones = np.ones((len(values), 1))
    ends = block_intervals(-ones, values - values.mean(), times_s, rng)
    return float(values.mean() + ends[0, 0]), float(values.mean() + ends[1, 0])


def _widened(
    blocks: NDArray[np.int64],
    statistic: Callable[[NDArray[np.int64]], Array],
    rng: np.random.Generator,
) -> Array:
    """Return the bootstrap interval of a statistic of blocks, widened by Student's t."""
    found = bootstrap(
        (blocks,),
        statistic,
        vectorized=False,
        n_resamples=RESAMPLES,
        confidence_level=LEVEL,
        method="percentile",
        rng=rng,
    ).confidence_interval
    tail = 0.5 + 0.5 * LEVEL
    wider = t.ppf(tail, len(blocks) - 1) / t.ppf(tail, math.inf)
    return np.asarray([found.low, found.high]) * wider
