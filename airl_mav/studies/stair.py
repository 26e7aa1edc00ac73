"""A policy at latencies that grow: what each step costs, in words."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

from airl_mav.flight.gap import HardwareGap
from airl_mav.studies.parts import GAP_METRICS, metric, path_lengths, quality_of
from airl_mav.studies.study import Flown

BASE = "base"
"""No latency added: 1 ms, as of a desktop computer."""

FEWEST = 10
"""Pairs from which on a step says something."""


@dataclass(frozen=True)
class Stair:
    """A policy at all latencies."""

    policy: str
    latencies: tuple[str, ...]
    """As asked for."""
    flown: tuple[Flown, ...]
    """In the order of the latencies, the reference first."""
    gaps: tuple[HardwareGap, ...]
    """Of every latency but the first against the first."""
    steps: tuple[HardwareGap, ...]
    """Of every latency but the first against the one before it."""


def latency_name(latency: str) -> str:
    """Return a latency as people read it."""
    return latency if latency == BASE else latency.replace("ms", " ms")


def in_words(stair: Stair) -> list[str]:
    """Return whether every step costs more, and how much all of them."""
    lines = []
    for key, title in GAP_METRICS:
        lines.append(f"{stair.policy}, {title}: {_monotone(stair, key)}")
    rates = [100.0 * (quality_of(each).success_rate.value or 0.0) for each in stair.flown]
    told = ", ".join(f"{value:.1f}" for value in rates)
    lines.append(f"{stair.policy}, success {_rises(stair)}: {told} %.")
    return lines


def _rises(stair: Stair) -> str:
    """Return in words whether the success rate rises at any step."""
    steps = [
        (f"{a} → {b}", gap.success_rate.difference)
        for (a, b), gap in zip(pairwise(stair.latencies), stair.steps, strict=True)
    ]
    sure = [name for name, d in steps if d.low is not None and d.low > 0.0]
    if sure:
        return f"not monotone, it rises at {', '.join(sure)}"
    rises = any(d.value is not None and d.value > 0.0 for _, d in steps)
    return "rises nowhere beyond chance" if rises else "never rises"


def fan_in_words(policy: str, fans: Sequence[tuple[str, Flown]]) -> str:
    """Return the path lengths of the flights to one goal."""
    lengths = [(name, path_lengths(flown)) for name, flown in fans]
    told = ", ".join(
        f"{name} {'none reached it' if e.value is None else f'{e.value:.1f} m'}"
        for name, e in lengths
    )
    return f"{policy}, mean path to one goal: {told}."


def _monotone(stair: Stair, key: str) -> str:
    """Return in words whether a metric grows with every step."""
    steps = [
        (f"{a} → {b}", metric(gap, key).change.difference)
        for (a, b), gap in zip(pairwise(stair.latencies), stair.steps, strict=True)
    ]
    known = [(name, d) for name, d in steps if d.value is not None and d.n >= FEWEST]
    short = [name for name, d in steps if d.value is None or d.n < FEWEST]
    told = ", ".join(f"{d.value:+.1f} % ({name})" for name, d in known)
    if not known:
        return f"fewer than {FEWEST} pairs at every step."
    down = [name for name, d in known if (d.value or 0.0) <= 0.0]
    sure = all(d.low is not None and d.low > 0.0 for _, d in known)
    if down:
        verdict = f"not monotone, it falls at {', '.join(down)}"
    else:
        verdict = "monotone, every step's interval above zero" if sure else "monotone"
    rest = f" Fewer than {FEWEST} pairs: {', '.join(short)}." if short else ""
    return f"{verdict}: {told}.{rest}"
