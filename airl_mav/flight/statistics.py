"""Flight quality over many episodes, with 95 % intervals and n; paired comparison of two runs.

Times, distances and energies are medians. Their intervals cover 95 % for every continuous
distribution. No interval of a mean does so for flight times: a sample without a rare long flight
has no information on it. `scripts/studies/interval_coverage.py` measures the coverage.

Pairing by seed removes the variation between arenas. A small difference becomes visible after far
fewer flights than with different seeds.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from airl_mav.flight.episode_record import EpisodeRecord
from airl_mav.flight.judge import Outcome
from airl_mav.flight.trajectory import Quality

Floats = NDArray[np.float64]

CONFIDENCE = 0.95
QUANTILE = 1.959963984540054
"""Quantile of the normal distribution, for a two-sided 95 % interval:
`scipy.special.ndtri(0.975)`."""
BETS = np.linspace(0.0, 1.0, 202)[1:-1]
"""Stakes of `anytime_mean`, a uniform mixture."""
BOUND_PRECISION = 1e-6
"""Precision of the ends of `anytime_mean`, found by bisection."""
BINS = 1000
"""Values per unit to which `anytime_mean` rounds in the conservative direction."""


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


COMPARED = ("flight_time_s", "distance_m", "energy_j", "computer_energy_j", "total_energy_j")
"""Measures of flight quality that are compared between two runs."""

PACK_MEASURES = ("endurance_s", "range_m", "missions_per_charge")
"""Measures absent from older runs."""

SMOOTHNESS = ("jerk_rms_m_s3", "command_step_m_s")
"""Smoothness measures, absent from older runs."""

OF_ALL_FLIGHTS = ("deadline_misses",)
"""Fractions averaged over all valid flights: late decisions matter most in failed flights."""

OF_SUCCESSES = (*COMPARED, "mean_speed_m_s", *PACK_MEASURES, *SMOOTHNESS)
"""Measures with a median over the successful flights."""

NO_ESTIMATE = Estimate(None, None, None, 0)
"""Estimate without data."""


@dataclass(frozen=True)
class Aggregate:
    """Figures of a run. Times, distances and energies are medians over the successful episodes."""

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


def anytime_mean(values: ArrayLike, counts: ArrayLike | None = None) -> Estimate:
    """Return the mean of values (n,) within 0 to 1, with an interval of at least 95 %.

    The interval holds for every distribution, and at any stopping time that depends on the values.
    It contains the means against which no mixture of bets multiplies its stake by 40
    (Waudby-Smith & Ramdas, Estimating means of bounded random variables by betting, JRSS B 86,
    2024). `counts` (n,) repeat values.
    """
    data = np.asarray(values, np.float64)
    weights = np.ones(data.shape) if counts is None else np.asarray(counts, np.float64)
    n = int(weights.sum())
    if n == 0:
        return NO_ESTIMATE
    low, high = _betting_bound(data, weights), 1.0 - _betting_bound(1.0 - data, weights)
    return Estimate(float(np.average(data, weights=weights)), low, high, n)


def _betting_bound(values: Floats, weights: Floats) -> float:
    """Return the lower bound of a mean within 0 to 1."""
    # The tolerance keeps multiples of a bin in their bin.
    binned = np.floor(values * BINS + 1e-6) / BINS
    value, inverse = np.unique(binned, return_inverse=True)
    count = np.bincount(inverse, weights)
    inside, outside = float(np.average(value, weights=count)), 0.0
    limit = math.log(2.0 / (1.0 - CONFIDENCE))
    # The capital falls with the assumed mean, so the bound is found by bisection.
    while inside - outside > BOUND_PRECISION:
        mean = 0.5 * (inside + outside)
        wealth = np.log1p(np.multiply.outer(BETS, value / mean - 1.0)) @ count
        if np.logaddexp.reduce(wealth) - math.log(BETS.size) < limit:
            inside = mean
        else:
            outside = mean
    return outside


def median_of(values: ArrayLike) -> Estimate:
    """Return the median of values (n,) with a distribution-free 95 % interval.

    The number of values below the true median is binomial, so intervals that end at two of the
    values have only certain coverages. Each end is interpolated between the two values around 95 %
    (Hettmansperger & Sheather, Confidence intervals based on interpolated order statistics,
    Statistics & Probability Letters 4, 1986). Fewer than six values have no interval.
    """
    data = np.sort(np.asarray(values, np.float64))
    n = data.size
    if not n:
        return NO_ESTIMATE
    cumulative = _coin_tosses(n)
    # Number of values beyond the narrowest interval of order statistics that covers 95 %.
    beyond = int(np.searchsorted(cumulative, 0.5 * (1.0 - CONFIDENCE))) - 1
    middle = float(np.median(data))
    if beyond < 0:
        return Estimate(middle, None, None, n)
    wide, narrow = (1.0 - 2.0 * cumulative[k] for k in (beyond, beyond + 1))
    share, k = (wide - CONFIDENCE) / (wide - narrow), beyond + 1
    weight = (n - k) * share / (k + (n - 2 * k) * share)
    low = data[beyond] + weight * (data[k] - data[beyond])
    high = data[n - k] - weight * (data[n - k] - data[n - k - 1])
    return Estimate(middle, float(low), float(high), n)


def _coin_tosses(n: int) -> Floats:
    """Return the cumulative probabilities (n + 1,) of heads in n coin tosses."""
    heads = np.arange(n)
    steps = np.log(n - heads) - np.log1p(heads)
    # Logarithms, because the binomial coefficients overflow beyond about 1000 values.
    logarithms = np.concatenate([[0.0], np.cumsum(steps)]) - n * math.log(2.0)
    return np.cumsum(np.exp(logarithms))


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
        **{name: median_of(known(good, name)) for name in OF_SUCCESSES},
        **{name: anytime_mean(known(qualities, name)) for name in OF_ALL_FLIGHTS},
    )


def successful(episodes: Sequence[EpisodeRecord]) -> list[Quality]:
    """Return the quality of the flights that reached the goal."""
    return [e.quality for e in episodes if e.outcome is Outcome.SUCCESS and e.quality is not None]


def known(good: Sequence[Quality], name: str) -> list[float]:
    """Return a measure of the flights that have it."""
    return [value for quality in good if (value := getattr(quality, name)) is not None]


Pair = tuple[EpisodeRecord, EpisodeRecord]
"""Flights of one seed: reference, other."""

TANGO_PRECISION = 1e-12
"""Precision of the ends of Tango's interval, found by bisection."""


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
    """Median over the pairs of each pair's difference [%]; for the success rate, other minus
    reference. Its n is the number of pairs behind all three figures."""


