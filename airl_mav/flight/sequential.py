"""Sequential test of a minimum success rate, evaluated while flights come in.

Repeated evaluation of an ordinary interval, with a stop at its decision, increases the error. A
group-sequential test distributes the error over planned interim analyses, the looks (Lan & DeMets,
Biometrika 70, 1983; Jennison & Turnbull, Group Sequential Methods with Applications to Clinical
Trials, 2000, chapters 7 and 12). Flights are counted, so the error is exact, from binomial sums
instead of a normal approximation.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from enum import Enum
from functools import cache

import numpy as np
import scipy

ALPHA = 0.05
"""Maximum probability of a false verdict over all looks. Half of it is for "meets" with a low rate,
half for "does not meet" with a sufficient rate, as in a 95 % interval."""

LOOKS = (
    *(20, 40, 60, 80),
    *(scale * step for scale in (10, 100, 1000) for step in (10, 15, 20, 30, 40, 50, 70)),
    100_000,
)
"""Numbers of flights after which the test is evaluated."""

HALF_SPENT = 100
"""Number of flights that spends half of the error: a typical length of a decision.
`benchmarks/bench_verdict.py` compares the flights needed with this and other spending functions."""


class RequirementDecision(str, Enum):
    """Decision on a requirement."""

    MET = "meets"
    NOT_MET = "does not meet"
    UNDECIDED = "too few flights to tell"


def error_spent(flights: int) -> float:
    """Return the cumulative error allowed on either side after a number of flights.

    It always grows and never reaches half of `ALPHA`. The maximum number of flights need not be
    known beforehand.
    """
    return 0.5 * ALPHA * flights / (flights + HALF_SPENT)


@dataclass(frozen=True)
class InterimAnalysis:
    """Decision bounds after a number of flights."""

    flights: int
    few: int
    """Maximum number of failures for "meets"; -1: impossible."""
    many: int
    """Minimum number of failures for "does not meet"."""

    def decide(self, failures: int) -> RequirementDecision:
        """Return the decision for a number of failures."""
        if failures <= self.few:
            return RequirementDecision.MET
        return (
            RequirementDecision.NOT_MET if failures >= self.many else RequirementDecision.UNDECIDED
        )


def plan_looks(
    threshold: float,
    looks: Sequence[int] = LOOKS,
    spent: Callable[[int], float] = error_spent,
) -> Iterator[InterimAnalysis]:
    """Yield the looks of a test in order.

    Both errors are at their maximum at the threshold. There, the distribution of failures among
    undecided campaigns is carried from look to look. At each look, the outermost counts within the
    allowance `spent` decide. Their probability is the error of either side.
    """
    undecided, fewest, before = np.ones(1), 0, 0
    error_few = error_many = 0.0
    for flights in looks:
        step = flights - before
        new = scipy.stats.binom.pmf(np.arange(step + 1), step, 1.0 - threshold)
        undecided, before = np.convolve(undecided, new), flights
        left_few = spent(flights) - error_few
        left_many = spent(flights) - error_many
        n_few = int(np.searchsorted(np.cumsum(undecided), left_few, side="right"))
        n_many = int(np.searchsorted(np.cumsum(undecided[::-1]), left_many, side="right"))
        kept = undecided.size - n_many
        error_few += float(undecided[:n_few].sum())
        error_many += float(undecided[kept:].sum())
        # The minimum possible count of failures is 0, or one more than decided before.
        yield InterimAnalysis(flights, fewest + n_few - 1, fewest + kept)
        undecided, fewest = undecided[n_few:kept], fewest + n_few


@cache
def _planned(threshold: float, looks: int) -> tuple[InterimAnalysis, ...]:
    return tuple(plan_looks(threshold, LOOKS[:looks]))


@dataclass(frozen=True)
class RateTest:
    """Test of a success rate against a threshold, evaluated after each of `LOOKS`."""

    threshold: float
    """Threshold between 0 and 1, both excluded."""

    def __post_init__(self) -> None:
        """Raise ValueError for a threshold that no number of flights can show."""
        if not 0.0 < self.threshold < 1.0:
            raise ValueError(f"threshold={self.threshold}: must be > 0 and < 1")

    def decide(self, reached: Sequence[bool]) -> RequirementDecision:
        """Return the decision of the first deciding look; later flights do not change it."""
        done = sum(look <= len(reached) for look in LOOKS)
        for look in _planned(self.threshold, done):
            decision = look.decide(look.flights - sum(reached[: look.flights]))
            if decision is not RequirementDecision.UNDECIDED:
                return decision
        return RequirementDecision.UNDECIDED

    def flights_needed(self, rate: float, flown: int = 0) -> int | None:
        """Return the number of flights at which a rate would decide; None: not within `LOOKS`."""
        for look in plan_looks(self.threshold):
            failures = round((1.0 - rate) * look.flights)
            if look.flights > flown and look.decide(failures) is not RequirementDecision.UNDECIDED:
                return look.flights
        return None
