"""Decision latency of a rehearsal: source, samplers, and label in reports."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from airl_mav.core.constants import US_PER_MS
from airl_mav.core.errors import UsageError
from airl_mav.core.fields import validated
from airl_mav.profiles.computer import (
    LONGEST_MS,
    ComputerProfile,
    LatencyDistribution,
    Workload,
    load_computer,
    read_samples,
)
from airl_mav.profiles.loading import list_profiles

LATENCY_STREAM = 2
"""Second word of the seed of latencies with another `draw`."""


class LatencySampler(Protocol):
    """Source of latencies."""

    def sample_us(self) -> int:
        """Return the next latency [µs], >= 0."""


class FixedSampler:
    """Constant latency."""

    def __init__(self, latency_us: int) -> None:
        """Take the latency [µs], >= 0."""
        if latency_us < 0:
            raise ValueError(f"latency_us={latency_us}: must be >= 0")
        self._latency_us = latency_us

    def sample_us(self) -> int:
        """Return the latency [µs]."""
        return self._latency_us


class RandomSampler:
    """Independent latencies from a distribution."""

    def __init__(self, draw_us: Callable[[], float]) -> None:
        """Take the function that draws a latency [µs]."""
        self._draw_us = draw_us

    def sample_us(self) -> int:
        """Return the next latency [µs]."""
        return round(self._draw_us())


class ReplaySampler:
    """Measured latencies in their order, cyclic, from a random start.

    The order preserves runs of slow decisions (another process, a hot processor), which a histogram
    loses. Every sample is equally likely at every decision, and neighbours stay neighbours. This is
    the circular block bootstrap (Politis & Romano 1992) with one block per flight.
    """

    def __init__(self, samples_us: ArrayLike, rng: np.random.Generator) -> None:
        """Take the measured latencies (n,) [µs], n >= 1, in order."""
        self._samples_us: NDArray[np.int64] = np.asarray(samples_us, np.int64)
        if not self._samples_us.size:
            raise ValueError("no samples to draw from")
        self._next = int(rng.integers(self._samples_us.size))

    def sample_us(self) -> int:
        """Return the next latency [µs]."""
        latency_us = int(self._samples_us[self._next])
        self._next = (self._next + 1) % self._samples_us.size
        return latency_us


def lognormal_parameters(mean: float, std: float) -> tuple[float, float]:
    """Return mean and standard deviation of the logarithm of a log-normal with these moments."""
    # mean = exp(mu + s²/2), variance = (exp(s²) - 1) mean².
    variance = math.log1p((std / mean) ** 2)
    return math.log(mean) - 0.5 * variance, math.sqrt(variance)


def latency_generator(seed: int, draw: int = 0) -> np.random.Generator:
    """Return the generator of an episode's latencies; another `draw` gives other latencies."""
    return np.random.default_rng((seed, LATENCY_STREAM, draw) if draw else seed)


def build_sampler(latency: LatencyDistribution, rng: np.random.Generator) -> LatencySampler:
    """Build the sampler of a latency whose sample file `load_computer` has read."""
    if latency.distribution == "samples":
        if latency.samples_ms is None:
            raise ValueError(f"samples_file {latency.samples_file} not read: use load_computer")
        return ReplaySampler(np.rint(np.array(latency.samples_ms) * US_PER_MS), rng)
    mean_us = (latency.mean_ms or 0.0) * US_PER_MS
    std_us = (latency.std_ms or 0.0) * US_PER_MS
    if not std_us:
        return FixedSampler(round(mean_us))
    min_us = latency.min_ms * US_PER_MS
    if latency.distribution == "lognormal":
        # Mean and standard deviation are of the sum.
        mu, sigma = lognormal_parameters(mean_us - min_us, std_us)
        return RandomSampler(lambda: min_us + rng.lognormal(mu, sigma))

    def truncated_us() -> float:
        # Redraws are rare: the minimum is below the mean.
        while (latency_us := rng.normal(mean_us, std_us)) < min_us:
            pass
        return latency_us

    return RandomSampler(truncated_us)


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
        raise UsageError(
            "workload = 'estimate': accepted: a policy that is only a network; measure another one"
            " with airl profile, or give --latency"
        )
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
    times = latency.model_dump(include={"mean_ms", "std_ms", "min_ms"}, exclude_none=True)
    scaled: dict[str, Any] = {name: value * factor for name, value in times.items()}
    if latency.samples_ms is not None:
        scaled["samples_ms"] = tuple(sample * factor for sample in latency.samples_ms)
    return latency.model_copy(update=scaled)


