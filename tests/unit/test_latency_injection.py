from __future__ import annotations

import numpy as np
import pytest

from airl_mav.core.errors import UsageError
from airl_mav.latency.injection import (
    ESTIMATE,
    NOTHING_INJECTED,
    choose_injection,
    parse_latency,
    select_injection,
    without_timing,
)
from airl_mav.profiles.computer import ComputerProfile, LatencyDistribution, load_computer

PI_RATE = 1_505_055_712 / 396.0
"""MACs per ms of template-5x32 on the Pi."""


def test_nothing_chosen_injects_nothing() -> None:
    injection = choose_injection(load_computer("workstation"))
    assert injection.origin == "measured"
    assert injection.sampler(np.random.default_rng(0)) is None


def test_a_workload_flies_as_if() -> None:
    injection = choose_injection(load_computer("ras-pi-4"), "template-5x32")
    assert injection.origin == "injected"
    assert "template-5x32" in injection.label
    assert "396 ± 19.8 ms" in injection.label
    assert "spread" in injection.assumed
    sampler = injection.sampler(np.random.default_rng(0))
    assert sampler is not None
    mean_us = np.mean([sampler.sample_us() for _ in range(2000)])
    assert mean_us == pytest.approx(396_000, rel=0.01)


def test_an_unknown_workload_lists_the_known() -> None:
    with pytest.raises(UsageError, match=r"template-5x32, template-4x48, template-7x32, estimate"):
        choose_injection(load_computer("ras-pi-4"), "template-9x9")


def with_policy(digest: str) -> ComputerProfile:
    pi = load_computer("ras-pi-4")
    work = pi.workloads["template-4x48"].model_copy(update={"policy_sha256": digest})
    return pi.model_copy(update={"workloads": {**pi.workloads, "ours": work}})


def test_samples_of_this_very_policy_come_first() -> None:
    injection = choose_injection(with_policy("ab12"), policy_sha256="ab12")
    assert injection.origin == "injected"
    assert "this policy as timed" in injection.label
    assert choose_injection(with_policy("ab12"), policy_sha256="ff").origin == "measured"
    assert choose_injection(with_policy("ab12")).origin == "measured"


@pytest.mark.parametrize(
    ("macs", "rate"),
    [(1_500_000_000, PI_RATE), (1_000_000, PI_RATE), (10**10, 2_560_360_656 / 542.28)],
)
def test_an_estimate_scales_the_nearest_workload(macs: int, rate: float) -> None:
    injection = choose_injection(load_computer("ras-pi-4"), ESTIMATE, macs=macs)
    assert injection.origin == "estimated"
    assert injection.label.startswith("estimated")
    assert "multiply-accumulates" in injection.assumed
    assert injection.latency is not None
    assert injection.latency.mean_ms == pytest.approx(macs / rate)
    assert injection.latency.std_ms == pytest.approx(0.05 * macs / rate)


def test_nothing_to_estimate_from() -> None:
    pi = load_computer("ras-pi-4")
    with pytest.raises(UsageError, match="measure another one with airl profile"):
        choose_injection(pi, ESTIMATE)
    bare = pi.model_copy(update={"workloads": {}})
    with pytest.raises(UsageError, match="no workload"):
        choose_injection(bare, ESTIMATE, macs=1000)


def test_an_estimate_scales_measured_samples_and_keeps_what_is_assumed() -> None:
    pi = load_computer("ras-pi-4")
    samples = LatencyDistribution(distribution="samples", samples_ms=(10.0, 30.0, 20.0))
    work = pi.workloads["template-5x32"].model_copy(
        update={"latency": samples, "assumed": "the same heat sink", "source": "a bench"}
    )
    measured = pi.model_copy(update={"workloads": {"bench": work}})
    injection = choose_injection(measured, ESTIMATE, macs=3 * work.network.macs)
    assert injection.latency is not None
    assert injection.latency.samples_ms == pytest.approx((30.0, 90.0, 60.0))
    assert injection.latency.distribution == "samples"
    assert injection.assumed == (
        "latency proportional to multiply-accumulates, x 3; the same heat sink"
    )
    assert injection.source == "a bench"
    assert "estimated from bench" in injection.label
    bare = measured.model_copy(
        update={"workloads": {"bench": work.model_copy(update={"assumed": ""})}}
    )
    one = choose_injection(bare, ESTIMATE, macs=1)
    assert one.assumed.startswith("latency proportional to multiply-accumulates, x ")
    assert not one.assumed.endswith("; ")


@pytest.mark.parametrize("own", [False, True])
def test_a_workload_keeps_its_source_and_what_is_assumed(own: bool) -> None:
    pi = with_policy("ab12")
    work = pi.workloads["ours"].model_copy(update={"source": "a bench", "assumed": "no heat sink"})
    pi = pi.model_copy(update={"workloads": {"ours": work}})
    by_name, by_digest = choose_injection(pi, "ours"), choose_injection(pi, policy_sha256="ab12")
    injection = by_digest if own else by_name
    assert (injection.source, injection.assumed) == ("a bench", "no heat sink")
    assert injection.latency is work.latency
    assert injection.origin == "injected"


def test_a_level_without_timing_injects_the_native_time_alone() -> None:
    native = without_timing(NOTHING_INJECTED, 2.5, "gym")
    assert native.origin == "injected"
    assert native.label == "2.5 ms in every decision, as of a desktop computer"
    assert native.assumed == "level gym times nothing"
    assert native.latency is None
    chosen = parse_latency("80ms")
    assert without_timing(chosen, 2.5, "gym") is chosen


def test_a_text_source_goes_before_the_computer() -> None:
    pi = load_computer("ras-pi-4")
    given = select_injection("80ms", pi, None)
    assert given.latency is not None
    assert given.latency.mean_ms == 80.0
    chosen = select_injection(None, pi, "template-5x32")
    assert chosen == choose_injection(pi, "template-5x32")
    own = select_injection(None, with_policy("ab12"), None, policy_sha256="ab12")
    assert "this policy as timed" in own.label
    assert select_injection(None, pi, ESTIMATE, macs=10**9).origin == "estimated"
