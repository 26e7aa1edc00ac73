"""Flight quality over many episodes, with 95 % intervals and n; paired comparison of two runs.

Pairing by seed removes the variation between arenas. A small difference becomes visible after far
fewer flights than with different seeds.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np
from numpy.typing import ArrayLike, NDArray

from airl_mav.flight.episode_record import EpisodeRecord
from airl_mav.flight.judge import Outcome
from airl_mav.flight.trajectory import Quality

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
    # Exact ends: rounding of the closed form would miss 0 and 1.
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
    # One value has no spread to resample.
    if data.size == 1:
        return Estimate(mean, None, None, 1)
    # The bias correction is undefined without spread.
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
    # The same indices for all samples keep pairs together; the seed makes reports reproducible.
    draws = np.random.default_rng(BOOTSTRAP_SEED).integers(0, n, (RESAMPLES, n))
    resampled = statistic(*(sample[draws].mean(axis=-1) for sample in samples))
    observed = statistic(*(sample.mean(keepdims=True) for sample in samples))
    # Jackknife means in closed form: O(n) memory.
    without_one = statistic(*((sample.sum() - sample) / (n - 1) for sample in samples))
    # Ties count half: discrete data have many of them.
    below = 0.5 * (np.mean(resampled < observed) + np.mean(resampled <= observed))
    # Limited to half a resample: the quantile of 0 or 1 is infinite.
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
    # Two-sided: half of the error probability on each side.
    out = _binomial_quantile(0.5 * (1.0 - CONFIDENCE), n) - 1
    middle = float(np.median(data))
    if out < 0:
        return Estimate(middle, None, None, n)
    return Estimate(middle, float(data[out]), float(data[n - 1 - out]), n)


def _binomial_quantile(probability: float, n: int) -> int:
    """Return the minimum number of heads in n coin tosses with this cumulative probability."""
    heads = np.arange(n)
    steps = np.log(n - heads) - np.log1p(heads)
    # Logarithms, because the binomial coefficients overflow beyond about 1000 values.
    logarithms = np.concatenate([[0.0], np.cumsum(steps)]) - n * math.log(2.0)
    return int(np.searchsorted(np.cumsum(np.exp(logarithms)), probability))


def reached_goals(episodes: Sequence[EpisodeRecord]) -> list[bool]:
    """Return True for each valid flight that reached its goal; an aborted one did not."""
    return [e.outcome is Outcome.SUCCESS for e in episodes if not e.invalid]


def aggregate(episodes: Sequence[EpisodeRecord]) -> Aggregate:
    """Return a run's figures, over its valid episodes."""
    flown = [episode for episode in episodes if not episode.invalid]
    outcomes = dict.fromkeys(Outcome, 0)
    for episode in flown:
        outcomes[episode.outcome] += 1
    reached = reached_goals(episodes)
    # Times and energies of failed flights depend on when they ended.
    good = successful(flown)
    # Deadline misses do not depend on the outcome, so failed flights count, too.
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


Floats = NDArray[np.float64]

Pair = tuple[EpisodeRecord, EpisodeRecord]
"""Flights of one seed: reference, other."""

TANGO_PRECISION = 1e-12
"""Precision of the ends of Tango's interval, found by bisection."""

SAME_RATIO = 1e-12
"""Maximum difference between ratios that is attributed to rounding."""


@dataclass(frozen=True)
class Agreement:
    """Goals reached by each of both runs, counted over seeds: McNemar's table."""

    both: int
    only_reference: int
    only_other: int
    neither: int

    @property
    def n(self) -> int:
        """Number of pairs."""
        return self.both + self.only_reference + self.only_other + self.neither


@dataclass(frozen=True)
class Change:
    """Figure of two runs on the same seeds. None without data."""

    reference: float | None
    other: float | None
    difference: Estimate
    """Other minus reference; its n is the number of pairs behind all three figures."""
    median: Estimate | None = None
    """Median over the pairs of each pair's difference [%]. One long flight moves a mean, but not a
    median. None for the success rate."""


