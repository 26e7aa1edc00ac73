"""Tests of a success rate that may be looked at after every flight, and stopped at any of them.

Looking at an ordinary interval after each flight and stopping when it has decided makes false
verdicts as often as one looks. An e-process does not: against a hypothesis that is true, it reaches
1 / alpha with a probability of alpha at most, over all looks together (Ville's inequality; Ramdas
et al., Game-Theoretic Statistics and Safe Anytime-Valid Inference, Statistical Science 38, 2023).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray
from scipy import special

ALPHA = 0.05
"""Greatest probability of a false verdict, over all looks at a campaign."""

MOST_FLIGHTS = 1_000_000
"""A verdict that would take more flights than this is called out of reach."""

# What failures are weighed against: odds of a failure that lie a factor from the threshold's. The
# weights decide how soon a verdict comes, never whether it is right. Most lies on a factor of 2 to
# 3: the difference that a hundred flights can show.
_LOG_FACTORS: NDArray[np.float64] = np.log(2.0) * np.arange(0.125, 5.001, 0.125)
_WEIGHTS: NDArray[np.float64] = np.exp(-0.5 * ((_LOG_FACTORS - math.log(2.5)) / 0.7) ** 2)
_LOG_WEIGHTS: NDArray[np.float64] = np.log(_WEIGHTS / _WEIGHTS.sum())


class Decision(str, Enum):
    """What is known of a requirement."""

    MET = "meets"
    NOT_MET = "does not meet"
    UNDECIDED = "too few flights to tell"


@dataclass(frozen=True)
class RateTest:
    """Is a success rate at least a threshold, or below it?"""

    threshold: float
    """Between 0 and 1, both excluded."""
    alpha: float = ALPHA

    def __post_init__(self) -> None:
        """Raise ValueError for a threshold that no number of flights can show."""
        if not 0.0 < self.threshold < 1.0:
            raise ValueError(f"threshold={self.threshold}: must be > 0 and < 1")

    def decide(self, successes: int, n: int) -> Decision:
        """Return what n flights, of which some were successes, show. May be asked after each."""
        limit = -math.log(self.alpha)
        if self._log_evidence(n - successes, n, 1.0) >= limit:
            return Decision.NOT_MET
        if self._log_evidence(n - successes, n, -1.0) >= limit:
            return Decision.MET
        return Decision.UNDECIDED

    def flights_needed(self, rate: float) -> int | None:
        """Return after how many flights a rate would decide; None beyond `MOST_FLIGHTS`.

        Args:
            rate: Success rate that the flights would keep, 0 to 1.
        """

        def decides(n: int) -> bool:
            return self.decide(round(rate * n), n) is not Decision.UNDECIDED

        enough = 1
        while not decides(enough):
            enough *= 2
            if enough > MOST_FLIGHTS:
                return None
        short = enough // 2
        while enough - short > 1:
            middle = (short + enough) // 2
            short, enough = (short, middle) if decides(middle) else (middle, enough)
        return enough

    def _log_evidence(self, failures: int, n: int, side: float) -> float:
        """Return the logarithm of the e-value of one side.

        Args:
            failures: Number of flights that failed.
            n: Number of flights.
            side: 1: for more failures than the threshold permits; -1: for fewer.
        """
        odds = math.log1p(-self.threshold) - math.log(self.threshold)
        # The likelihood ratio of a failure rate against that of the threshold, mixed over rates.
        rates = odds + side * _LOG_FACTORS
        ratio = failures * (special.log_expit(rates) - special.log_expit(odds))
        ratio += (n - failures) * (special.log_expit(-rates) - special.log_expit(-odds))
        return float(special.logsumexp(ratio + _LOG_WEIGHTS))
