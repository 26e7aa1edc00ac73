"""Differences on the same seeds, against published values, closed forms and exact coverage."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import optimize, stats

from airl_mav.flight.episode_record import EpisodeRecord
from airl_mav.flight.judge import Outcome
from airl_mav.flight.statistics import (
    Agreement,
    common_successes,
    compare_pairs,
    count_agreement,
    median_ratio,
    pair_by_seed,
    tango,
)
from tests.support.run_demo import demo_arena, demo_episode

Z = 1.959963984540054

# --- the interval of paired proportions


def test_tangos_interval_is_the_published_one() -> None:
    """Cavo et al. (2012) as in Fagerland, Lydersen and Laake, Statistical Analysis of Contingency
    Tables (2017), chapter 8: 59, 6, 16, 80. Its R package contingencytables prints -0.0621
    (-0.1240 to -0.0054); there the first minus the second."""
    estimate = tango(gained=6, lost=16, n=161)
    assert estimate.n == 161
    assert estimate.value == pytest.approx(-0.0621, abs=5e-5)
    assert estimate.low == pytest.approx(-0.1240, abs=5e-5)
    assert estimate.high == pytest.approx(-0.0054, abs=5e-5)


@pytest.mark.parametrize("n", [1, 7, 30, 500])
def test_where_no_pair_differs_the_limits_are_a_closed_form(n: int) -> None:
    """No losses: the score -sqrt(n d / (1 - d)) is -z at d = z² / (n + z²)."""
    estimate = tango(0, 0, n)
    assert estimate.value == 0.0
    assert estimate.high == pytest.approx(Z * Z / (n + Z * Z), abs=1e-9)
    assert estimate.low == pytest.approx(-Z * Z / (n + Z * Z), abs=1e-9)


def test_where_all_pairs_differ_alike() -> None:
    assert tango(8, 0, 8).high == 1.0
    assert tango(0, 8, 8).low == -1.0


def score_by_search(d: float, gained: int, lost: int, n: int) -> float:
    """Return Tango's score with the likeliest probability of a loss searched for, not solved."""

    def unlikely(q: float) -> float:
        cells = ((gained, q + d), (lost, q), (n - gained - lost, 1.0 - 2.0 * q - d))
        return -sum(count * math.log(p) for count, p in cells if count)

    low, high = max(0.0, -d), (1.0 - d) / 2.0
    found = optimize.minimize_scalar(
        unlikely,
        bounds=(low + 1e-12, high - 1e-12),
        method="bounded",
        options={"xatol": 1e-12},
    )
    q = float(found.x)
    return (gained - lost - n * d) / math.sqrt(n * (2.0 * q + d - d * d))


@pytest.mark.parametrize(
    ("gained", "lost", "n"), [(1, 7, 21), (3, 5, 30), (6, 16, 161), (12, 4, 500), (20, 30, 60)]
)
def test_at_the_limits_the_score_is_z(gained: int, lost: int, n: int) -> None:
    estimate = tango(gained, lost, n)
    assert estimate.low is not None
    assert estimate.high is not None
    assert score_by_search(estimate.low, gained, lost, n) == pytest.approx(Z, abs=1e-4)
    assert score_by_search(estimate.high, gained, lost, n) == pytest.approx(-Z, abs=1e-4)


def test_the_interval_says_what_mcnemars_test_says() -> None:
    for n in range(1, 16):
        for gained in range(n + 1):
            for lost in range(n + 1 - gained):
                estimate = tango(gained, lost, n)
                assert estimate.low is not None
                assert estimate.high is not None
                assert -1.0 <= estimate.low <= (estimate.value or 0.0) <= estimate.high <= 1.0
                differ = gained + lost
                p = stats.chi2.sf((gained - lost) ** 2 / differ, 1) if differ else 1.0
                assert (estimate.low > 0.0 or estimate.high < 0.0) == (p < 0.05)


@given(st.integers(0, 300), st.integers(0, 300), st.integers(0, 300))
def test_the_other_way_round_is_the_other_sign(gained: int, lost: int, same: int) -> None:
    n = gained + lost + same
    one, other = tango(gained, lost, n), tango(lost, gained, n)
    if n == 0:
        assert one.value is one.low is one.high is None
        return
    assert (one.low, one.high) != (None, None)
    assert one.low == pytest.approx(-(other.high or 0.0), abs=1e-9)
    assert one.high == pytest.approx(-(other.low or 0.0), abs=1e-9)


def test_coverage_over_all_tables() -> None:
    """Summed over every table of 50 pairs that there can be, not simulated."""
    n, p_gain, p_loss = 50, 0.04, 0.08
    covered = 0.0
    for gained in range(20):
        for lost in range(25):
            chance = stats.multinomial.pmf(
                [gained, lost, n - gained - lost], n, [p_gain, p_loss, 1.0 - p_gain - p_loss]
            )
            if chance > 1e-9:
                estimate = tango(gained, lost, n)
                assert estimate.low is not None
                assert estimate.high is not None
                covered += chance * (estimate.low <= p_gain - p_loss <= estimate.high)
    assert 0.94 < covered < 0.98


def test_tables_that_cannot_be() -> None:
    for gained, lost, n in ((3, 3, 5), (-1, 0, 5)):
        with pytest.raises(ValueError, match="must be >= 0 and fit"):
            tango(gained, lost, n)


# --- the median of the pairs