@dataclass(frozen=True)
class PairedComparison:
    """Comparison of a run with a reference, over pairs of flights with the same seed.

    The difference of a mean is `100 (other - reference) / reference` percent, over the common
    successes. The difference of the success rate is in percentage points, over all pairs.
    """

    agreement: Agreement
    success_rate: Change
    """Fractions, 0 to 1."""
    flight_time_s: Change
    distance_m: Change
    energy_j: Change
    """Energy of the vehicle, without its computer."""
    computer_energy_j: Change
    total_energy_j: Change
    """Energy of vehicle and computer together."""


def pair_by_seed(
    reference: Sequence[EpisodeRecord], other: Sequence[EpisodeRecord]
) -> tuple[Pair, ...]:
    """Return the flights of the seeds that both runs contain, in the order of the reference.

    An invalid flight is no test of the policy: its seed makes no pair. Raises ValueError if a run
    contains a seed twice.
    """
    first, second = _by_seed(reference), _by_seed(other)
    return tuple((first[seed], second[seed]) for seed in first if seed in second)


def _by_seed(episodes: Sequence[EpisodeRecord]) -> dict[int, EpisodeRecord]:
    flown = [episode for episode in episodes if not episode.invalid]
    by_seed = {episode.seed: episode for episode in flown}
    if len(by_seed) != len(flown):
        raise ValueError("a run holds a seed twice")
    return by_seed


def count_agreement(pairs: Sequence[Pair]) -> Agreement:
    """Count the goals reached by each of both runs."""
    reached = [tuple(flight.outcome is Outcome.SUCCESS for flight in pair) for pair in pairs]
    return Agreement(
        both=reached.count((True, True)),
        only_reference=reached.count((True, False)),
        only_other=reached.count((False, True)),
        neither=reached.count((False, False)),
    )


def common_successes(pairs: Sequence[Pair]) -> tuple[tuple[Quality, Quality], ...]:
    """Return the quality of the pairs in which both flights reached the goal."""
    return tuple(
        (first.quality, second.quality)
        for first, second in pairs
        if first.outcome is second.outcome is Outcome.SUCCESS
        and first.quality is not None
        and second.quality is not None
    )


def tango(gained: int, lost: int, n: int) -> Estimate:
    """Return the difference of two paired proportions with Tango's 95 % score interval.

    The interval contains the differences that McNemar's test, generalised to them, does not reject
    (T. Tango, Equivalence test and confidence interval for the difference in proportions for the
    paired-sample design, Statistics in Medicine 17, 1998, 891-908). It keeps its coverage if few
    pairs differ, and has a width if no pair differs. Of n pairs, `gained` are successes of the
    other alone, `lost` of the reference alone. The difference is other minus reference, as a
    fraction, -1 to 1.
    """
    if min(gained, lost) < 0 or gained + lost > n:
        raise ValueError(f"gained={gained}, lost={lost}, n={n}: must be >= 0 and fit")
    if n == 0:
        return NO_ESTIMATE
    value = (gained - lost) / n

    def end(limit: float) -> float:
        # The score falls from +inf at -1 through 0 at the estimate to -inf at +1.
        # The interval ends at the limit itself: bisection has no interior point.
        if value == limit:
            return limit
        inside, outside = value, limit
        while abs(outside - inside) > TANGO_PRECISION:
            middle = 0.5 * (inside + outside)
            if abs(_score(middle, gained, lost, n)) < QUANTILE:
                inside = middle
            else:
                outside = middle
        return 0.5 * (inside + outside)

    return Estimate(value, end(-1.0), end(1.0), n)


def _score(d: float, gained: int, lost: int, n: int) -> float:
    """Return Tango's score statistic of a difference d, -1 to 1."""
    # Zero numerator first: the variance may be zero, too.
    away = gained - lost - n * d
    if away == 0.0:
        return 0.0
    # Probability of a loss, maximum likelihood at difference d: the larger root.
    a, b, c = 2.0 * n, (2.0 * n - gained + lost) * d - gained - lost, -lost * d * (1.0 - d)
    q = (math.sqrt(max(0.0, b * b - 4.0 * a * c)) - b) / (2.0 * a)
    variance = n * (2.0 * q + d * (1.0 - d))
    return away / math.sqrt(variance) if variance > 0.0 else math.copysign(math.inf, away)


