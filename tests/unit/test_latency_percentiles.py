from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from airl_mav.latency.stages import MIN_SAMPLES, percentile, summarize


@pytest.mark.parametrize("p", [90.0, 95.0, 99.0, 99.9])
def test_the_floors_are_the_early_stopping_rule(p: float) -> None:
    """Fewest n with P(at most one of n samples over the bound) <= 1 %, were the bound too low."""
    n = 2
    while stats.binom.cdf(1, n, 1.0 - p / 100.0) > 0.01:
        n += 1
    assert MIN_SAMPLES[p] == n


@pytest.mark.parametrize("p", [50.0, 90.0, 99.0, 99.9])
def test_below_the_floor_there_is_no_percentile(p: float) -> None:
    floor = MIN_SAMPLES[p]
    assert percentile(np.arange(floor - 1), p) is None
    assert percentile(np.arange(floor), p) is not None


@given(st.lists(st.integers(0, 10**9), min_size=1, max_size=300), st.sampled_from([50.0, 90.0]))
def test_percentiles_are_nearest_rank(values: list[int], p: float) -> None:
    if len(values) < MIN_SAMPLES[p]:
        return
    rank = math.ceil(p / 100.0 * len(values))
    assert percentile(values, p) == sorted(values)[rank - 1]


def test_a_summary_says_what_it_can() -> None:
    values = np.random.default_rng(0).gamma(3.0, 1000.0, 662).astype(np.int64)
    s = summarize(values)
    assert (s.n, s.max) == (662, values.max())
    assert s.mean == pytest.approx(float(np.sum(values)) / 662)
    assert s.p50 is not None
    assert s.p90 is not None
    assert s.p99 is not None
    assert s.p50 < s.p90 < s.p99 <= values.max()
    assert s.p999 is None


def test_nothing_has_no_summary() -> None:
    s = summarize([])
    assert s.n == 0
    assert {s.mean, s.p50, s.p90, s.p99, s.p999, s.max} == {None}
