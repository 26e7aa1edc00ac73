from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from airl_mav.flight.bootstrap import bca_interval, binomial_quantile
from tests.support.processes import run_alone

RESAMPLES = 500


@pytest.mark.parametrize("n", [2, 3, 10, 257])
@pytest.mark.parametrize("confidence", [0.5, 0.95])
def test_the_interval_of_a_mean_is_scipys(n: int, confidence: float) -> None:
    values = np.random.default_rng(n).lognormal(1.0, 0.8, n)
    low, high = bca_interval(
        lambda drawn: values[drawn].mean(axis=-1),
        n,
        confidence=confidence,
        resamples=RESAMPLES,
        rng=np.random.default_rng(5),
    )
    theirs = stats.bootstrap(
        (values,),
        np.mean,
        confidence_level=confidence,
        n_resamples=RESAMPLES,
        rng=np.random.default_rng(5),
        method="BCa",
    ).confidence_interval
    assert (low, high) == pytest.approx((theirs.low, theirs.high), rel=1e-12)


def test_the_interval_of_any_figure_is_scipys() -> None:
    values = np.random.default_rng(3).gamma(2.0, 3.0, 40)
    low, high = bca_interval(
        lambda drawn: np.std(values[drawn], axis=-1),
        40,
        confidence=0.9,
        resamples=RESAMPLES,
        rng=np.random.default_rng(6),
    )
    theirs = stats.bootstrap(
        (values,),
        np.std,
        confidence_level=0.9,
        n_resamples=RESAMPLES,
        rng=np.random.default_rng(6),
        method="BCa",
    ).confidence_interval
    assert (low, high) == pytest.approx((theirs.low, theirs.high), rel=1e-12)


def test_values_that_do_not_differ_have_no_interval() -> None:
    ends = bca_interval(
        lambda drawn: np.ones(len(drawn)),
        5,
        confidence=0.95,
        resamples=10,
        rng=np.random.default_rng(1),
    )
    assert all(math.isnan(end) for end in ends)


@pytest.mark.parametrize("probability", [0.1, 0.5, 0.87])
@pytest.mark.parametrize("level", [1e-6, 0.025, 0.4, 0.975])
def test_quantiles_of_the_binomial_distribution_are_scipys(
    level: float, probability: float
) -> None:
    numbers = [*range(1, 60), 100, 1000, 20_000]
    mine = [binomial_quantile(level, n, probability) for n in numbers]
    assert mine == [int(stats.binom.ppf(level, n, probability)) for n in numbers]


def test_the_figures_of_a_run_do_without_the_module_of_statistics(tmp_path: Path) -> None:
    done = run_alone(PROGRAM, tmp_path)
    assert done.returncode == 0, done.stderr


PROGRAM = """
import sys
from airl_mav.flight.paired import compare_means
from airl_mav.flight.statistics import bootstrap_mean, median_of
assert bootstrap_mean([1.0, 2.0, 4.0]).low < 7.0 / 3.0
assert median_of([1.0, 2.0, 4.0]).value == 2.0
assert compare_means([1.0, 2.0, 4.0], [2.0, 3.0, 5.0]).difference.value > 0.0
assert "scipy.stats" not in sys.modules
"""
