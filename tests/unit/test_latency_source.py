"""Latency sources in words, and how they are drawn."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import scipy.stats

from airl_mav.core.errors import UsageError
from airl_mav.latency.injection import (
    ReplaySampler,
    latency_generator,
    longest_ms,
    parse_latency,
    select_injection,
)
from airl_mav.profiles.computer import LatencyDistribution, load_computer


@pytest.mark.parametrize(
    ("text", "mean_ms"),
    [("150ms", 150.0), ("0.15s", 150.0), ("150.5 ms", 150.5), ("500us", 0.5), ("500µs", 0.5)],
)
def test_a_fixed_latency(text: str, mean_ms: float) -> None:
    injection = parse_latency(text)
    assert injection.latency == LatencyDistribution(distribution="fixed", mean_ms=mean_ms)
    assert injection.origin == "injected"
    assert f"{mean_ms:g} ms" in injection.label


def test_a_distribution_by_its_moments() -> None:
    injection = parse_latency("lognormal:396ms,20ms,0.3s")
    assert injection.latency == LatencyDistribution(
        distribution="lognormal", mean_ms=396.0, std_ms=20.0, min_ms=300.0
    )
    sampler = injection.sampler(np.random.default_rng(1))
    assert sampler is not None
    drawn = np.array([sampler.sample_us() for _ in range(20_000)]) / 1e3
    assert drawn.mean() == pytest.approx(396.0, abs=1.0)
    assert drawn.std() == pytest.approx(20.0, rel=0.05)
    assert drawn.min() >= 300.0
    normal = parse_latency("normal:40ms,4ms").latency
    assert normal is not None
    assert normal.distribution == "normal-truncated"


def test_a_workload_of_a_computer() -> None:
    injection = parse_latency("ras-pi-4/template-7x32")
    assert injection.latency is not None
    assert injection.latency.mean_ms == 948.92
    assert "Raspberry Pi" in injection.label


def test_a_file_is_replayed_in_its_order(tmp_path: Path) -> None:
    file = tmp_path / "pi.txt"
    file.write_text("# ms\n1\n2.5\n3\n\n4 # slow\n")
    sampler = parse_latency(str(file)).sampler(np.random.default_rng(2))
    assert sampler is not None
    drawn = [sampler.sample_us() for _ in range(9)]
    trace = [1000, 2500, 3000, 4000]
    start = trace.index(drawn[0])
    assert drawn == [trace[(start + k) % 4] for k in range(9)]


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("150", "150ms, lognormal"),
        ("fast", "150ms, lognormal"),
        ("-3ms", "150ms, lognormal"),
        ("0ms", "mean_ms"),
        ("90s", "60000"),
        ("lognormal:396ms", "lognormal:MEAN,SD"),
        ("lognormal:396,20", "lognormal:MEAN,SD"),
        ("lognormal:396ms,20ms,400ms", "min_ms"),
        ("ras-pi-4/none", "template-5x32"),
        ("no-such-pi/template-5x32", "COMPUTER/WORKLOAD"),
    ],
)
def test_what_is_none_is_refused_in_a_line(text: str, told: str) -> None:
    with pytest.raises(UsageError) as refused:
        parse_latency(text)
    assert told in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_source_and_a_workload_are_one_too_many() -> None:
    computer = load_computer("ras-pi-4")
    with pytest.raises(UsageError, match="one of them"):
        select_injection("150ms", computer, "template-5x32")
    assert select_injection(None, computer, "template-5x32").latency is not None
    assert select_injection("150ms", computer, None).latency is not None


def test_replay_keeps_histogram_and_autocorrelation() -> None:
    """Draws over many episodes keep moments and autocorrelation of an AR(1) trace of 0.9."""
    rng = np.random.default_rng(5)
    noise = rng.standard_normal(4000)
    level = np.zeros(4000)
    for k in range(1, 4000):
        level[k] = 0.9 * level[k - 1] + np.sqrt(1 - 0.81) * noise[k]
    trace = np.rint(1e5 + 1e4 * level).astype(np.int64)
    episodes = []
    for seed in range(1500):
        sampler = ReplaySampler(trace, latency_generator(seed))
        episodes.append([sampler.sample_us() for _ in range(20)])
    drawn = np.array(episodes, np.float64)
    assert drawn.mean() == pytest.approx(trace.mean(), rel=0.01)
    assert drawn.std() == pytest.approx(trace.std(), rel=0.05)
    memory = np.corrcoef(drawn[:, :-1].ravel(), drawn[:, 1:].ravel())[0, 1]
    told = np.corrcoef(trace[:-1], trace[1:])[0, 1]
    assert memory == pytest.approx(told, abs=0.02)


def test_the_longest_latency() -> None:
    assert longest_ms(LatencyDistribution(distribution="fixed", mean_ms=40.0)) == 40.0
    assert (
        longest_ms(LatencyDistribution(distribution="samples", samples_ms=(3.0, 9.0, 4.0))) == 9.0
    )
    normal = LatencyDistribution(distribution="normal-truncated", mean_ms=40.0, std_ms=2.0)
    assert longest_ms(normal) == pytest.approx(scipy.stats.norm.ppf(0.999, 40.0, 2.0))
    lognormal = LatencyDistribution(
        distribution="lognormal", mean_ms=396.0, std_ms=60.0, min_ms=200.0
    )
    shape = np.sqrt(np.log1p((60.0 / 196.0) ** 2))
    scale = 196.0 / np.exp(0.5 * shape**2)
    expected = scipy.stats.lognorm.ppf(0.999, shape, loc=200.0, scale=scale)
    assert longest_ms(lognormal) == pytest.approx(expected)
