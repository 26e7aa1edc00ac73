"""Samplers of injected decision latencies, to emulate another computer."""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from airl_mav.core.constants import US_PER_MS
from airl_mav.profiles.computer import LatencyDistribution

LATENCY_STREAM = 2
"""Second word of the seed of latencies with another `draw`."""


class LatencySampler(Protocol):
    """Source of latencies."""

    def sample_us(self) -> int:
        """Return the next latency [µs], >= 0."""


class FixedSampler:
    """Constant latency."""

    def __init__(self, latency_us: int) -> None:
        """Take the latency [µs], >= 0."""
        if latency_us < 0:
            raise ValueError(f"latency_us={latency_us}: must be >= 0")
        self._latency_us = latency_us

    def sample_us(self) -> int:
        """Return the latency [µs]."""
        return self._latency_us


class LognormalSampler:
    """Minimum latency plus a log-normal; mean and standard deviation apply to the sum."""

    def __init__(
        self, mean_us: float, std_us: float, min_us: float, rng: np.random.Generator
    ) -> None:
        """Take the moments [µs]: 0 <= min_us < mean_us, std_us > 0."""
        self._mu, self._sigma = lognormal_parameters(mean_us - min_us, std_us)
        self._min_us = min_us
        self._rng = rng

    def sample_us(self) -> int:
        """Return the next latency [µs]."""
        return round(self._min_us + self._rng.lognormal(self._mu, self._sigma))


class TruncatedNormalSampler:
    """Normal distribution, redrawn below the minimum latency."""

    def __init__(
        self, mean_us: float, std_us: float, min_us: float, rng: np.random.Generator
    ) -> None:
        """Take the moments of the untruncated normal [µs]; min_us < mean_us keeps redraws rare."""
        self._mean_us, self._std_us, self._min_us = mean_us, std_us, min_us
        self._rng = rng

    def sample_us(self) -> int:
        """Return the next latency [µs]."""
        while (latency_us := self._rng.normal(self._mean_us, self._std_us)) < self._min_us:
            pass
        return round(latency_us)


class ReplaySampler:
    """Measured latencies in their order, cyclic, from a random start.

    The order preserves runs of slow decisions (another process, a hot processor), which a histogram
    loses. Every sample is equally likely at every decision, and neighbours stay neighbours. This is
    the circular block bootstrap (Politis & Romano 1992) with one block per flight.
    """

    def __init__(self, samples_us: ArrayLike, rng: np.random.Generator) -> None:
        """Take the measured latencies (n,) [µs], n >= 1, in order."""
        self._samples_us: NDArray[np.int64] = np.asarray(samples_us, np.int64)
        if not self._samples_us.size:
            raise ValueError("no samples to draw from")
        self._next = int(rng.integers(self._samples_us.size))

    def sample_us(self) -> int:
        """Return the next latency [µs]."""
        latency_us = int(self._samples_us[self._next])
        self._next = (self._next + 1) % self._samples_us.size
        return latency_us


def lognormal_parameters(mean: float, std: float) -> tuple[float, float]:
    """Return mean and standard deviation of the logarithm of a log-normal with these moments."""
    # mean = exp(mu + s²/2), variance = (exp(s²) - 1) mean².
    variance = math.log1p((std / mean) ** 2)
    return math.log(mean) - 0.5 * variance, math.sqrt(variance)


def latency_generator(seed: int, draw: int = 0) -> np.random.Generator:
    """Return the generator of an episode's latencies; another `draw` gives other latencies."""
    return np.random.default_rng((seed, LATENCY_STREAM, draw) if draw else seed)


def build_sampler(latency: LatencyDistribution, rng: np.random.Generator) -> LatencySampler:
    """Build the sampler of a latency whose sample file `load_computer` has read."""
    if latency.distribution == "samples":
        if latency.samples_ms is None:
            raise ValueError(f"samples_file {latency.samples_file} not read: use load_computer")
        return ReplaySampler(np.rint(np.array(latency.samples_ms) * US_PER_MS), rng)
    mean_us = (latency.mean_ms or 0.0) * US_PER_MS
    std_us = (latency.std_ms or 0.0) * US_PER_MS
    if not std_us:
        return FixedSampler(round(mean_us))
    if latency.distribution == "lognormal":
        return LognormalSampler(mean_us, std_us, latency.min_ms * US_PER_MS, rng)
    return TruncatedNormalSampler(mean_us, std_us, latency.min_ms * US_PER_MS, rng)
