"""Percentiles with a minimum sample size, and autocorrelation of samples."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

MIN_SAMPLES: Final = {50.0: 1, 90.0: 64, 95.0: 130, 99.0: 662, 99.9: 6636}
"""Minimum number of samples for a percentile p. If the true p-quantile lay above the printed bound,
at most one sample over the bound would have a 1 % chance. This is the early-stopping rule of MLPerf
LoadGen at 99 % confidence."""


@dataclass(frozen=True)
class Summary:
    """Summary of durations; times in µs, None with too few samples."""

    n: int
    mean: float | None
    p50: float | None
    p90: float | None
    p99: float | None
    p999: float | None
    max: float | None


def percentile(samples: ArrayLike, p: float) -> float | None:
    """Return the p-th percentile (nearest rank); None: too few samples."""
    values = np.asarray(samples)
    if values.size < MIN_SAMPLES[p]:
        return None
    return float(np.percentile(values, p, method="inverted_cdf"))


def summarize(samples: ArrayLike) -> Summary:
    """Summarise durations (n,) [µs]."""
    values = np.asarray(samples)
    return Summary(
        n=int(values.size),
        mean=float(values.mean()) if values.size else None,
        p50=percentile(values, 50.0),
        p90=percentile(values, 90.0),
        p99=percentile(values, 99.0),
        p999=percentile(values, 99.9),
        max=float(values.max()) if values.size else None,
    )


WINDOW = 5.0
"""Sokal's constant: lags are summed up to this many integrated times."""


def autocorrelation(samples: ArrayLike, lags: int) -> NDArray[np.float64]:
    """Return the autocorrelation of samples (n,) at lags 0 to `lags` (lags + 1,), each in -1..1.

    The biased estimate (every lag divided by n), whose sums stay finite. For constant samples: 1 at
    lag 0, then 0. Raises ValueError unless n > `lags`.
    """
    values = np.asarray(samples, np.float64)
    if not 0 <= lags < values.size:
        raise ValueError(f"lags={lags}: must be below the number of samples, {values.size}")
    centred = values - values.mean()
    power = float(centred @ centred)
    result = np.zeros(lags + 1)
    result[0] = 1.0
    if power > 0.0:
        for lag in range(1, lags + 1):
            result[lag] = float(centred[lag:] @ centred[:-lag]) / power
    return result


def integrated_time(samples: ArrayLike) -> float:
    """Return the integrated autocorrelation time [decisions], 1 for independent samples.

    1 + 2 (rho_1 + ... + rho_M), with Sokal's window: M is the minimum lag of at least 5 of these
    times (Sokal 1997, Monte Carlo methods in statistical mechanics, section 3). n >= 2 samples
    determine the mean as well as n / time independent ones.
    """
    values = np.asarray(samples, np.float64)
    most = values.size // 2
    times = 1.0 + 2.0 * np.cumsum(autocorrelation(values, most)[1:])
    wide = np.flatnonzero(np.arange(1, most + 1) >= WINDOW * times)
    return float(times[wide[0]] if wide.size else times[-1])
