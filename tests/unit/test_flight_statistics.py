from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import scipy

from airl_mav.flight.episode_record import EpisodeRecord
from airl_mav.flight.judge import Outcome
from airl_mav.flight.statistics import (
    BOOTSTRAP_SEED,
    RESAMPLES,
    aggregate,
    bootstrap_mean,
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


def test_the_bootstrap_of_many_values_is_the_normal_interval() -> None:
    values = np.random.default_rng(2).normal(25.0, 4.0, 400)
    estimate = bootstrap_mean(values)
    half = 1.96 * values.std(ddof=1) / math.sqrt(400)
    assert estimate.value == pytest.approx(values.mean())
    assert estimate.low == pytest.approx(values.mean() - half, abs=0.1 * half)
    assert estimate.high == pytest.approx(values.mean() + half, abs=0.1 * half)
    assert bootstrap_mean(values) == estimate


@pytest.mark.parametrize("n", [2, 3, 10, 200])
def test_the_bootstrap_interval_is_scipys(n: int) -> None:
    for values in (
        np.random.default_rng(n).gamma(0.5, 3.0, n),
        np.where(np.arange(n) == 0, 70.0, 8.0),
    ):
        mine = bootstrap_mean(values)
        theirs = scipy.stats.bootstrap(
            (values,),
            np.mean,
            n_resamples=RESAMPLES,
            rng=np.random.default_rng(BOOTSTRAP_SEED),
            method="BCa",
        ).confidence_interval
        assert mine.low == pytest.approx(theirs.low, rel=1e-9)
        assert mine.high == pytest.approx(theirs.high, rel=1e-9)


def test_too_few_values_to_resample() -> None:
    assert bootstrap_mean([]).value is None
    one = bootstrap_mean([3.0])
    assert (one.value, one.low, one.high, one.n) == (3.0, None, None, 1)
    same = bootstrap_mean([2.0, 2.0, 2.0])
    assert (same.value, same.low, same.high) == (2.0, 2.0, 2.0)
    two = bootstrap_mean([1.0, 3.0])
    assert two.low is not None
    assert two.high is not None
    assert 1.0 <= two.low < two.high <= 3.0
    assert wilson(0, 0).value is None


@pytest.fixture(scope="module")
def episode() -> EpisodeRecord:
    record, _, _ = demo_episode(1, demo_arena(2))
    assert record.outcome is Outcome.SUCCESS
    return record


def test_only_successes_enter_the_means_and_invalid_flights_nothing(
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
