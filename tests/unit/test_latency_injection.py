from __future__ import annotations

import numpy as np
import pytest

from airl_mav.core.errors import UsageError
from airl_mav.latency.injection import ESTIMATE, choose_injection
from airl_mav.profiles.computer import ComputerProfile, load_computer

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
    with pytest.raises(UsageError, match="multiply-accumulates"):
        choose_injection(pi, ESTIMATE)
    bare = pi.model_copy(update={"workloads": {}})
    with pytest.raises(UsageError, match="no workload"):
        choose_injection(bare, ESTIMATE, macs=1000)
