"""Latency sources as text: values of `--latency`.

`150ms` (fixed), `lognormal:396ms,20ms` and `normal:396ms,20ms` (mean, standard deviation; a third
number is the minimum), `COMPUTER/WORKLOAD` (an entry of a computer profile), or a path to a text
file of measured latencies, one per line in ms, replayed in order.
"""

from __future__ import annotations

import math
import re
from pathlib import Path

from airl_mav.core.errors import UsageError
from airl_mav.core.fields import validated
from airl_mav.latency.injection import Injection, choose_injection, moments
from airl_mav.latency.samplers import lognormal_parameters
from airl_mav.profiles.computer import (
    LONGEST_MS,
    ComputerProfile,
    LatencyDistribution,
    load_computer,
    read_samples,
)
from airl_mav.profiles.loading import list_profiles

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
