"""Corrections of per-decision percentiles: a slow decision also delays the next ones.

The loop is closed: the next decision begins after the last one ends. A stall of two seconds is one
sample of a thousand, although the vehicle flew blind for two seconds ("coordinated omission", Gil
Tene). Two corrections: Tene's for an expected interval, as in HdrHistogram's
`copyCorrectedForCoordinatedOmission`, and the age of the flown command, weighted by time.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from airl_mav.latency.percentiles import MIN_SAMPLES


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