def pairs(n: int, seed: int = 4) -> tuple[np.ndarray, np.ndarray]:
    """Flights that differ by a factor of three among seeds, and by 2 % between the runs."""
    rng = np.random.default_rng(seed)
    first = rng.uniform(5.0, 15.0, n)
    return first, first * rng.normal(1.02, 0.04, n)


def test_pairs_take_out_the_spread_of_the_seeds() -> None:
    first, second = pairs(40)
    paired = median_ratio(first, second)
    shuffled = median_ratio(first, np.random.default_rng(0).permutation(second))
    assert paired.low is not None
    assert paired.high is not None
    assert paired.low < 2.0 < paired.high
    assert shuffled.high is not None
    assert shuffled.low is not None
    assert shuffled.high - shuffled.low > 4.0 * (paired.high - paired.low)


def test_pairs_of_one_ratio_have_an_interval_without_width() -> None:
    first, _ = pairs(25)
    for factor in (1.0, 1.1):
        same = median_ratio(first, factor * first)
        assert same.low == pytest.approx(100.0 * (factor - 1.0))
        assert same.high == pytest.approx(100.0 * (factor - 1.0))


# --- runs


@pytest.fixture(scope="module")
def flight() -> EpisodeRecord:
    return demo_episode(0, demo_arena(1))[0]


def flown(flight: EpisodeRecord, seed: int, outcome: Outcome, scale: float = 1.0) -> EpisodeRecord:
    quality = flight.quality
    assert quality is not None
    return replace(
        flight,
        seed=seed,
        index=seed % 3,
        outcome=outcome,
        # Aborted by the host.
        invalid=("the host was busy",) if outcome is NOT else (),
        quality=replace(
            quality,
            flight_time_s=10.0 * scale * seed,
            distance_m=30.0 * seed,
            energy_j=5000.0 * seed / scale,
        ),
    )


GOOD, BAD, NOT = Outcome.SUCCESS, Outcome.COLLISION, Outcome.ABORTED


@pytest.fixture(scope="module")
def runs(flight: EpisodeRecord) -> tuple[list[EpisodeRecord], list[EpisodeRecord]]:
    """A reference of seeds 1 to 8, and a run of seeds 2 to 9 in another order."""
    ends = dict(zip(range(1, 9), (GOOD, GOOD, GOOD, BAD, BAD, GOOD, NOT, GOOD), strict=True))
    others = dict(zip(range(9, 1, -1), (GOOD, NOT, GOOD, GOOD, BAD, GOOD, BAD, GOOD), strict=True))
    return (
        [flown(flight, seed, outcome) for seed, outcome in ends.items()],
        [flown(flight, seed, outcome, 1.0 + 0.1 * seed) for seed, outcome in others.items()],
    )


def test_pairs_are_of_one_seed_and_none_of_them_is_invalid(
    runs: tuple[list[EpisodeRecord], list[EpisodeRecord]],
) -> None:
    paired = pair_by_seed(*runs)
    # 1 and 9 fly once, 7 and 8 were invalid once.
    assert [(a.seed, b.seed) for a, b in paired] == [(s, s) for s in (2, 3, 4, 5, 6)]
    assert all(a in runs[0] and b in runs[1] for a, b in paired)


def test_a_comparison_by_hand(runs: tuple[list[EpisodeRecord], list[EpisodeRecord]]) -> None:
    paired = pair_by_seed(*runs)
    # 2 and 6: both. 3: the reference alone. 4: the other alone. 5: neither.
    assert count_agreement(paired) == Agreement(2, 1, 1, 1)
    assert len(common_successes(paired)) == 2
    found = compare_pairs(*runs)
    assert found.agreement.n == 5
    assert found.success_rate.reference == found.success_rate.other == pytest.approx(3 / 5)
    by_points = tango(1, 1, 5)
    assert found.success_rate.difference.value == 0.0
    assert found.success_rate.difference.high == pytest.approx(100.0 * (by_points.high or 0.0))
    assert found.flight_time_s.reference == pytest.approx((20.0 + 60.0) / 2)
    assert found.flight_time_s.other == pytest.approx((20.0 * 1.2 + 60.0 * 1.6) / 2)
    assert found.flight_time_s.difference.value == pytest.approx(40.0)  # between 20 and 60 %
    assert found.distance_m.difference.value == pytest.approx(0.0)
    energy = (10_000 / 1.2 + 30_000 / 1.6) / 2
    assert found.energy_j.other == pytest.approx(energy)
    assert found.energy_j.difference.value == pytest.approx(50.0 * (1 / 1.2 + 1 / 1.6) - 100.0)
    assert found.energy_j.difference.n == found.flight_time_s.difference.n == 2


def test_runs_without_common_seeds_or_successes(flight: EpisodeRecord) -> None:
    apart = compare_pairs([flown(flight, 1, GOOD)], [flown(flight, 2, GOOD)])
    assert apart.agreement.n == apart.success_rate.difference.n == 0
    assert apart.success_rate.reference is apart.success_rate.difference.value is None
    failed = compare_pairs([flown(flight, 1, GOOD)], [flown(flight, 1, BAD)])
    assert failed.success_rate.difference.value == -100.0
    assert failed.success_rate.difference.n == 1
    assert failed.flight_time_s.reference is failed.flight_time_s.difference.value is None


def test_a_seed_that_is_there_twice(flight: EpisodeRecord) -> None:
    once = [flown(flight, 1, GOOD)]
    with pytest.raises(ValueError, match="twice"):
        pair_by_seed(once, once * 2)
    # Invalid, and flown again.
    assert len(pair_by_seed(once, [flown(flight, 1, NOT), *once])) == 1
