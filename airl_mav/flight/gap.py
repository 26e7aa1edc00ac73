"""The hardware gap: what a policy's flights lose on one computer against another.

The gap of a metric is `100 (target - reference) / reference` percent, that of the success rate is
in percentage points. It is worked out over flights with the same seeds; time, distance and energy
over the common successes. A gap without its reference means nothing: who asks names it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from airl_mav.flight.paired import (
    Agreement,
    Change,
    common_successes,
    compare,
    pair_by_seed,
    relative_difference,
)
from airl_mav.flight.quality import Quality
from airl_mav.flight.record import EpisodeRecord
from airl_mav.flight.statistics import Estimate, median_of

NOTHING = Estimate(None, None, None, 0)


@dataclass(frozen=True)
class MetricGap:
    """The gap of one metric over the common successes."""

    change: Change
    """Both means, and their difference in percent of the reference's."""
    median: Estimate
    """Median over the pairs of what each one loses [%]. One long flight moves a mean and not it."""


@dataclass(frozen=True)
class HardwareGap:
    """A target against its reference, by pairs of flights with the same seed."""

    agreement: Agreement
    success_rate: Change
    """Fractions, 0 to 1, over all pairs; their difference in percentage points."""
    flight_time_s: MetricGap
    distance_m: MetricGap
    energy_j: MetricGap
    """Of the vehicle, without its computer."""
    computer_energy_j: MetricGap
    total_energy_j: MetricGap
    """Vehicle and computer together."""


def relative_gap(reference: float, target: float) -> float:
    """Return the gap of two figures [%], signed: > 0 where the target has more.

    Raises:
        ValueError: The reference is not > 0.
    """
    if not reference > 0.0:
        raise ValueError(f"reference = {reference}: must be > 0")
    return 100.0 * (target - reference) / reference


def hardware_gap(
    reference: Sequence[EpisodeRecord], target: Sequence[EpisodeRecord]
) -> HardwareGap:
    """Return the gap of a target's flights against its reference's, on the seeds that both hold.

    Raises:
        ValueError: A run holds a seed twice.
    """
    comparison = compare(reference, target)
    good = common_successes(pair_by_seed(reference, target))

    def gap(metric: Callable[[Quality], float]) -> MetricGap:
        return metric_gap([metric(a) for a, _ in good], [metric(b) for _, b in good])

    return HardwareGap(
        agreement=comparison.agreement,
        success_rate=comparison.success_rate,
        flight_time_s=gap(lambda quality: quality.flight_time_s),
        distance_m=gap(lambda quality: quality.distance_m),
        energy_j=gap(lambda quality: quality.energy_j),
        computer_energy_j=gap(lambda quality: quality.computer_energy_j),
        total_energy_j=gap(total_energy_j),
    )


def total_energy_j(quality: Quality) -> float:
    """Return the energy of vehicle and computer together [J]."""
    return quality.energy_j + quality.computer_energy_j


def metric_gap(reference: ArrayLike, target: ArrayLike) -> MetricGap:
    """Return the gap of paired values (n,), those of the reference first.

    Where a value of the reference is 0 (a computer of no watts) there is no gap to be told.
    """
    first, second = np.asarray(reference, np.float64), np.asarray(target, np.float64)
    if not first.size:
        return MetricGap(Change(None, None, NOTHING), NOTHING)
    means = float(first.mean()), float(second.mean())
    if not (first > 0.0).all():
        return MetricGap(Change(*means, NOTHING), NOTHING)
    return MetricGap(
        Change(*means, relative_difference(first, second)), median_ratio(first, second)
    )


def median_ratio(reference: ArrayLike, target: ArrayLike) -> Estimate:
    """Return the median over pairs of `100 (target / reference - 1)` [%]; see `median_of`.

    Args:
        reference: Values (n,), > 0.
        target: Values (n,) of the same seeds.
    """
    first, second = np.asarray(reference, np.float64), np.asarray(target, np.float64)
    return median_of(100.0 * (second / first - 1.0))
