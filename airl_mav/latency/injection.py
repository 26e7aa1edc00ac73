"""Selection of a rehearsal's decision latency, and its label in reports."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from airl_mav.core.errors import UsageError
from airl_mav.latency.samplers import LatencySampler, build_sampler
from airl_mav.profiles.computer import ComputerProfile, LatencyDistribution, Workload

Origin = Literal["measured", "injected", "estimated"]

ESTIMATE = "estimate"
"""Workload name that requests an estimate from multiply-accumulates."""


@dataclass(frozen=True)
class Injection:
    """Decision latency t2 of a rehearsal."""

    origin: Origin
    """Origin of t2; `measured`: nothing is injected, the machine's time counts."""
    label: str
    """Description in one line."""
    source: str = ""
    assumed: str = ""
    latency: LatencyDistribution | None = None
    """Distribution to draw from; None injects nothing."""

    def sampler(self, rng: np.random.Generator) -> LatencySampler | None:
        """Return the source of latencies, or None without injection."""
        return None if self.latency is None else build_sampler(self.latency, rng)


NOTHING_INJECTED = Injection("measured", "native speed of the machine that flew; nothing injected")


def without_timing(chosen: Injection, native_ms: float, level: str) -> Injection:
    """Return an injection for an untimed level, where the default t2 is `native_ms`."""
    if chosen.latency is not None:
        return chosen
    label = f"{native_ms:g} ms in every decision, as of a desktop computer"
    assumed = f"level {level} times nothing"
    return replace(chosen, origin="injected", label=label, assumed=assumed)


def choose_injection(
    computer: ComputerProfile,
    workload: str | None = None,
    *,
    policy_sha256: str | None = None,
    macs: int | None = None,
) -> Injection:
    """Choose the latency of a policy on a computer.

    `workload` selects an entry of the computer's profile; `estimate` scales the workload nearest in
    multiply-accumulates (`macs` of one inference). None selects the measurement for the policy's
    digest, if any. Otherwise nothing is injected. Omit the digest if the policy really runs on that
    computer, so that nothing is added to its own time. Raises UsageError if the computer lacks the
    workload, or any workload to estimate from.
    """
    if workload is None:
        for name, work in computer.workloads.items():
            if policy_sha256 is not None and work.policy_sha256 == policy_sha256:
                label = f"this policy as timed on {computer.description} ({name})"
                return Injection("injected", label, work.source, work.assumed, work.latency)
        return NOTHING_INJECTED
    if workload == ESTIMATE:
        return _estimate(computer, macs)
    if workload not in computer.workloads:
        known = ", ".join([*computer.workloads, ESTIMATE])
        raise UsageError(f"workload = {workload!r}: accepted for this computer: {known}")
    work = computer.workloads[workload]
    label = f"as if {computer.description} ran {workload} ({moments(work.latency)})"
    return Injection("injected", label, work.source, work.assumed, work.latency)


def _estimate(computer: ComputerProfile, macs: int | None) -> Injection:
    """Scale the workload nearest in multiply-accumulates to `macs`."""
    if not macs or macs < 1:
        raise UsageError("workload = 'estimate': the policy's card gives no multiply-accumulates")
    if not computer.workloads:
        raise UsageError("workload = 'estimate': this computer has no workload to estimate from")
    name, work = min(
        computer.workloads.items(), key=lambda item: abs(math.log(item[1].network.macs / macs))
    )
    factor = macs / work.network.macs
    latency = _scaled(work, factor)
    label = f"estimated from {name} on {computer.description} ({moments(latency)})"
    assumed = f"latency proportional to multiply-accumulates, x {factor:.3g}"
    if work.assumed:
        assumed = f"{assumed}; {work.assumed}"
    return Injection("estimated", label, work.source, assumed, latency)


def _scaled(work: Workload, factor: float) -> LatencyDistribution:
    """Return a workload's latency with every time multiplied by `factor`."""
    latency = work.latency
    return latency.model_copy(
        update={
            "mean_ms": None if latency.mean_ms is None else latency.mean_ms * factor,
            "std_ms": None if latency.std_ms is None else latency.std_ms * factor,
            "min_ms": latency.min_ms * factor,
            "samples_ms": None
            if latency.samples_ms is None
            else tuple(sample * factor for sample in latency.samples_ms),
        }
    )


def moments(latency: LatencyDistribution) -> str:
    """Return mean and standard deviation of a latency as text."""
    if latency.samples_ms is not None:
        samples = np.array(latency.samples_ms)
        return f"{len(samples)} samples, {samples.mean():.3g} ± {samples.std():.2g} ms"
    spread = f" ± {latency.std_ms:.3g}" if latency.std_ms else ""
    return f"{latency.mean_ms:.5g}{spread} ms"
