"""What per-decision percentiles leave out: a slow decision also keeps the next ones from beginning.

The loop is closed: the next decision begins after the last one ends. A stall of two seconds is one
sample of a thousand, though the vehicle flew blind for two seconds ("coordinated omission", Gil
Tene). Two views put the time back: Tene's correction for an expected interval, as HdrHistogram's
`copyCorrectedForCoordinatedOmission` has it, and the age of the flown command, weighted by time.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from airl_mav.latency.percentiles import MIN_SAMPLES


def corrected(samples_us: ArrayLike, expected_us: int) -> NDArray[np.int64]:
    """Return latencies [µs] with those of the decisions that a slow one kept from beginning.

    Each longer than the interval is followed by copies of less and less, down to one interval.
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
    """How old the flown command was over a flight: it ages evenly from one command to the next."""

    youngest_us: NDArray[np.int64]
    """(n,) age of each command as it took effect [µs]."""
    oldest_us: NDArray[np.int64]
    """(n,) its age as the next one took over [µs]."""

    @property
    def time_us(self) -> int:
        """Time that all commands were flown [µs]."""
        return int((self.oldest_us - self.youngest_us).sum())

    @property
    def mean(self) -> float | None:
        """Mean age at a random moment [µs]; None when nothing was flown."""
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
        """Return the age [µs] not exceeded for a share (0..1) of the time; time must have passed.

        The ages of a command are uniform from its youngest to its oldest. So the distribution is a
        sum of ramps. Between two neighbouring ends it is a straight line.
        """
        ends = np.sort(np.concatenate([self.youngest_us, self.oldest_us]))
        # Commands that are being aged just above each end.
        active = np.searchsorted(np.sort(self.youngest_us), ends, "right") - np.searchsorted(
            np.sort(self.oldest_us), ends, "right"
        )
        time = np.concatenate([[0], np.cumsum(active[:-1] * np.diff(ends))])
        wanted = share * time[-1]
        # Of several ends at the same time the first: ages between them were never flown.
        k = int(np.searchsorted(time, wanted, "left"))
        if k == 0:
            return float(ends[np.flatnonzero(time == 0)[-1]])
        return float(ends[k - 1] + (wanted - time[k - 1]) / active[k - 1])


def command_ages(
    exposed_us: ArrayLike, flown_us: ArrayLike, flight: ArrayLike | None = None
) -> CommandAges:
    """Return how old the commands of flights were while they were flown.

    The last command of a flight is left out: nothing says how long it was flown.
    """
    exposed, flown = np.asarray(exposed_us, np.int64), np.asarray(flown_us, np.int64)
    flights = np.zeros(exposed.size, np.int64) if flight is None else np.asarray(flight, np.int64)
    same = flights[1:] == flights[:-1]
    return CommandAges(
        youngest_us=(flown - exposed)[:-1][same], oldest_us=(flown[1:] - exposed[:-1])[same]
    )


def ages_in_closed_loop(latency_us: ArrayLike, hold_us: int) -> CommandAges:
    """Return the ages in a loop of which only the latencies [µs], in their order, and t3 are known.

    A command is `latency` old as it takes effect, and `latency + hold + next latency` as the next
    one takes over.
    """
    latency = np.asarray(latency_us, np.int64)
    return CommandAges(latency[:-1], latency[:-1] + hold_us + latency[1:])
