"""Percentiles, printed only with enough samples behind them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

MIN_SAMPLES: Final = {50.0: 1, 90.0: 64, 95.0: 130, 99.0: 662, 99.9: 6636}
"""Fewest samples for a percentile p: so many that, if the true p-quantile lay above the bound that
we print, at most one sample over the bound would be a 1 % chance. It is the early-stopping rule of
MLPerf LoadGen at 99 % confidence."""


@dataclass(frozen=True)
class Summary:
    """What a set of durations looks like; times in µs, None where samples are too few."""

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
