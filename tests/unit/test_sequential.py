"""The test of a success rate that is looked at as flights come in: right as often as it says."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import stats

from airl_mav.flight.requirements import (
    ALPHA,
    LOOKS,
    InterimAnalysis,
    RateTest,
    RequirementDecision,
    error_spent,
    plan_looks,
)
from airl_mav.flight.statistics import Agreement, Estimate, anytime_gap, wilson

CAMPAIGNS, FLIGHTS = 20_000, 500


def flown(n: int, failures: int) -> list[bool]:
    """Flights whose failures are spread evenly."""
    ends = np.floor(np.arange(n + 1) * failures / max(n, 1))
    return [bool(value) for value in np.diff(ends) == 0]


def campaigns(rate: float, threshold: float) -> dict[RequirementDecision, float]:
    """Simulate campaigns of at most 500 flights; return how large a share ends how."""
    rng = np.random.default_rng(7)
    left: NDArray[np.int64] = np.zeros(CAMPAIGNS, np.int64)
    ends = dict.fromkeys(RequirementDecision, 0.0)
    before = 0
    for look in plan_looks(threshold):
        if look.flights > FLIGHTS:
            break
        left = left + rng.binomial(look.flights - before, 1.0 - rate, left.size)
        before = look.flights
        ends[RequirementDecision.MET] += np.sum(left <= look.few) / CAMPAIGNS
        ends[RequirementDecision.NOT_MET] += np.sum(left >= look.many) / CAMPAIGNS
        left = left[(left > look.few) & (left < look.many)]
    ends[RequirementDecision.UNDECIDED] = left.size / CAMPAIGNS
    return ends


@pytest.mark.parametrize("threshold", [0.95, 0.8, 0.5])
def test_at_the_threshold_hardly_a_campaign_is_judged_falsely(threshold: float) -> None:
    ends = campaigns(threshold, threshold)
    # "meets" is true there, but just below it would not be.
    assert ends[RequirementDecision.NOT_MET] <= 0.5 * ALPHA
    assert ends[RequirementDecision.MET] <= 0.5 * ALPHA
    # As much of the error is used as counts of flights permit: no flights are wasted.
    assert ends[RequirementDecision.NOT_MET] + ends[RequirementDecision.MET] > 0.5 * ALPHA


def test_a_plain_interval_looked_at_as_often_would_be_false_far_more_often() -> None:
    rng = np.random.default_rng(7)
    successes = np.cumsum(rng.random((1000, FLIGHTS)) < 0.95, axis=1)
    n = np.array([look for look in LOOKS if look <= FLIGHTS])
    too_few = np.asarray(stats.binom.cdf(successes[:, n - 1], n, 0.95)) < 0.5 * ALPHA
    assert np.mean(np.any(too_few, axis=1)) > ALPHA


def ends_by_brute_force(
    looks: Sequence[InterimAnalysis], failure_rate: float, decision: RequirementDecision
) -> list[float]:
    """Return the probability that each look decides so: every sequence of flights, one by one."""
    found = [0.0] * len(looks)
    for failed in itertools.product((0, 1), repeat=looks[-1].flights):
        for k, look in enumerate(looks):
            first = look.decide(sum(failed[: look.flights]))
            if first is not RequirementDecision.UNDECIDED:
                if first is decision:
                    failures = sum(failed)
                    found[k] += failure_rate**failures * (1.0 - failure_rate) ** (
                        len(failed) - failures
                    )
                break
    return found


def test_the_error_is_what_all_sequences_of_flights_add_up_to() -> None:
    """Few enough flights to go through all of them; one count more would spend too much."""
    numbers, threshold = (3, 7, 12), 0.6

    def spent(n: int) -> float:
        return 0.2 * n / 12

    looks = list(plan_looks(threshold, numbers, spent))
    assert any(look.few >= 0 for look in looks)
    for decision, change in (
        (RequirementDecision.MET, (1, 0)),
        (RequirementDecision.NOT_MET, (0, -1)),
    ):
        ends = np.cumsum(ends_by_brute_force(looks, 1.0 - threshold, decision))
        for k, look in enumerate(looks):
            assert ends[k] <= spent(look.flights) + 1e-12
            wider = InterimAnalysis(look.flights, look.few + change[0], look.many + change[1])
            more = ends_by_brute_force([*looks[:k], wider], 1.0 - threshold, decision)
            assert sum(more) > spent(look.flights)


@given(threshold=st.floats(0.001, 0.999))
@settings(max_examples=30)
def test_the_first_look_is_a_binomial_test(threshold: float) -> None:
    look = next(plan_looks(threshold))
    failures = np.arange(-1, look.flights + 2)
    few = stats.binom.cdf(failures, look.flights, 1.0 - threshold) <= error_spent(look.flights)
    many = stats.binom.sf(failures - 1, look.flights, 1.0 - threshold) <= error_spent(look.flights)
    assert look.few == failures[few].max()
    assert look.many == failures[many].min()


def test_the_error_that_may_be_spent_grows_and_has_an_end() -> None:
    spent = [error_spent(look) for look in LOOKS]
    assert sorted(spent) == spent
    assert spent[-1] < 0.5 * ALPHA


@pytest.mark.parametrize("threshold", [0.8, 0.9, 0.95])
def test_what_is_far_from_the_threshold_is_soon_decided(threshold: float) -> None:
    assert campaigns(threshold - 0.15, threshold)[RequirementDecision.NOT_MET] > 0.99
    needed = RateTest(threshold).flights_needed(threshold - 0.15)
    assert needed is not None
    assert needed <= 100


def test_the_first_look_that_decides_is_the_verdict() -> None:
    test = RateTest(0.95)
    assert test.decide([False] * 20) is RequirementDecision.NOT_MET
    # Flights for another requirement do not revoke the verdict.
    assert test.decide([False] * 20 + [True] * 980) is RequirementDecision.NOT_MET
    assert test.decide([True] * 1000) is RequirementDecision.MET
    # Only the planned looks count: nineteen failures have not been looked at.
    assert test.decide([False] * 19) is RequirementDecision.UNDECIDED
    assert test.decide([]) is RequirementDecision.UNDECIDED


@pytest.mark.parametrize("rate", [0.6, 0.87, 0.93, 0.97, 1.0])
def test_so_many_flights_of_that_rate_decide(rate: float) -> None:
    test = RateTest(0.95)
    needed = test.flights_needed(rate)
    assert needed is not None
    before = max([look for look in LOOKS if look < needed], default=0)
    expected = RequirementDecision.MET if rate > 0.95 else RequirementDecision.NOT_MET
    assert test.decide(flown(needed, round((1.0 - rate) * needed))) is expected
    assert test.decide(flown(before, round((1.0 - rate) * before))) is RequirementDecision.UNDECIDED
    # Only looks after the flights already flown count.
    later = test.flights_needed(rate, needed)
    assert later is not None
    assert later > needed


def test_a_borderline_rate_says_how_many_flights_it_would_take() -> None:
    needed = RateTest(0.95).flights_needed(0.955)
    assert needed is not None
    # An interval that is looked at once would take 1.96^2 p (1 - p) / 0.005^2 of them.
    assert 7000 < needed < 50_000
    assert RateTest(0.95).flights_needed(0.95) is None


@pytest.mark.parametrize("threshold", [0.0, 1.0, math.nan])
def test_thresholds_that_no_flights_can_show(threshold: float) -> None:
    with pytest.raises(ValueError, match="threshold"):
        RateTest(threshold)


def outcomes(threshold: float, rate: float) -> list[tuple[InterimAnalysis, int, float]]:
    """Return every end of a campaign of at most 100 flights: look, failures, probability."""
    ends, undecided, before = [], {0: 1.0}, 0
    for look in plan_looks(threshold):
        step = look.flights - before
        new = stats.binom.pmf(np.arange(step + 1), step, 1.0 - rate)
        reached: dict[int, float] = {}
        for failures, chance in undecided.items():
            for more, share in enumerate(new):
                reached[failures + more] = reached.get(failures + more, 0.0) + chance * share
        last = look.flights == 100
        undecided, before = {}, look.flights
        for failures, chance in reached.items():
            decided = look.decide(failures) is not RequirementDecision.UNDECIDED
            if decided or last:
                ends.append((look, failures, chance))
            else:
                undecided[failures] = chance
        if last:
            return ends
    raise AssertionError


@functools.cache
def estimate_at(threshold: float, look: InterimAnalysis, failures: int) -> Estimate:
    """Return the estimate of a campaign that ended so; only its looks count."""
    path = flown(look.flights, failures)
    test = RateTest(threshold)
    looks = list(plan_looks(threshold, [n for n in LOOKS if n <= look.flights]))
    # The order of the flights: undecided at every look before the last one.
    sums, before = [], 0
    for each in looks[:-1]:
        low = max(before, each.few + 1, failures - (look.flights - each.flights))
        before = min(max(low, sum(not ok for ok in path[: each.flights])), each.many - 1, failures)
        sums.append(before)
    ends = [*zip([each.flights for each in looks[:-1]], sums, strict=True)]
    ordered: list[bool] = []
    for (n, k), (m, j) in itertools.pairwise([(0, 0), *ends, (look.flights, failures)]):
        ordered += [False] * (j - k) + [True] * (m - n - (j - k))
    return test.estimate(ordered)


@pytest.mark.parametrize("threshold", [0.95, 0.8])
def test_the_interval_covers_after_the_stop_where_wilsons_does_not(threshold: float) -> None:
    """Summed over all campaigns, not simulated."""
    rates = [threshold - 0.1, threshold - 0.05, threshold, threshold + 0.02]
    wilsons = []
    for rate in rates:
        covered = by_wilson = total = 0.0
        for look, failures, chance in outcomes(threshold, rate):
            if chance < 1e-5:
                continue
            found = estimate_at(threshold, look, failures)
            assert found.n == look.flights
            assert found.value == pytest.approx(1.0 - failures / look.flights)
            plain = wilson(look.flights - failures, look.flights)
            total += chance
            covered += chance * (found.low <= rate <= found.high)  # type: ignore[operator]
            by_wilson += chance * (plain.low <= rate <= plain.high)  # type: ignore[operator]
        assert total == pytest.approx(1.0, abs=2e-3)
        assert covered >= 0.95
        wilsons.append(by_wilson)
    assert min(wilsons) < 0.93


def test_the_interval_says_what_the_test_decides() -> None:
    test = RateTest(0.95)
    for rate in (0.5, 0.85, 0.9, 0.92, 0.94, 0.95, 0.96, 0.975, 0.99, 1.0):
        for n in (0, 7, 20, 60, 100, 300, 500, 730):
            path = flown(n, round((1.0 - rate) * n))
            decision, found = test.decide(path), test.estimate(path)
            if not n:
                assert found.value is None
                continue
            if n < LOOKS[0]:
                assert (found.n, found.low) == (n, None)
                continue
            assert found.n in LOOKS
            assert found.low is not None
            assert found.high is not None
            assert found.low <= (found.value or 0.0) <= found.high
            assert (found.low >= 0.95) == (decision is RequirementDecision.MET)
            assert (found.high <= 0.95) == (decision is RequirementDecision.NOT_MET)


def test_two_policies_that_are_alike_are_rarely_told_apart() -> None:
    """Simulate pairs up to 500: one campaign in twenty may exclude the true gap at any look."""
    rng = np.random.default_rng(11)
    looks = [look for look in LOOKS if look <= FLIGHTS]
    wrong, decided = 0, 0
    for _ in range(120):
        kinds = rng.choice(4, FLIGHTS, p=[0.82, 0.08, 0.08, 0.02])
        for n in looks:
            table = np.bincount(kinds[:n], minlength=4)
            found = anytime_gap(Agreement(*map(int, table)))
            if found.low > 0.0 or found.high < 0.0:  # type: ignore[operator]
                wrong += 1
                break
        kinds = rng.choice(4, FLIGHTS, p=[0.80, 0.02, 0.16, 0.02])
        decided += anytime_gap(Agreement(*map(int, np.bincount(kinds, minlength=4)))).low > 0.0  # type: ignore[operator]
    assert wrong <= 0.05 * 120
    assert decided > 0.95 * 120
