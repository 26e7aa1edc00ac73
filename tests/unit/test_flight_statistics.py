from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import scipy
from numpy.typing import NDArray

from airl_mav.flight.episode_record import EpisodeRecord
from airl_mav.flight.judge import Outcome
from airl_mav.flight.statistics import (
    Agreement,
    Estimate,
    aggregate,
    anytime_gap,
    anytime_mean,
    median_of,
    tango,
    wilson,
)
from tests.support.run_demo import demo_arena, demo_episode


@pytest.mark.parametrize(("k", "n"), [(0, 5), (5, 5), (3, 10), (91, 100)])
def test_wilson_is_the_closed_form(k: int, n: int) -> None:
    """Roots of (p - k/n)² = z² p (1 - p) / n."""
    z = 1.959963984540054
    centre = (k / n + z * z / (2 * n)) / (1 + z * z / n)
    half = z / (1 + z * z / n) * math.sqrt(k / n * (1 - k / n) / n + z * z / (4 * n * n))
    estimate = wilson(k, n)
    assert (estimate.value, estimate.n) == (k / n, n)
    assert estimate.low == pytest.approx(centre - half, abs=1e-12)
    assert estimate.high == pytest.approx(centre + half, abs=1e-12)
    theirs = scipy.stats.binomtest(k, n).proportion_ci(0.95, method="wilson")
    assert (estimate.low, estimate.high) == (theirs.low, theirs.high)


def coverage(draws: NDArray[np.float64], truth: float) -> float:
    """Return the percentage of rows (m, n) whose median's interval contains the truth."""
    ends = [(e.low, e.high) for e in map(median_of, draws)]
    return 100.0 * float(np.mean([low <= truth <= high for low, high in ends]))  # type: ignore[operator]


@pytest.mark.parametrize("n", [10, 30, 100])
@pytest.mark.parametrize("kind", ["lognormal", "exponential", "rare long flights"])
def test_the_median_covers_skewed_times(n: int, kind: str) -> None:
    rng = np.random.default_rng(n)
    m = 1500
    kinds: dict[str, Callable[[], NDArray[np.float64]]] = {
        "lognormal": lambda: rng.lognormal(2.0, 0.6, (m, n)),
        "exponential": lambda: rng.exponential(8.0, (m, n)),
        "rare long flights": lambda: np.where(
            rng.random((m, n)) < 0.005, 90.0, rng.lognormal(2.0, 0.2, (m, n))
        ),
    }
    draws = kinds[kind]()
    rare = 0.5 / 0.995
    truth = {
        "lognormal": math.exp(2.0),
        "exponential": 8.0 * math.log(2.0),
        "rare long flights": math.exp(2.0 + 0.2 * scipy.special.ndtri(rare)),
    }[kind]
    # Two standard errors of 1,500 samples are 1.1 %.
    assert coverage(draws, truth) == pytest.approx(95.0, abs=1.7)


def test_no_interval_of_a_mean_covers_rare_long_flights() -> None:
    """Six in ten samples of 100 lack a flight of the 0.5 %: they know nothing of the mean."""
    rng = np.random.default_rng(1)
    draws = np.where(rng.random((4000, 100)) < 0.005, 90.0, rng.normal(8.0, 1.0, (4000, 100)))
    truth = 0.995 * 8.0 + 0.005 * 90.0
    mean, error = draws.mean(axis=1), draws.std(axis=1, ddof=1) / 10.0
    t = scipy.stats.t.ppf(0.975, 99)
    covered = np.abs(mean - truth) <= t * error
    assert covered.mean() < 0.6
    assert (draws.max(axis=1) < 90.0).mean() == pytest.approx(0.995**100, abs=0.03)


@pytest.mark.parametrize("n", [6, 10, 37, 1000])
def test_the_medians_interval_is_the_papers_interpolation(n: int) -> None:
    """Hettmansperger and Sheather 1986, equation 5, with scipy's binomial."""
    values = np.sort(np.random.default_rng(n).gamma(2.0, 3.0, n))
    d = int(scipy.stats.binom.ppf(0.025, n, 0.5))
    gamma = [1.0 - 2.0 * scipy.stats.binom.cdf(k - 1, n, 0.5) for k in (d, d + 1)]
    assert gamma[0] >= 0.95 > gamma[1]
    part = (gamma[0] - 0.95) / (gamma[0] - gamma[1])
    weight = (n - d) * part / (d + (n - 2 * d) * part)
    found = median_of(values)
    assert found.value == np.median(values)
    assert found.low == pytest.approx((1.0 - weight) * values[d - 1] + weight * values[d])
    assert found.high == pytest.approx((1.0 - weight) * values[n - d] + weight * values[n - d - 1])


def test_few_values_have_no_interval() -> None:
    assert median_of([]).value is None
    few = median_of([3.0, 1.0, 2.0, 9.0, 4.0])
    assert (few.value, few.low, few.high, few.n) == (3.0, None, None, 5)
    same = median_of([2.0] * 6)
    assert (same.value, same.low, same.high) == (2.0, 2.0, 2.0)
    assert wilson(0, 0).value is None


