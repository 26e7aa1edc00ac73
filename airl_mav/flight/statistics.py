"""Flight quality over many episodes: means and rates, each with its interval and its n."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np
from numpy.typing import ArrayLike, NDArray

from airl_mav.flight.episode_record import EpisodeRecord
from airl_mav.flight.judge import Outcome
from airl_mav.flight.quality import Quality

CONFIDENCE = 0.95
QUANTILE = 1.959963984540054
"""Quantile of the normal distribution, for a two-sided 95 % interval:
`scipy.special.ndtri(0.975)`."""
NORMAL = NormalDist()
RESAMPLES = 2000
BOOTSTRAP_SEED = 20_210_409
"""Fixed seed: the same episodes always give the same interval."""


@dataclass(frozen=True)
class Estimate:
    """Figure with its 95 % interval; None without data."""

    value: float | None
    low: float | None
    high: float | None
    n: int
    """Number of episodes behind the figure."""

    def scaled(self, factor: float) -> Estimate:
        """Return the estimate in another unit."""
        value, low, high = (
            None if each is None else factor * each for each in (self.value, self.low, self.high)
        )
        return Estimate(value, low, high, self.n)


MEANS = ("flight_time_s", "distance_m", "energy_j", "computer_energy_j", "total_energy_j")
"""Measures of flight quality whose means are compared between two runs."""

PACK_MEASURES = ("endurance_s", "range_m", "missions_per_charge")
"""Measures absent from older runs."""

SMOOTHNESS = ("jerk_rms_m_s3", "command_step_m_s")
"""Smoothness measures, absent from older runs."""

OF_ALL_FLIGHTS = ("deadline_misses",)
"""Measures averaged over all valid flights: late decisions matter most in failed flights."""

AVERAGED = (*MEANS, "mean_speed_m_s", *PACK_MEASURES, *SMOOTHNESS)
"""Measures of flight quality with a mean and a median."""

NO_ESTIMATE = Estimate(None, None, None, 0)
"""Estimate without data."""


@dataclass(frozen=True)
class Aggregate:
    """Figures of a run. Times, distances and energies are means over the successful episodes."""

    success_rate: Estimate
    """Fraction, 0 to 1, over all valid episodes: an aborted one did not reach its goal."""
    flight_time_s: Estimate
    distance_m: Estimate
    energy_j: Estimate
    computer_energy_j: Estimate
    total_energy_j: Estimate
    """Energy of vehicle and computer together."""
    mean_speed_m_s: Estimate
    outcomes: dict[Outcome, int]
    """Number of episodes by outcome, aborted ones included."""
    endurance_s: Estimate = NO_ESTIMATE
    """Endurance [s]; this and the following lack data in older runs."""
    range_m: Estimate = NO_ESTIMATE
    missions_per_charge: Estimate = NO_ESTIMATE
    jerk_rms_m_s3: Estimate = NO_ESTIMATE
    command_step_m_s: Estimate = NO_ESTIMATE
    deadline_misses: Estimate = NO_ESTIMATE
    """Fraction, 0 to 1: the mean over all valid flights, successful or not."""


def wilson(successes: int, n: int) -> Estimate:
    """Return a rate with Wilson's 95 % score interval (Wilson, JASA 22, 1927).

    In closed form, without scipy.stats, because it runs between flights.
    """
    if n == 0:
        return NO_ESTIMATE
    rate, z2 = successes / n, QUANTILE**2
    denominator = 2.0 * (n + z2)
    centre = (2.0 * n * rate + z2) / denominator
    half = QUANTILE / denominator * math.sqrt(4.0 * n * rate * (1.0 - rate) + z2)
    low = 0.0 if successes == 0 else centre - half
    high = 1.0 if successes == n else centre + half
    return Estimate(rate, low, high, n)


def bootstrap_mean(values: ArrayLike) -> Estimate:
    """Return the mean of values (n,) with a bootstrap 95 % interval (BCa, seeded).

    One value has no interval. Equal values have an interval of width zero.
    """
    data = np.asarray(values, np.float64)
    if not data.size:
        return NO_ESTIMATE
    mean = float(data.mean())
    if data.size == 1:
        return Estimate(mean, None, None, 1)
    if np.ptp(data) == 0.0:
        return Estimate(mean, mean, mean, data.size)
    return Estimate(mean, *bootstrap_interval((data,), lambda means: means), data.size)


def bootstrap_interval(
    samples: Sequence[NDArray[np.float64]], statistic: Callable[..., NDArray[np.float64]]
) -> tuple[float, float]:
    """Return the seeded 95 % bootstrap interval of a function of means.

    Bias-corrected and accelerated: Efron & Tibshirani, An Introduction to the Bootstrap, 1993,
    section 14.3. Equal to `scipy.stats.bootstrap`, whose import takes two seconds of processor
    time, with memory proportional to n instead of its square. The samples are paired and not all
    equal, each (n,), n >= 2; `statistic` takes the means (k,) of each.
    """
    n = samples[0].size
    draws = np.random.default_rng(BOOTSTRAP_SEED).integers(0, n, (RESAMPLES, n))
    resampled = statistic(*(sample[draws].mean(axis=-1) for sample in samples))
    observed = statistic(*(sample.mean(keepdims=True) for sample in samples))
    without_one = statistic(*((sample.sum() - sample) / (n - 1) for sample in samples))
    below = 0.5 * (np.mean(resampled < observed) + np.mean(resampled <= observed))
    bias = NORMAL.inv_cdf(min(max(float(below), 0.5 / RESAMPLES), 1.0 - 0.5 / RESAMPLES))
    influence = without_one.mean() - without_one
    spread = float((influence**2).sum()) ** 1.5
    acceleration = float((influence**3).sum()) / (6.0 * spread) if spread else 0.0

    def end(quantile: float) -> float:
        shifted = bias + quantile
        share = NORMAL.cdf(bias + shifted / (1.0 - acceleration * shifted))
        return float(np.quantile(resampled, share))

    return end(-QUANTILE), end(QUANTILE)


def median_of(values: ArrayLike) -> Estimate:
    """Return the median of values (n,) with a distribution-free 95 % interval.

    The interval ends at two of the values. The number of values below the true median is binomial
    (Conover, Practical Nonparametric Statistics, 3rd ed., 1999, section 3.2). Fewer than six values
    have no interval.
    """
    data = np.sort(np.asarray(values, np.float64))
    n = data.size
    if not n:
        return NO_ESTIMATE
    # Maximum number of values that may be left out on either side.
    out = _binomial_quantile(0.5 * (1.0 - CONFIDENCE), n) - 1
    middle = float(np.median(data))
    if out < 0:
        return Estimate(middle, None, None, n)
    return Estimate(middle, float(data[out]), float(data[n - 1 - out]), n)


def _binomial_quantile(probability: float, n: int) -> int:
    """Return the minimum number of heads in n coin tosses with this cumulative probability."""
    heads = np.arange(n)
    steps = np.log(n - heads) - np.log1p(heads)
    logarithms = np.concatenate([[0.0], np.cumsum(steps)]) - n * math.log(2.0)
    return int(np.searchsorted(np.cumsum(np.exp(logarithms)), probability))


def reached_goals(episodes: Sequence[EpisodeRecord]) -> list[bool]:
    """Return True for each valid flight that reached its goal; an aborted one did not."""
    return [e.outcome is Outcome.SUCCESS for e in episodes if not e.invalid]


def aggregate(episodes: Sequence[EpisodeRecord]) -> Aggregate:
    """Return a run's figures, over its valid episodes."""
    outcomes = dict.fromkeys(Outcome, 0)
    for episode in episodes:
        outcomes[episode.outcome] += 1
    reached = reached_goals(episodes)
    flown = [episode for episode in episodes if not episode.invalid]
    good = successful(flown)
    qualities = [episode.quality for episode in flown if episode.quality is not None]
    return Aggregate(
        success_rate=wilson(sum(reached), len(reached)),
        outcomes=outcomes,
        **{name: bootstrap_mean(known(good, name)) for name in AVERAGED},
        **{name: bootstrap_mean(known(qualities, name)) for name in OF_ALL_FLIGHTS},
    )


def successful(episodes: Sequence[EpisodeRecord]) -> list[Quality]:
    """Return the quality of the flights that reached the goal."""
    return [e.quality for e in episodes if e.outcome is Outcome.SUCCESS and e.quality is not None]


def known(good: Sequence[Quality], name: str) -> list[float]:
    """Return a measure of the flights that have it."""
    return [value for quality in good if (value := getattr(quality, name)) is not None]