def moments(latency: LatencyDistribution) -> str:
    """Return mean and standard deviation of a latency as text."""
    if latency.samples_ms is not None:
        samples = np.array(latency.samples_ms)
        return f"{len(samples)} samples, {samples.mean():.3g} ± {samples.std():.2g} ms"
    spread = f" ± {latency.std_ms:.3g}" if latency.std_ms else ""
    return f"{latency.mean_ms:.5g}{spread} ms"


ACCEPTED = (
    "150ms, lognormal:396ms,20ms, normal:396ms,20ms, COMPUTER/WORKLOAD, "
    "or a file of latencies, one a line in ms"
)

Z_999 = 3.0902323061678132
"""99.9 % quantile of the standard normal distribution."""

_DISTRIBUTIONS = {"lognormal": "lognormal", "normal": "normal-truncated"}
_MS = {"us": 1e-3, "µs": 1e-3, "ms": 1.0, "s": 1e3, "min": 60e3, "h": 3600e3}
_TIME = re.compile(rf"(\d+(?:\.\d*)?|\.\d+)\s*({'|'.join(_MS)})")


def select_injection(
    source: str | None,
    computer: ComputerProfile,
    workload: str | None,
    *,
    policy_sha256: str | None = None,
    macs: int | None = None,
) -> Injection:
    """Choose a flight's latency, by a text source or a computer. Raises UsageError."""
    if source is None:
        return choose_injection(computer, workload, policy_sha256=policy_sha256, macs=macs)
    if workload is not None:
        raise UsageError(f"--latency {source} with --workload {workload}: accepted: one of them")
    return parse_latency(source)


def parse_latency(text: str, option: str = "--latency") -> Injection:
    """Return the latency of a text source; a UsageError names the option."""
    path = Path(text)
    if path.is_file():
        latency = LatencyDistribution(distribution="samples", samples_ms=read_samples(path, option))
        label = f"replayed from {path.name} ({moments(latency)})"
        return Injection("injected", label, f"{path}", latency=latency)
    kind, colon, values = text.partition(":")
    if colon and kind in _DISTRIBUTIONS:
        return _parametric(kind, values, text, option)
    if (fixed_ms := _milliseconds(text)) is not None:
        latency = _latency({"distribution": "fixed", "mean_ms": fixed_ms}, text, option)
        return Injection("injected", f"{fixed_ms:g} ms in every decision", latency=latency)
    computer, slash, workload = text.rpartition("/")
    if slash and (computer in list_profiles("computers") or computer.endswith(".toml")):
        return choose_injection(load_computer(computer), workload)
    raise UsageError(f"{option} {text}: accepted: {ACCEPTED}")


def longest_ms(latency: LatencyDistribution) -> float:
    """Return the maximum latency [ms], for an unbounded distribution the 99.9 % quantile."""
    if latency.samples_ms is not None:
        return max(latency.samples_ms)
    mean_ms, std_ms = latency.mean_ms or 0.0, latency.std_ms or 0.0
    if latency.distribution == "lognormal" and std_ms:
        mu, sigma = lognormal_parameters(mean_ms - latency.min_ms, std_ms)
        return latency.min_ms + math.exp(mu + Z_999 * sigma)
    return mean_ms + Z_999 * std_ms


def _parametric(kind: str, values: str, text: str, option: str) -> Injection:
    """Return a distribution given by its moments."""
    numbers = [_milliseconds(value) for value in values.split(",")]
    given = [number for number in numbers if number is not None]
    if len(given) != len(numbers) or not 2 <= len(given) <= 3:
        raise UsageError(f"{option} {text}: accepted: {kind}:MEAN,SD[,LEAST], each with its unit")
    fields = dict(zip(("mean_ms", "std_ms", "min_ms"), given, strict=False))
    latency = _latency({"distribution": _DISTRIBUTIONS[kind], **fields}, text, option)
    return Injection("injected", f"{kind}, {moments(latency)}", latency=latency)


def _latency(fields: dict[str, object], text: str, option: str) -> LatencyDistribution:
    return validated(LatencyDistribution, fields, f"{option} {text}")


def duration_ms(text: str) -> float | None:
    """Return a time with its unit, as `150ms` or `10min`, in ms; None if invalid."""
    found = _TIME.fullmatch(text.strip())
    return None if found is None else float(found[1]) * _MS[found[2]]


def _milliseconds(text: str) -> float | None:
    """Return a latency with its unit in ms, infinite above `LONGEST_MS`; None if invalid."""
    value_ms = duration_ms(text)
    return math.inf if value_ms is not None and value_ms > LONGEST_MS else value_ms
