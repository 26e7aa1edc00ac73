"""Paired comparison of two runs on the same seeds, with 95 % intervals and numbers of pairs.

Pairing by seed removes the variation between arenas. A small difference becomes visible after far
fewer flights than with different seeds.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from airl_mav.flight import statistics
from airl_mav.flight.episode_record import EpisodeRecord
from airl_mav.flight.judge import Outcome
from airl_mav.flight.quality import Quality

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
    difference: statistics.Estimate
    """Other minus reference; its n is the number of pairs behind all three figures."""
    median: statistics.Estimate | None = None
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


def tango(gained: int, lost: int, n: int) -> statistics.Estimate:
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
        return statistics.NO_ESTIMATE
    value = (gained - lost) / n

    def end(limit: float) -> float:
        # The score falls from +inf at -1 through 0 at the estimate to -inf at +1.
        if value == limit:
            return limit
        inside, outside = value, limit
        while abs(outside - inside) > TANGO_PRECISION:
            middle = 0.5 * (inside + outside)
            if abs(_score(middle, gained, lost, n)) < statistics.QUANTILE:
                inside = middle
            else:
                outside = middle
        return 0.5 * (inside + outside)

    return statistics.Estimate(value, end(-1.0), end(1.0), n)


def _score(d: float, gained: int, lost: int, n: int) -> float:
    """Return Tango's score statistic of a difference d, -1 to 1."""
    away = gained - lost - n * d
    if away == 0.0:
        return 0.0
    # Probability of a loss, maximum likelihood at difference d: the larger root.
    a, b, c = 2.0 * n, (2.0 * n - gained + lost) * d - gained - lost, -lost * d * (1.0 - d)
    q = (math.sqrt(max(0.0, b * b - 4.0 * a * c)) - b) / (2.0 * a)
    variance = n * (2.0 * q + d * (1.0 - d))
    return away / math.sqrt(variance) if variance > 0.0 else math.copysign(math.inf, away)


def relative_difference(reference: ArrayLike, other: ArrayLike) -> statistics.Estimate:
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
        return statistics.NO_ESTIMATE
    value = percent_change(float(first.mean()), float(second.mean()))
    if n == 1:
        return statistics.Estimate(value, None, None, 1)
    if np.ptp(second / first) <= SAME_RATIO:
        return statistics.Estimate(value, value, value, n)
    return statistics.Estimate(value, *statistics.bootstrap_interval((first, second), _percent), n)


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
        **{name: compare_means(*_known_by_both(good, name)) for name in statistics.MEANS},
    )


def _known_by_both(
    good: Sequence[tuple[Quality, Quality]], name: str
) -> tuple[list[float], list[float]]:
    """Return a measure of the pairs in which both flights have it."""
    values = [(getattr(first, name), getattr(second, name)) for first, second in good]
    both = [pair for pair in values if None not in pair]
    return [first for first, _ in both], [second for _, second in both]


def _compare_rates(agreement: Agreement) -> Change:
    """Return both success rates and their difference in percentage points."""
    n = agreement.n
    if n == 0:
        return Change(None, None, statistics.NO_ESTIMATE)
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
        return Change(None, None, statistics.NO_ESTIMATE, statistics.NO_ESTIMATE)
    means = float(first.mean()), float(second.mean())
    if not (first > 0.0).all():
        return Change(*means, statistics.NO_ESTIMATE, statistics.NO_ESTIMATE)
    return Change(*means, relative_difference(first, second), median_ratio(first, second))


def median_ratio(reference: ArrayLike, other: ArrayLike) -> statistics.Estimate:
    """Return the median over pairs (n,) of `100 (other / reference - 1)` [%]; see `median_of`."""
    first, second = np.asarray(reference, np.float64), np.asarray(other, np.float64)
    return statistics.median_of(100.0 * (second / first - 1.0))


def percent_change(reference: float, other: float) -> float:
    """Return `100 (other - reference) / reference` [%]; ValueError unless `reference` > 0."""
    if not reference > 0.0:
        raise ValueError(f"reference = {reference}: must be > 0")
    return 100.0 * (other - reference) / reference