def relative_difference(reference: ArrayLike, other: ArrayLike) -> Estimate:
    """Return the relative difference of paired means [%], with a bootstrap 95 % interval.

    Resamples whole pairs (n,) (BCa, seeded). One pair has no interval. Pairs of equal ratio have an
    interval of width zero. Raises ValueError unless all values of the reference are > 0.
    """
    first, second = np.asarray(reference, np.float64), np.asarray(other, np.float64)
    if first.ndim != 1 or first.shape != second.shape:
        raise ValueError(f"shapes {first.shape} and {second.shape}: must be (n,), the same")
    if not (first > 0.0).all():
        raise ValueError("reference: must be > 0")
    n = first.size
    if n == 0:
        return NO_ESTIMATE
    value = percent_change(float(first.mean()), float(second.mean()))
    # One pair has a difference, but no interval.
    if n == 1:
        return Estimate(value, None, None, 1)
    # Equal ratios up to rounding: resampling would amplify rounding errors.
    if np.ptp(second / first) <= SAME_RATIO:
        return Estimate(value, value, value, n)
    return Estimate(value, *bootstrap_interval((first, second), _percent), n)


def _percent(reference: Floats, other: Floats) -> Floats:
    return 100.0 * (other - reference) / reference


def compare_pairs(
    reference: Sequence[EpisodeRecord], other: Sequence[EpisodeRecord]
) -> PairedComparison:
    """Compare a run with a reference on their common seeds; see `pair_by_seed`."""
    pairs = pair_by_seed(reference, other)
    agreement = count_agreement(pairs)
    good = common_successes(pairs)
    return PairedComparison(
        agreement=agreement,
        success_rate=_compare_rates(agreement),
        **{name: compare_means(*_known_by_both(good, name)) for name in MEANS},
    )


def _known_by_both(
    good: Sequence[tuple[Quality, Quality]], name: str
) -> tuple[list[float], list[float]]:
    """Return a measure of the pairs in which both flights have it."""
    values = [(getattr(first, name), getattr(second, name)) for first, second in good]
    # A pair counts only if both flights have the measure; otherwise means would compare different
    # seeds.
    both = [pair for pair in values if None not in pair]
    return [first for first, _ in both], [second for _, second in both]


def _compare_rates(agreement: Agreement) -> Change:
    """Return both success rates and their difference in percentage points."""
    n = agreement.n
    if n == 0:
        return Change(None, None, NO_ESTIMATE)
    d = tango(agreement.only_other, agreement.only_reference, n)
    return Change(
        (agreement.both + agreement.only_reference) / n,
        (agreement.both + agreement.only_other) / n,
        d.scaled(100.0),
    )


def compare_means(reference: ArrayLike, other: ArrayLike) -> Change:
    """Return the difference of the means of paired values (n,) [%], and the median over the pairs.

    The difference is undefined if a reference value is 0, as for a computer of 0 W.
    """
    first, second = np.asarray(reference, np.float64), np.asarray(other, np.float64)
    if not first.size:
        return Change(None, None, NO_ESTIMATE, NO_ESTIMATE)
    means = float(first.mean()), float(second.mean())
    if not (first > 0.0).all():
        return Change(*means, NO_ESTIMATE, NO_ESTIMATE)
    return Change(*means, relative_difference(first, second), median_ratio(first, second))


def median_ratio(reference: ArrayLike, other: ArrayLike) -> Estimate:
    """Return the median over pairs (n,) of `100 (other / reference - 1)` [%]; see `median_of`."""
    first, second = np.asarray(reference, np.float64), np.asarray(other, np.float64)
    return median_of(100.0 * (second / first - 1.0))


def percent_change(reference: float, other: float) -> float:
    """Return `100 (other - reference) / reference` [%]; ValueError unless `reference` > 0."""
    if not reference > 0.0:
        raise ValueError(f"reference = {reference}: must be > 0")
    return 100.0 * (other - reference) / reference