def test_wilson_covers_on_average_and_never_far_below() -> None:
    """Summed over all counts; a rate of whole flights cannot cover 95 % at each rate."""
    rates = np.linspace(0.05, 0.95, 181)
    for n in (10, 30, 100):
        ends = [wilson(k, n) for k in range(n + 1)]
        low, high = np.array([[e.low, e.high] for e in ends], float).T
        inside = (low[:, None] <= rates) & (rates <= high[:, None])
        chance = scipy.stats.binom.pmf(np.arange(n + 1)[:, None], n, rates)
        covered = (inside * chance).sum(axis=0)
        assert covered.mean() == pytest.approx(0.95, abs=0.015)
        assert covered.min() > 0.83


def test_a_bounded_mean_covers_at_every_stop() -> None:
    """Stop as soon as the interval excludes the truth: that happens in at most 5 % of runs."""
    rng = np.random.default_rng(3)
    wrong = 0
    for _ in range(100):
        shares = rng.choice([0.0, 0.2, 0.5], 300, p=[0.9, 0.08, 0.02])
        ends = [anytime_mean(shares[:n]) for n in range(10, 301, 10)]
        wrong += any(not e.low <= 0.026 <= e.high for e in ends)  # type: ignore[operator]
    assert wrong <= 5


def test_an_interval_of_zeros_has_a_width() -> None:
    found = anytime_mean(np.zeros(100))
    assert (found.value, found.low) == (0.0, 0.0)
    assert found.high == pytest.approx(0.052, abs=0.001)
    assert anytime_mean([]).value is None
    ones = anytime_mean(np.ones(100))
    assert ones.low == pytest.approx(1.0 - (found.high or 0.0))
    assert ones.high == 1.0


def anytime_difference(gained: int, lost: int, n: int) -> Estimate:
    return anytime_gap(Agreement(n - gained - lost, lost, gained, 0)).scaled(0.01)


def test_the_anytime_difference_excludes_zero_with_the_beta_binomial_e_process() -> None:
    """Against zero, the mixture of bets is Robbins' one on the discordant pairs."""
    for gained in range(26):
        for lost in range(gained):
            found = anytime_difference(gained, lost, gained + lost + 40)
            assert found.low is not None
            # Integral of (1 + u)^gained (1 - u)^lost over a uniform stake.
            wealth = scipy.integrate.quad(lambda u: (1 + u) ** gained * (1 - u) ** lost, 0, 1)[0]  # noqa: B023
            if abs(wealth / 40.0 - 1.0) > 0.05:
                assert (found.low > 0.0) == (wealth > 40.0), (gained, lost)


def test_an_anytime_difference_is_wider_than_one_of_a_fixed_number() -> None:
    for gained, lost, n in ((0, 0, 50), (8, 0, 20), (30, 10, 300), (3, 9, 40)):
        anytime, fixed = anytime_difference(gained, lost, n), tango(gained, lost, n)
        assert anytime.value == pytest.approx(fixed.value)
        assert anytime.low < fixed.low < fixed.high < anytime.high  # type: ignore[operator]
        back = anytime_difference(lost, gained, n)
        assert back.low == pytest.approx(-(anytime.high or 0.0), abs=1e-5)
    assert anytime_difference(0, 0, 0).value is None


@pytest.fixture(scope="module")
def episode() -> EpisodeRecord:
    record, _, _ = demo_episode(1, demo_arena(2))
    assert record.outcome is Outcome.SUCCESS
    return record


def test_only_successes_enter_the_medians_and_invalid_flights_nothing(
    episode: EpisodeRecord,
) -> None:
    assert episode.quality is not None
    longer = replace(episode.quality, flight_time_s=episode.quality.flight_time_s + 2.0)
    absurd = replace(episode.quality, flight_time_s=1e6, distance_m=1e6, energy_j=1e9)
    figures = aggregate(
        [
            episode,
            replace(episode, quality=longer),
            replace(episode, outcome=Outcome.COLLISION, quality=absurd),
            replace(episode, outcome=Outcome.ABORTED, quality=absurd),
            replace(episode, outcome=Outcome.TIMEOUT, quality=None),
            replace(episode, quality=absurd, invalid=("the host was busy",)),
        ]
    )
    # The aborted one did not reach its goal.
    assert figures.success_rate.value == 0.4
    assert figures.success_rate.n == 5
    assert figures.flight_time_s.value == pytest.approx(episode.quality.flight_time_s + 1.0)
    assert figures.flight_time_s.n == 2
    assert figures.distance_m.value == pytest.approx(episode.quality.distance_m)
    assert figures.outcomes == {
        Outcome.SUCCESS: 2,
        Outcome.COLLISION: 1,
        Outcome.TIMEOUT: 1,
        Outcome.BATTERY: 0,
        Outcome.ABORTED: 1,
    }


def test_no_flight_at_all_has_no_figures() -> None:
    figures = aggregate([])
    assert figures.success_rate.value is None
    assert figures.energy_j.value is None
