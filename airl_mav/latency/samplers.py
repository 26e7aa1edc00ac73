"""Draw decision latencies to inject, so that one computer flies as another."""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from airl_mav.constants import US_PER_MS
from airl_mav.profiles.computer import Latency


class LatencySampler(Protocol):
    """A source of latencies."""

    def sample_us(self) -> int:
        """Return the next latency [µs], >= 0."""
        ...


class FixedSampler:
    """Always the same latency."""

    def __init__(self, latency_us: int) -> None:
        """Take the latency [µs], >= 0."""
        if latency_us < 0:
            raise ValueError(f"latency_us={latency_us}: must be >= 0")
        self._latency_us = latency_us

    def sample_us(self) -> int:
        """Return the latency [µs]."""
        return self._latency_us


class LognormalSampler:
    """A least latency plus a log-normal; mean and standard deviation are those of the sum."""

    def __init__(
        self, mean_us: float, std_us: float, min_us: float, rng: np.random.Generator
    ) -> None:
        """Take the moments [µs]: 0 <= min_us < mean_us, std_us > 0."""
        # Moments of a log-normal: mean = exp(mu + s²/2), variance = (exp(s²) - 1) mean².
        over = mean_us - min_us
        variance = math.log1p((std_us / over) ** 2)
        self._mu = math.log(over) - 0.5 * variance
        self._sigma = math.sqrt(variance)
        self._min_us = min_us
        self._rng = rng

    def sample_us(self) -> int:
        """Return the next latency [µs]."""
        return round(self._min_us + self._rng.lognormal(self._mu, self._sigma))


class TruncatedNormalSampler:
    """A normal, drawn again while it falls below the least latency."""

    def __init__(
        self, mean_us: float, std_us: float, min_us: float, rng: np.random.Generator
    ) -> None:
        """Take the moments of the uncut normal [µs]; min_us < mean_us, so most draws stand."""
        self._mean_us, self._std_us, self._min_us = mean_us, std_us, min_us
        self._rng = rng

    def sample_us(self) -> int:
        """Return the next latency [µs]."""
        while (latency_us := self._rng.normal(self._mean_us, self._std_us)) < self._min_us:
            pass
        return round(latency_us)


class EmpiricalSampler:
    """Measured latencies, drawn independently with replacement."""

    def __init__(self, samples_us: ArrayLike, rng: np.random.Generator) -> None:
        """Take the measured latencies (n,) [µs], n >= 1."""
        self._samples_us: NDArray[np.int64] = np.asarray(samples_us, np.int64)
        if not self._samples_us.size:
            raise ValueError("no samples to draw from")
        self._rng = rng

    def sample_us(self) -> int:
        """Return the next latency [µs]."""
        return int(self._samples_us[self._rng.integers(len(self._samples_us))])


def build_sampler(latency: Latency, rng: np.random.Generator) -> LatencySampler:
    """Build the sampler of a workload's latency.

    Args:
        latency: As `load_computer` returns it: with its sample file read in.
        rng: Source of all draws; the same seed gives the same latencies.

    Raises:
        ValueError: The latency still names a sample file that nobody read.
    """
    if latency.distribution == "samples":
        if latency.samples_ms is None:
            raise ValueError(f"samples_file {latency.samples_file} not read: use load_computer")
        return EmpiricalSampler(np.rint(np.array(latency.samples_ms) * US_PER_MS), rng)
    mean_us = (latency.mean_ms or 0.0) * US_PER_MS
    std_us = (latency.std_ms or 0.0) * US_PER_MS
    if not std_us:
        return FixedSampler(round(mean_us))
    if latency.distribution == "lognormal":
        return LognormalSampler(mean_us, std_us, latency.min_ms * US_PER_MS, rng)
    return TruncatedNormalSampler(mean_us, std_us, latency.min_ms * US_PER_MS, rng)
