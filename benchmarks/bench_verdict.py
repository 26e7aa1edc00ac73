"""Flights until a verdict, by the error spending of the sequential test.

Run as `python benchmarks/bench_verdict.py [THRESHOLD]`. For true success rates around the threshold
(0.95): the mean number of flights until the verdict, 500 at most, and the probability of a verdict.
All are exact; each is wrong with a probability of 2.5 % at most on either side. O'Brien and
Fleming's and Pocock's tests (as spent by Lan & DeMets, Biometrika 70, 1983) are planned for 500
flights and spend all error by then. The others may continue without a limit.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
from rich.console import Console
from rich.table import Table
from scipy import special, stats

from airl_mav.flight.requirements import (
    ALPHA,
    HALF_SPENT,
    LOOKS,
    InterimAnalysis,
    error_spent,
    plan_looks,
)

FLIGHTS = 500
EITHER = 0.5 * ALPHA
NUMBERS = tuple(look for look in LOOKS if look <= FLIGHTS)


def obrien_fleming(n: int) -> float:
    critical = stats.norm.isf(0.5 * EITHER)
    return float(2.0 * stats.norm.sf(critical / np.sqrt(n / FLIGHTS)))


def pocock(n: int) -> float:
    return float(EITHER * np.log1p((np.e - 1.0) * n / FLIGHTS))


def half_spent_by(half: int, n: int) -> float:
    return EITHER * n / (n + half)


def e_process(threshold: float) -> list[InterimAnalysis]:
    """The likelihood ratio, mixed evenly over all rates on one side, reaches 1 / error."""
    limit = 1.0 - threshold

    def looked(n: int) -> InterimAnalysis:
        k = np.arange(n + 1)
        a, b = k + 1.0, n - k + 1.0
        whole = special.betaln(a, b) - k * np.log(limit) - (n - k) * np.log1p(-limit)
        more = whole + np.log(special.betaincc(a, b, limit) / (1.0 - limit))
        fewer = whole + np.log(special.betainc(a, b, limit) / limit)
        enough = -np.log(EITHER)
        few = k[(fewer >= enough) & (k < limit * n)]
        many = k[(more >= enough) & (k > limit * n)]
        return InterimAnalysis(n, few.max(initial=-1), many.min(initial=n + 1))

    with np.errstate(divide="ignore"):
        return [looked(n) for n in NUMBERS]


def follow(looks: Sequence[InterimAnalysis], rate: float) -> tuple[float, float]:
    """Return the mean number of flights, and the probability of a verdict, at a true rate."""
    left = np.ones(1)
    mean, before = 0.0, 0
    for look in looks:
        step = look.flights - before
        mean += step * float(left.sum())
        left = np.convolve(left, stats.binom.pmf(np.arange(step + 1), step, 1.0 - rate))
        failures = np.arange(left.size)
        left[(failures <= look.few) | (failures >= look.many)] = 0.0
        before = look.flights
    return mean, 1.0 - float(left.sum())


def main(threshold: float) -> None:
    span = 1.0 - threshold
    rates = [threshold + part * span for part in (-3.0, -2.0, -1.4, -1.0, -0.6, 0.4, 0.6, 0.8, 1.0)]
    ways: dict[str, Callable[[int], float]] = {
        "O'Brien and Fleming's": obrien_fleming,
        "Pocock's": pocock,
        **{f"half by {half}": partial(half_spent_by, half) for half in (50, 200, 400)},
        f"half by {HALF_SPENT} (in use)": error_spent,
    }
    designs = {name: list(plan_looks(threshold, NUMBERS, spent)) for name, spent in ways.items()}
    designs["e-process"] = e_process(threshold)
    table = Table(title=f"mean flights until the verdict (verdicts), limit {100 * threshold:g} %")
    for column in ("true rate", *designs):
        table.add_column(column, justify="right")
    means = dict.fromkeys(designs, 0.0)
    for rate in rates:
        cells = []
        for name, looks in designs.items():
            mean, decided = follow(looks, rate)
            means[name] += mean / len(rates)
            cells.append(f"{mean:.0f} ({100 * decided:.0f} %)")
        table.add_row(f"{100 * rate:.1f} %", *cells)
    table.add_row("mean", *(f"{mean:.0f}" for mean in means.values()))
    Console().print(table)


if __name__ == "__main__":
    main(float(sys.argv[1]) if len(sys.argv) > 1 else 0.95)
