"""Bootstrap intervals, and the quantiles of distributions: what scipy.stats has, without it.

That module takes a second to import, which is longer than it takes to work out all intervals of a
run; every command that shows a table would wait for it. The tests hold these against it.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import scipy
from numpy.typing import NDArray

Indices = NDArray[np.int64]
"""(m, k): m draws of k of the values, each by its index."""

Statistic = Callable[[Indices], NDArray[np.float64]]
"""Gives (m,): the figure of each draw."""


def bca_interval(
    statistic: Statistic, n: int, *, confidence: float, resamples: int, rng: np.random.Generator
) -> tuple[float, float]:
    """Return the ends of a bias-corrected and accelerated bootstrap interval.

    B. Efron and R. J. Tibshirani, An Introduction to the Bootstrap, 1993, sections 14.3 and 15.4
    (equation 15.36); draws and figures as of `scipy.stats.bootstrap(method="BCa")`. NaN where the
    values differ too little to tell the acceleration.

    Args:
        statistic: Works the figure out from values drawn.
        n: Number of values, >= 2.
        confidence: Of the interval, between 0 and 1.
        resamples: Number of draws.
        rng: What draws.
    """
    drawn = statistic(rng.integers(0, n, (resamples, n)))
    everything = np.arange(n)[None, :]
    (whole,) = statistic(everything)
    below = (np.count_nonzero(drawn < whole) + np.count_nonzero(drawn <= whole)) / (2 * resamples)
    bias = scipy.special.ndtri(below)
    # Each row leaves one value out.
    left_out = np.broadcast_to(everything, (n, n))[~np.eye(n, dtype=bool)].reshape(n, n - 1)
    without = statistic(left_out)
    influence = (n - 1) * (without.mean() - without)
    spread = float((influence**2).sum()) / n**2
    if spread == 0.0:
        return math.nan, math.nan
    acceleration = float((influence**3).sum()) / n**3 / (6.0 * spread**1.5)
    tail = scipy.special.ndtri(0.5 * (1.0 - confidence))
    shifted = bias + np.array([tail, -tail])
    levels = scipy.special.ndtr(bias + shifted / (1.0 - acceleration * shifted))
    if not np.isfinite(levels).all():
        return math.nan, math.nan
    low, high = np.quantile(drawn, levels)
    return float(low), float(high)


def binomial_quantile(level: float, n: int, probability: float) -> int:
    """Return the least number of successes in n trials that is not exceeded with a level, 0 to 1.

    As `scipy.stats.binom.ppf`.
    """
    above = math.ceil(scipy.special.bdtrik(level, n, probability))
    one_less = max(above - 1, 0)
    return one_less if scipy.special.bdtr(one_less, n, probability) >= level else above
