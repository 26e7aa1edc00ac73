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


def corrected(samples_us: ArrayLike, expected_us: int) -> NDArray[np.int64]:
    """Return latencies [µs] with added samples for decisions that a slow one delayed.

    Each latency longer than the interval is followed by copies, each shorter by one interval, down
    to one interval.
    """
    if expected_us <= 0:
        raise ValueError(f"expected_us={expected_us}: must be > 0")
    samples = np.asarray(samples_us, np.int64)
    # HdrHistogram adds v - i, v - 2i, ... while they are >= i.
    counts = np.maximum(samples // expected_us - 1, 0)
    owner = np.repeat(np.arange(samples.size), counts)
    first = np.repeat(np.cumsum(counts) - counts, counts)
    steps = np.arange(owner.size) - first + 1
    return np.concatenate([samples, samples[owner] - steps * expected_us])


@dataclass(frozen=True)
class CommandAges:
    """Age of the flown command over a flight, increasing with time between commands."""

    youngest_us: NDArray[np.int64]
    """(n,) age of each command at its effect [µs]."""
    oldest_us: NDArray[np.int64]
    """(n,) age of each command at its replacement [µs]."""

    @property
    def time_us(self) -> int:
        """Total time of all commands [µs]."""
        return int((self.oldest_us - self.youngest_us).sum())

    @property
    def mean(self) -> float | None:
        """Mean age at a random time [µs]; None without commands."""
        if not self.time_us:
            return None
        a, b = self.youngest_us.astype(np.float64), self.oldest_us.astype(np.float64)
        return float(((b * b - a * a) / 2.0).sum() / (b - a).sum())

    def percentile(self, p: float) -> float | None:
        """Return the age [µs] not exceeded for p % of the time; None: too few commands."""
        if self.youngest_us.size < MIN_SAMPLES[p] or not self.time_us:
            return None
        return self.quantile(p / 100.0)

    def quantile(self, share: float) -> float:
        """Return the age [µs] not exceeded for a share (0..1) of the time; requires commands.

        A command's age is uniform from its youngest to its oldest. The distribution is therefore a
        sum of ramps, and linear between two neighbouring ends.
        """
        ends = np.sort(np.concatenate([self.youngest_us, self.oldest_us]))
        # Number of commands active just above each end.
        active = np.searchsorted(np.sort(self.youngest_us), ends, "right") - np.searchsorted(
            np.sort(self.oldest_us), ends, "right"
        )
        time = np.concatenate([[0], np.cumsum(active[:-1] * np.diff(ends))])
        wanted = share * time[-1]
        # First of several ends at the same time: ages between them were never flown.
        k = int(np.searchsorted(time, wanted, "left"))
        if k == 0:
            return float(ends[np.flatnonzero(time == 0)[-1]])
        return float(ends[k - 1] + (wanted - time[k - 1]) / active[k - 1])


def command_ages(
    exposed_us: ArrayLike, flown_us: ArrayLike, flight: ArrayLike | None = None
) -> CommandAges:
    """Return the ages of the commands while they were flown.

    The last command of a flight is left out, because its end is unknown.
    """
    exposed, flown = np.asarray(exposed_us, np.int64), np.asarray(flown_us, np.int64)
    flights = np.zeros(exposed.size, np.int64) if flight is None else np.asarray(flight, np.int64)
    same = flights[1:] == flights[:-1]
    return CommandAges(
        youngest_us=(flown - exposed)[:-1][same], oldest_us=(flown[1:] - exposed[:-1])[same]
    )


def ages_in_closed_loop(latency_us: ArrayLike, hold_us: int) -> CommandAges:
    """Return the ages in a loop from ordered latencies [µs] and t3 alone.

    A command's age is `latency` at its effect, and `latency + hold + next latency` at its
    replacement.
    """
    latency = np.asarray(latency_us, np.int64)
    return CommandAges(latency[:-1], latency[:-1] + hold_us + latency[1:])
