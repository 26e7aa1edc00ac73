"""Is a success rate at least a threshold? A test that is looked at as flights come in.

Looking at an ordinary interval again and again, and stopping when it has decided, makes false
verdicts as often as one looks. A group-sequential test shares the error out over looks that are
planned beforehand (Lan & DeMets, Biometrika 70, 1983; Jennison & Turnbull, Group Sequential Methods
with Applications to Clinical Trials, 2000, chapters 7 and 12). Flights are counted, so the error is
worked out exactly, by binomial sums, not by a normal approximation.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from enum import Enum
from functools import cache

import numpy as np
import scipy

ALPHA = 0.05
"""Greatest probability of a false verdict over all looks. Half of it for "meets" where the rate is
too low, half of it for "does not meet" where it is not, as a 95 % interval shares it out."""

LOOKS = (
    *(20, 40, 60, 80),
    *(scale * step for scale in (10, 100, 1000) for step in (10, 15, 20, 30, 40, 50, 70)),
    100_000,
)
"""Numbers of flights after which it is looked whether they decide."""

HALF_SPENT = 100
"""Number of flights by which half of the error is spent: such as a decision may well take.
`benchmarks/bench_verdict.py` compares the flights that this and other ways of spending it take."""


class Decision(str, Enum):
    """What is known of a requirement."""

    MET = "meets"
    NOT_MET = "does not meet"
    UNDECIDED = "too few flights to tell"


def error_spent(flights: int) -> float:
    """Return how much error either side may have made by so many flights.

    It grows for ever and never reaches half of `ALPHA`. How many flights there are at most need not
    be known beforehand.
    """
    return 0.5 * ALPHA * flights / (flights + HALF_SPENT)


@dataclass(frozen=True)
class Look:
    """What decides after so many flights."""

    flights: int
    few: int
    """So many failures, or fewer, show that the threshold is met; -1: none can."""
    many: int
    """So many failures, or more, show that it is not."""

    def decide(self, failures: int) -> Decision:
        """Return what failures among the flights show."""
        if failures <= self.few:
            return Decision.MET
        return Decision.NOT_MET if failures >= self.many else Decision.UNDECIDED


def plan_looks(
    threshold: float,
    looks: Sequence[int] = LOOKS,
    spent: Callable[[int], float] = error_spent,
) -> Iterator[Look]:
    """Give the looks of a test, one after the other.

    Both errors are greatest at the threshold itself. There, what campaigns that are still undecided
    have come to is carried from look to look as a distribution of their failures. As many of its
    outermost counts decide as `spent` permits. That is the error of either side by so many flights.
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
        # The fewest failures that are possible are none, or one more than decided before.
        yield Look(flights, fewest + n_few - 1, fewest + kept)
        undecided, fewest = undecided[n_few:kept], fewest + n_few


@cache
def _planned(threshold: float, looks: int) -> tuple[Look, ...]:
    return tuple(plan_looks(threshold, LOOKS[:looks]))


@dataclass(frozen=True)
class RateTest:
    """Is a success rate at least a threshold, or below it? Looked at after each of `LOOKS`."""

    threshold: float
    """Between 0 and 1, both excluded."""

    def __post_init__(self) -> None:
        """Raise ValueError for a threshold that no number of flights can show."""
        if not 0.0 < self.threshold < 1.0:
            raise ValueError(f"threshold={self.threshold}: must be > 0 and < 1")

    def decide(self, reached: Sequence[bool]) -> Decision:
        """Return what the first look that decides has shown; later flights do not change it."""
        done = sum(look <= len(reached) for look in LOOKS)
        for look in _planned(self.threshold, done):
            decision = look.decide(look.flights - sum(reached[: look.flights]))
            if decision is not Decision.UNDECIDED:
                return decision
        return Decision.UNDECIDED

    def flights_needed(self, rate: float, flown: int = 0) -> int | None:
        """Return after how many flights a rate would decide; None: after none of `LOOKS`."""
        for look in plan_looks(self.threshold):
            failures = round((1.0 - rate) * look.flights)
            if look.flights > flown and look.decide(failures) is not Decision.UNDECIDED:
                return look.flights
        return None