@dataclass(frozen=True)
class PairedComparison:
    """Comparison of a run with a reference, over pairs of flights with the same seed.

    Figures of both runs are medians over the common successes. Their difference is the median of
    `100 (other - reference) / reference` percent over the pairs. The difference of the success rate
    is in percentage points, over all pairs.
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


def anytime_gap(agreement: Agreement) -> Estimate:
    """Return the difference of two paired success rates [points], valid at any stop.

    For flights that are added until a decision: see `anytime_mean`. It excludes zero exactly if a
    mixture of bets on the discordant pairs multiplies its stake by 40 (the e-process of McNemar's
    test).
    """
    gained, lost, n = agreement.only_other, agreement.only_reference, agreement.n
    found = anytime_mean([0.0, 0.5, 1.0], [lost, n - gained - lost, gained])
    if found.low is None or found.high is None:
        return NO_ESTIMATE
    # Of the pairs' differences: -1 for a loss, +1 for a gain.
    low, high = 2.0 * found.low - 1.0, 2.0 * found.high - 1.0
    return Estimate((gained - lost) / n, low, high, n).scaled(100.0)


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
        **{name: compare_medians(*_known_by_both(good, name)) for name in COMPARED},
    )


def _known_by_both(
    good: Sequence[tuple[Quality, Quality]], name: str
) -> tuple[list[float], list[float]]:
    """Return a measure of the pairs in which both flights have it."""
    values = [(getattr(first, name), getattr(second, name)) for first, second in good]
    # A pair counts only if both flights have the measure; otherwise medians would compare different
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


def compare_medians(reference: ArrayLike, other: ArrayLike) -> Change:
    """Return the medians of paired values (n,), and the median over the pairs' differences [%].

    The difference is undefined if a reference value is 0, as for a computer of 0 W.
    """
    first, second = np.asarray(reference, np.float64), np.asarray(other, np.float64)
    if not first.size:
        return Change(None, None, NO_ESTIMATE)
    defined = bool((first > 0.0).all())
    difference = median_ratio(first, second) if defined else NO_ESTIMATE
    return Change(float(np.median(first)), float(np.median(second)), difference)


def median_ratio(reference: ArrayLike, other: ArrayLike) -> Estimate:
    """Return the median over pairs (n,) of `100 (other / reference - 1)` [%]; see `median_of`."""
    first, second = np.asarray(reference, np.float64), np.asarray(other, np.float64)
    return median_of(100.0 * (second / first - 1.0))


def percent_change(reference: float, other: float) -> float:
    """Return `100 (other - reference) / reference` [%]; ValueError unless `reference` > 0."""
    if not reference > 0.0:
        raise ValueError(f"reference = {reference}: must be > 0")
    return 100.0 * (other - reference) / reference
