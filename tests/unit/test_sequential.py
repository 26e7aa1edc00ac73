"""Verdicts that are looked for after every flight: right as often as they say."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from airl_mav.flight import sequential
from airl_mav.flight.sequential import ALPHA, Decision, RateTest

CAMPAIGNS, FLIGHTS = 1000, 400


def campaigns(rate: float, threshold: float) -> dict[Decision, int]:
    """Fly campaigns that stop at the first look that decides; count how they end."""
    rng = np.random.default_rng(7)
    successes = np.cumsum(rng.random((CAMPAIGNS, FLIGHTS)) < rate, axis=1)
    test = RateTest(threshold)
    # Every count of successes at every look is decided once.
    known = {
        (n, k): test.decide(k, n)
        for n in range(1, FLIGHTS + 1)
        for k in np.unique(successes[:, n - 1]).tolist()
    }
    ends = dict.fromkeys(Decision, 0)
    for row in successes.tolist():
        looks = (known[n, k] for n, k in enumerate(row, 1))
        ends[next((d for d in looks if d is not Decision.UNDECIDED), Decision.UNDECIDED)] += 1
    return ends


@pytest.mark.parametrize("threshold", [0.95, 0.8])
def test_at_the_threshold_hardly_a_campaign_is_judged_falsely(threshold: float) -> None:
    ends = campaigns(threshold, threshold)
    # "meets" is true there, but just below it would not be.
    assert ends[Decision.NOT_MET] <= ALPHA * CAMPAIGNS
    assert ends[Decision.MET] <= ALPHA * CAMPAIGNS


def test_a_plain_interval_looked_at_after_every_flight_would_be_false_far_more_often() -> None:
    rng = np.random.default_rng(7)
    successes = np.cumsum(rng.random((CAMPAIGNS, FLIGHTS)) < 0.95, axis=1)
    n = np.arange(1, FLIGHTS + 1)
    too_few = np.asarray(stats.binom.cdf(successes, n, 0.95)) < ALPHA
    assert np.mean(np.any(too_few, axis=1)) > 2.0 * ALPHA


def test_what_is_far_from_the_threshold_is_soon_decided() -> None:
    test = RateTest(0.95)
    assert campaigns(0.8, 0.95)[Decision.NOT_MET] > 0.99 * CAMPAIGNS
    needed = test.flights_needed(0.87)
    assert needed is not None and needed <= 100, "12 points fewer at 396 ms: within 100 flights"
    assert test.flights_needed(1.0) is not None
    assert test.decide(100, 100) is Decision.MET
    assert test.decide(80, 100) is Decision.NOT_MET


def test_a_borderline_rate_says_how_many_flights_it_would_take() -> None:
    test = RateTest(0.95)
    needed = test.flights_needed(0.955)
    assert needed is not None and needed > 5000
    assert test.decide(round(0.955 * needed), needed) is Decision.MET
    half = needed // 2
    assert test.decide(round(0.955 * half), half) is Decision.UNDECIDED
    assert test.flights_needed(0.95) is None


@given(
    failures=st.integers(0, 60),
    successes=st.integers(0, 300),
    threshold=st.floats(0.05, 0.99),
)
def test_the_evidence_is_a_mixture_of_likelihood_ratios(
    failures: int, successes: int, threshold: float
) -> None:
    """Held against the sum of binomial likelihoods by scipy."""
    n = failures + successes
    test = RateTest(threshold)
    odds = (1.0 - threshold) / threshold
    for side in (1.0, -1.0):
        rates = odds * np.exp(side * sequential._LOG_FACTORS)
        likelihood = stats.binom.logpmf(failures, n, rates / (1.0 + rates))
        expected = np.logaddexp.reduce(likelihood + sequential._LOG_WEIGHTS)
        expected -= stats.binom.logpmf(failures, n, 1.0 - threshold)
        assert test._log_evidence(failures, n, side) == pytest.approx(expected, rel=1e-7, abs=1e-7)


@given(n=st.integers(1, 60), threshold=st.floats(0.1, 0.97))
def test_at_the_threshold_the_evidence_is_one_on_average(n: int, threshold: float) -> None:
    """What makes it an e-process: its expectation under the hypothesis is 1."""
    failures = np.arange(n + 1)
    weights = stats.binom.pmf(failures, n, 1.0 - threshold)
    test = RateTest(threshold)
    for side in (1.0, -1.0):
        evidence = [math.exp(test._log_evidence(int(k), n, side)) for k in failures]
        assert float(np.dot(weights, evidence)) == pytest.approx(1.0, rel=1e-6)


@pytest.mark.parametrize("threshold", [0.0, 1.0, math.nan])
def test_thresholds_that_no_flights_can_show(threshold: float) -> None:
    with pytest.raises(ValueError, match="threshold"):
        RateTest(threshold)
