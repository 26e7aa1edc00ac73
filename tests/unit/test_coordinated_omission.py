"""Coordinated omission: a stall weighs as long as it lasts."""

from __future__ import annotations

import numpy as np
import pytest

from airl_mav.latency.stages import (
    CommandAges,
    ages_in_closed_loop,
    autocorrelation,
    command_ages,
    corrected,
    integrated_time,
)

MS = 1_000


def hdr_corrected(samples: list[int], interval: int) -> list[int]:
    """HdrHistogram's recordValueWithExpectedInterval, word for word."""
    out = []
    for value in samples:
        out.append(value)
        if value > interval:
            missing = value - interval
            while missing >= interval:
                out.append(missing)
                missing -= interval
    return out


@pytest.mark.parametrize("seed", range(5))
def test_correction_is_that_of_hdrhistogram(seed: int) -> None:
    rng = np.random.default_rng(seed)
    samples = [*rng.integers(1, 1_000, 50).tolist(), 100, 200, 250]
    assert sorted(corrected(samples, 100).tolist()) == sorted(hdr_corrected(samples, 100))


def test_a_stall_stands_for_the_decisions_that_it_kept_from_beginning() -> None:
    # 2 s in a loop of 0.1 s: 2.0, 1.9, ... 0.1 s.
    found = corrected([2_000 * MS], 100 * MS)
    assert found.tolist() == [k * 100 * MS for k in range(20, 0, -1)]


def test_short_samples_stay_as_they_are() -> None:
    assert corrected([5, 99, 100], 100).tolist() == [5, 99, 100]
    assert corrected([], 100).size == 0
    with pytest.raises(ValueError, match="expected_us=0"):
        corrected([1], 0)


def test_a_stall_weighs_as_much_as_it_lasts() -> None:
    # 100 commands 0.1 s apart, seen 20 ms before; the 50th is flown for 2 s more.
    sent = np.arange(101) * 100 * MS
    sent[50:] += 2_000 * MS
    ages = command_ages(sent - 20 * MS, sent)
    assert ages.time_us == 12_000 * MS
    # 99 commands are up to 120 ms old; the late one is older than that for 2 of 12 s.
    assert ages.quantile(1.0 - 2.0 / 12.0) == pytest.approx(120 * MS)
    assert ages.quantile(1.0) == 2_120 * MS
    assert ages.quantile(1.0 - 1.0 / 12.0) == pytest.approx(1_120 * MS)
    # A percentile a decision does not see it.
    assert np.percentile(np.diff(sent), 98) == 100 * MS


def test_quantiles_are_those_of_random_moments() -> None:
    rng = np.random.default_rng(1)
    sent = np.cumsum(rng.integers(20, 400, 1_000)) * MS
    seen = sent - rng.integers(5, 30, 1_000) * MS
    ages = command_ages(seen, sent)
    moments = rng.uniform(sent[0], sent[-1], 400_000)
    flown = np.searchsorted(sent, moments, "right") - 1
    drawn = moments - seen[flown]
    for share in (0.1, 0.5, 0.9, 0.99):
        assert ages.quantile(share) == pytest.approx(np.quantile(drawn, share), rel=0.01)
    assert ages.mean == pytest.approx(drawn.mean(), rel=0.01)


def test_even_loop_has_uniform_ages() -> None:
    # Latency 20, hold 100: from 20 to 140 ms, evenly.
    ages = ages_in_closed_loop(np.full(1_000, 20), 100)
    assert ages.mean == pytest.approx(80.0)
    for share in (0.0, 0.25, 0.5, 1.0):
        assert ages.quantile(share) == pytest.approx(20.0 + 120.0 * share)


def test_gap_between_two_ages_is_jumped_over() -> None:
    ages = CommandAges(np.array([0, 100]), np.array([10, 110]))
    assert ages.quantile(0.25) == 5.0
    assert ages.quantile(0.75) == 105.0
    assert ages.mean == pytest.approx(55.0)


def test_flights_do_not_run_into_each_other() -> None:
    ages = command_ages([0, 10, 1_000, 1_010], [5, 15, 1_005, 1_015], [0, 0, 1, 1])
    assert ages.youngest_us.tolist() == [5, 5]
    assert ages.oldest_us.tolist() == [15, 15]


def test_too_few_commands_have_no_percentile() -> None:
    ages = ages_in_closed_loop(np.full(100, 20), 100)
    assert ages.percentile(90.0) is not None
    assert ages.percentile(99.0) is None
    nothing = command_ages([], [])
    assert nothing.mean is None
    assert nothing.percentile(50.0) is None


def ar1(phi: float, n: int) -> np.ndarray:
    """An AR(1) process: autocorrelation phi^k, integrated time (1 + phi) / (1 - phi)."""
    rng = np.random.default_rng(3)
    noise = rng.standard_normal(n)
    values = np.empty(n)
    values[0] = noise[0]
    for k in range(1, n):
        values[k] = phi * values[k - 1] + noise[k]
    return values


@pytest.mark.parametrize("phi", [0.0, 0.5, 0.9])
def test_autocorrelation_of_a_known_process(phi: float) -> None:
    values = ar1(phi, 20_000)
    rho = autocorrelation(values, 5)
    assert rho == pytest.approx([phi**k for k in range(6)], abs=0.06)
    assert integrated_time(values[:10_000]) == pytest.approx((1 + phi) / (1 - phi), rel=0.2)


def test_no_spread_no_correlation() -> None:
    assert autocorrelation([3, 3, 3, 3], 2).tolist() == [1.0, 0.0, 0.0]
    assert integrated_time([3, 3, 3, 3]) == 1.0
    with pytest.raises(ValueError, match="lags=4"):
        autocorrelation([3, 3, 3, 3], 4)
