from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from scipy import stats
from scipy.optimize import brentq

from airl_mav.latency.injection import FixedSampler, LatencySampler, ReplaySampler, build_sampler
from airl_mav.profiles.computer import LatencyDistribution

N = 20_000


def draws(latency: LatencyDistribution, seed: int = 5, n: int = N) -> np.ndarray:
    sampler: LatencySampler = build_sampler(latency, np.random.default_rng(seed))
    return np.array([sampler.sample_us() for _ in range(n)])


def scipy_lognormal_us(mean_ms: float, std_ms: float, min_ms: float) -> Any:
    """scipy's log-normal of given moments; its shape by root finding, not by our formula."""
    over = 1e3 * (mean_ms - min_ms)
    ratio = 1e3 * std_ms / over
    shape = brentq(lambda s: stats.lognorm.std(s) / stats.lognorm.mean(s) - ratio, 1e-4, 5.0)
    return stats.lognorm(shape, loc=1e3 * min_ms, scale=over / stats.lognorm.mean(shape))


@pytest.mark.parametrize(
    ("mean_ms", "std_ms", "min_ms"), [(396.0, 19.8, 0.0), (10.0, 8.0, 0.0), (12.0, 3.0, 9.0)]
)
def test_lognormal_is_scipys(mean_ms: float, std_ms: float, min_ms: float) -> None:
    latency = LatencyDistribution(
        distribution="lognormal", mean_ms=mean_ms, std_ms=std_ms, min_ms=min_ms
    )
    values = draws(latency)
    expected = scipy_lognormal_us(mean_ms, std_ms, min_ms)
    assert expected.mean() == pytest.approx(1e3 * mean_ms)
    assert expected.std() == pytest.approx(1e3 * std_ms)
    assert stats.kstest(values, expected.cdf).pvalue > 0.01
    assert values.mean() == pytest.approx(1e3 * mean_ms, abs=4e3 * std_ms / math.sqrt(N))
    assert values.min() >= 1e3 * min_ms


def test_truncated_normal_is_scipys() -> None:
    latency = LatencyDistribution(
        distribution="normal-truncated", mean_ms=10.0, std_ms=4.0, min_ms=8.0
    )
    expected = stats.truncnorm((8.0 - 10.0) / 4.0, np.inf, loc=10e3, scale=4e3)
    values = draws(latency)
    assert stats.kstest(values, expected.cdf).pvalue > 0.01
    assert values.min() >= 8_000


def test_samples_come_back_with_their_own_frequencies() -> None:
    latency = LatencyDistribution(distribution="samples", samples_ms=(1.0, 2.5, 2.5, 7.125))
    values, counts = np.unique(draws(latency), return_counts=True)
    assert values.tolist() == [1_000, 2_500, 7_125]
    assert stats.chisquare(counts, N * np.array([0.25, 0.5, 0.25])).pvalue > 0.01


@pytest.mark.parametrize(
    "latency",
    [
        LatencyDistribution(distribution="fixed", mean_ms=150.0),
        LatencyDistribution(distribution="lognormal", mean_ms=150.0, std_ms=0.0),
        LatencyDistribution(distribution="normal-truncated", mean_ms=150.0, std_ms=0.0),
    ],
)
def test_no_spread_is_a_constant(latency: LatencyDistribution) -> None:
    assert set(draws(latency, n=20).tolist()) == {150_000}


@pytest.mark.parametrize("distribution", ["lognormal", "normal-truncated"])
def test_the_seed_decides(distribution: str) -> None:
    latency = LatencyDistribution.model_validate(
        {"distribution": distribution, "mean_ms": 40.0, "std_ms": 5.0}
    )
    assert np.array_equal(draws(latency, 1, 50), draws(latency, 1, 50))
    assert not np.array_equal(draws(latency, 1, 50), draws(latency, 2, 50))


def test_latencies_are_plain_integers() -> None:
    sampler = build_sampler(
        LatencyDistribution(distribution="samples", samples_ms=(1.0,)), np.random.default_rng(0)
    )
    assert type(sampler.sample_us()) is int


def test_a_sample_file_nobody_read_is_an_error() -> None:
    latency = LatencyDistribution(distribution="samples", samples_file="laps.txt")
    with pytest.raises(ValueError, match=r"laps\.txt not read"):
        build_sampler(latency, np.random.default_rng(0))


def test_impossible_samplers_are_refused() -> None:
    with pytest.raises(ValueError, match=">= 0"):
        FixedSampler(-1)
    with pytest.raises(ValueError, match="no samples"):
        ReplaySampler([], np.random.default_rng(0))


def test_no_latency_is_a_latency() -> None:
    assert FixedSampler(0).sample_us() == 0
    with pytest.raises(ValueError, match="latency_us=-1: must be >= 0"):
        FixedSampler(-1)
